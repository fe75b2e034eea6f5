"""What a run folder holds, read from files alone: any of them may be missing, cut short or damaged."""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

from gsx.core.errors import command
from gsx.core.files import is_file, read_json
from gsx.experiments.run_folder.heads import checkpoint_problem, newest_checkpoint, splats_problem
from gsx.experiments.run_folder.renamed import renamed
from gsx.formats.suffixes import suffix_of

DETAIL_OF = ("render", "enlarged", "photograph")
"""Pictures of a zoom whose explained detail is told, the model's own first."""
SPLATS = "point_cloud.ply"
RESULTS = ("evaluation.json", "renders/index.json", SPLATS)
"""Files that end every run; `gsx eval` makes them again."""
BEGUN, LOG = ("environment.json", "metrics.jsonl"), "log.txt"
"""Files that a run begins with."""
COMPACT = "compact.json"
"""Of a folder that `gsx compact` made, which has no log, and of the others of BEGUN those of the run it was given."""
REPORT = "report.html"
LOST = ("metrics.jsonl", "checkpoints/")
"""What nothing makes again of a run that is trained to its end; but from an older checkpoint, the newest."""
ASIDE = "photographs/index.json"
"""What is told of a run beside its results; no run needs it, and `gsx photographs` makes it again."""
LARGEST = 1e100
"""Numbers beyond it are none that a run has, and not safe to reckon with."""
STATES = ("ok", "running", "interrupted", "failed", "corrupted")


@dataclass(frozen=True, eq=False, kw_only=True)
class RunFiles:
    """Content of a run folder; empty where a file is missing or damaged."""

    folder: Path
    config: dict[str, Any]
    config_text: str
    environment: dict[str, Any]
    lines: list[dict[str, Any]]
    """Intact lines of metrics.jsonl."""
    evaluation: dict[str, Any]
    pictures: dict[str, Any]
    pseudo: dict[str, Any]
    """Content of pseudo/index.json."""
    photographs: dict[str, Any]
    """Content of photographs/index.json."""
    status: dict[str, Any]
    problems: dict[str, str]
    """What is wrong, by file."""
    namesake: int = 0
    """How many other scenes of the same name stand before its own, in a report over runs."""

    @property
    def step(self) -> int:
        """Steps known to be done."""
        logged = self.lines[-1].get("step", 0) if self.lines else 0
        return max(int(self.status.get("step") or 0), int(self.evaluation.get("step") or 0), int(logged))

    @property
    def iterations(self) -> int:
        """Steps asked for; 0 where unknown."""
        wanted = self.config.get("iterations")
        return int(wanted) if is_number(wanted) else 0

    @property
    def remedy(self) -> str:
        """The command that completes the run."""
        only_results = not any(name.startswith((*self.begun, "checkpoints/")) for name in self.lacking)
        verb = "eval" if only_results and 0 < self.iterations <= self.step else "resume"
        return command(verb, self.folder)

    @cached_property
    def begun(self) -> tuple[str, ...]:
        """Files that its beginning leaves."""
        made = read_mapping(self.folder, COMPACT, {}, lambda content: isinstance(content.get("from"), str))
        if not made:
            return (*BEGUN, LOG)
        return () if suffix_of(Path(made["from"])) else BEGUN

    @cached_property
    def missing(self) -> list[str]:
        """Files that a complete run has and this one lacks; but for its report, which is made of them."""
        names = [*self.begun, *RESULTS, *pictures_in(self.pictures), "status.json"]
        step = max(newest_checkpoint(self.folder), int(self.evaluation.get("step") or 0))
        if self.evaluation:
            names += [f"checkpoints/step_{step:07d}{suffix}" for suffix in (".safetensors", ".json")]
        return [name for name in names if not is_file(self.folder / name)]

    @cached_property
    def damaged(self) -> dict[str, str]:
        """What is wrong, by file, with those that a complete run has: what is read of them, and sizes of the others."""
        found = {name: told for name, told in self.problems.items() if name not in (*LOST, ASIDE)}
        if self.iterations > 0 and not self.lines and "metrics.jsonl" in self.begun:
            found["metrics.jsonl"] = "metrics.jsonl holds no line of the run"
        found[SPLATS] = splats_problem(self.folder / SPLATS)
        found["checkpoints/"] = checkpoint_problem(self.folder)
        return {name: told for name, told in found.items() if told and name not in self.missing}

    @property
    def lacking(self) -> list[str]:
        """Files that are missing or damaged."""
        return [*self.missing, *self.damaged]

    @property
    def lost(self) -> list[str]:
        """Those of LOST."""
        return [name for name in self.lacking if name.startswith(LOST)]

    @property
    def unfinished(self) -> list[str]:
        """Those that a run makes again which goes on: results, and with a checkpoint whatever else is not `lost`."""
        kept = not any(name.startswith("checkpoints/") for name in self.lacking)
        return [name for name in self.lacking if name in RESULTS or (kept and name not in self.lost)]

    @property
    def scene(self) -> str:
        """Scene, with the last part of its folder where it has one."""
        node = part(self.config, "scene")
        number = f"({self.namesake + 1})" if self.namesake else ""
        words = (str(node.get("name", "?")), Path(str(node.get("path") or "")).name, number)
        return " ".join(word for word in words if word)

    @property
    def backbone(self) -> str:
        """Backbone and augmenters."""
        names = [part(self.config, "backbone").get("name", "?"), *part(self.config, "augmenter")]
        return " + ".join(map(str, names))

    @property
    def variant(self) -> str:
        """The name that config.yaml gives the run, else backbone and augmenters."""
        name = self.config.get("variant")
        return name if isinstance(name, str) and name else self.backbone

    @property
    def protocol_hash(self) -> str:
        """Hash of the evaluation protocol; empty without an evaluation."""
        return str(part(self.evaluation, "protocol").get("hash", ""))


def part(content: dict[str, Any], key: str) -> dict[str, Any]:
    """A mapping inside a mapping; empty where there is none."""
    value = content.get(key)
    return value if isinstance(value, dict) else {}


def read_run(folder: Path) -> RunFiles:
    """Everything that can be read of a run."""
    problems: dict[str, str] = {}
    config, text = read_yaml(folder / "config.yaml", problems)
    config = renamed(config)

    def read(name: str, sound: Callable[[dict[str, Any]], bool] = lambda _: True) -> dict[str, Any]:
        return read_mapping(folder, name, problems, sound)

    evaluation = read("evaluation.json", sound_evaluation)
    if evaluation and not (is_number(evaluation.get("psnr")) or "views" in evaluation):
        problems["evaluation.json"] = "evaluation.json holds no figures"
        evaluation = {}
    return RunFiles(
        folder=folder,
        config=config,
        config_text=text,
        environment=read("environment.json", sound_environment),
        lines=read_lines(folder / "metrics.jsonl", problems),
        evaluation=evaluation,
        pictures=read("renders/index.json", sound_pictures),
        pseudo=read("pseudo/index.json", lambda content: rows(content.get("views", []))),
        photographs=read(ASIDE, sound_photographs),
        status=read("status.json", sound_step),
        problems=problems,
    )


def sound_evaluation(content: dict[str, Any]) -> bool:
    """Whether the parts of an evaluation.json that there are have the form that gsx gives them."""
    zoom, groups = content.get("zoom", {}), content.get("groups", {})
    named = all(isinstance(node, dict) and rows(list(node.values())) for node in (zoom, groups))
    views = content.get("views", [])
    called = rows(views) and all(isinstance(view.get("name", ""), str) for view in views)
    sound = sound_step(content) and named and called and all(map(is_decimal, zoom))
    return sound and sound_incidents(content) and sound_protocol(content.get("protocol", {}))


def sound_protocol(protocol: Any) -> bool:
    """Whether what an evaluation tells of its protocol has the form that gsx gives it."""
    if not isinstance(protocol, dict):
        return False
    sized = "size" not in protocol or is_size(protocol["size"])
    return sized and isinstance(protocol.get("scene", {}), dict) and isinstance(protocol.get("test_views", []), list)


def is_size(value: Any) -> bool:
    """Whether it is a width and a height."""
    return isinstance(value, list) and len(value) == 2 and all(map(is_number, value))


def sound_incidents(content: dict[str, Any]) -> bool:
    """Whether what an evaluation tells of caps, lost pictures and splats left out has the form that gsx gives it."""
    cap, pseudo, left_out = content.get("withheld", {}), content.get("pseudo", {}), content.get("left_out") or 0
    if not (isinstance(cap, dict) and isinstance(pseudo, dict) and rows(list(pseudo.values())) and is_number(left_out)):
        return False
    if not all(isinstance(facts.get("warned", {}), dict) for facts in pseudo.values()):
        return False
    by_scale = [node for facts in pseudo.values() for node in (facts.get("dropped"), *part(facts, "warned").values())]
    numbers = all(isinstance(node, dict) and all(map(is_number, node.values())) for node in by_scale)
    return numbers and (not cap or is_number(cap.get("step")))


def sound_environment(content: dict[str, Any]) -> bool:
    """Whether the history and notes of an environment.json have the form that gsx gives them."""
    history = content.get("history", [])
    if not isinstance(part(content, "scene").get("notes", []), list):
        return False
    changes = [change for entry in history for change in part(entry, "changed").values()] if rows(history) else [None]
    return all(isinstance(change, list) and len(change) == 2 for change in changes)


def sound_pictures(content: dict[str, Any]) -> bool:
    """Whether the lists of a renders/index.json have the form that gsx gives them."""
    views, crops = content.get("views", []), content.get("zoom", [])
    if not (rows(views) and rows(crops) and all(is_number(crop.get("factor")) for crop in crops)):
        return False
    sized = all(is_size(view.get("size")) for view in views)
    names = [name for one in (*views, *crops) for name in part(one, "files").values()]
    return sized and all(isinstance(name, str) and Path(name).name not in ("", "..") for name in names)


def sound_photographs(content: dict[str, Any]) -> bool:
    """Whether a photographs/index.json has the form that gsx gives it."""
    views = content.get("views", [])
    if not (sound_step(content) and rows(views)):
        return False
    told = all(isinstance(view.get("name"), str) and isinstance(view.get("remarks"), list) for view in views)
    return told and all(isinstance(view.get("files", {}), dict) for view in views)


def pictures_in(index: dict[str, Any]) -> list[str]:
    """Pictures that a sound renders/index.json names, as files of the run's folder."""
    entries = [*index.get("views", []), *index.get("zoom", [])]
    names = [name for entry in entries for name in part(entry, "files").values()]
    flight = part(index, "flight").get("file")
    names += [flight] if isinstance(flight, str) and flight else []
    return [f"renders/{Path(name).name}" for name in names]


def sound_line(line: Any) -> bool:
    """Whether it is a line of metrics.jsonl, as far as a run reads it again."""
    if not (isinstance(line, dict) and is_number(line.get("step"))):
        return False
    figures = all(line.get(key) is None or is_number(line[key]) for key in ("memory_mb", "withheld", "test_psnr"))
    accounts = line.get("pseudo", {})
    return figures and isinstance(accounts, dict) and all(map(sound_account, accounts.values()))


def sound_account(account: Any) -> bool:
    """Whether it counts pictures of pseudo views by scale: those asked for, dropped, and by check warned of."""
    warned = account.get("warned") if isinstance(account, dict) else None
    if not isinstance(warned, dict):
        return False
    counts = [account.get("asked"), account.get("dropped"), *warned.values()]
    by_scale = all(isinstance(count, dict) and all(map(is_decimal, count)) for count in counts)
    return by_scale and all(is_number(number) for count in counts for number in count.values())


def sound_step(content: dict[str, Any]) -> bool:
    """Whether the step, where there is one, is a number."""
    return content.get("step") is None or is_number(content["step"])


def rows(value: Any) -> bool:
    """Whether it is a list of mappings."""
    return isinstance(value, list) and all(isinstance(entry, dict) for entry in value)


def is_decimal(word: str) -> bool:
    """Whether a key, of JSON and so a text, is a number as in `is_number`."""
    try:
        return is_number(float(word))
    except ValueError:
        return False


def read_yaml(path: Path, problems: dict[str, str]) -> tuple[dict[str, Any], str]:
    """Mapping and text of a YAML file."""
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        content = yaml.safe_load(text)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        problems[path.name] = f"{path.name} cannot be read ({first_line(error)})"
        return {}, ""
    if not isinstance(content, dict):
        problems[path.name] = f"{path.name} holds no settings"
        return {}, text
    return content, text


def first_line(error: Exception) -> str:
    """What an error says, in one line."""
    return next(iter(str(error).splitlines()), type(error).__name__)


def read_mapping(
    folder: Path, name: str, problems: dict[str, str], sound: Callable[[dict[str, Any]], bool]
) -> dict[str, Any]:
    """A JSON object; empty where the file is missing, damaged, or not `sound`."""
    try:
        content = read_json(folder / name)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        problems[name] = f"{name} cannot be read ({first_line(error)})"
        return {}
    if not isinstance(content, dict):
        problems[name] = f"{name} holds no JSON object"
        return {}
    if not sound(content):
        problems[name] = f"{name} is not what gsx writes"
        return {}
    return content


def read_lines(path: Path, problems: dict[str, str]) -> list[dict[str, Any]]:
    """The intact lines of metrics.jsonl in order of their steps; a resumed run may have cut one short."""
    if not path.is_file():
        return []
    intact, damaged = [], 0
    for text in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            line = json.loads(text)
        except (ValueError, RecursionError):
            line = None
        if sound_line(line):
            intact.append(line)
        else:
            damaged += 1
    if damaged:
        problems[path.name] = f"{damaged} lines of {path.name} are damaged and left out"
    return sorted(intact, key=lambda line: line["step"])


def is_number(value: Any) -> TypeGuard[float]:
    """Whether it is a finite number of a size that a run may have."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def gain_of(entry: dict[str, Any], figure: str = "psnr") -> float | None:
    """Zoomed render minus resized x1 render; positive: the zoomed render is closer to the truth."""
    render, enlarged = entry.get(figure), entry.get(f"enlarged_{figure}")
    return render - enlarged if is_number(render) and is_number(enlarged) else None


def detail_share(entry: dict[str, Any], kind: str = "render") -> float | None:
    """Explained detail above the training Nyquist frequency of a zoom's render, or of what it competes with."""
    share = part(part(entry, "detail"), kind).get("explained")
    return share if is_number(share) else None


def state_of(files: RunFiles, reporting: bool = False) -> tuple[str, str]:
    """One of STATES, and the reason where it is not `ok`; `reporting`: its report is about to be written."""
    recorded = files.status.get("state")
    for name in ("config.yaml", "evaluation.json"):
        if name in files.problems:
            return "corrupted", files.problems[name]
    if recorded == "failed":
        return "failed", str(files.status.get("reason") or "no reason recorded")
    evaluated, done = int(files.evaluation.get("step") or 0), judged(files)
    if done and files.damaged:
        return "corrupted", "; ".join(files.damaged.values())
    without = [*files.missing, *([] if reporting or is_file(files.folder / REPORT) else [REPORT])]
    if done and not without:
        return "ok", ""
    progress = f"{files.step:,} of {files.iterations:,} steps, "
    progress += f"evaluated at step {evaluated:,}" if files.evaluation else "not evaluated"
    if done:
        progress += f", without {', '.join(without)}"
    return ("running", f"under way or killed: {progress}") if recorded == "running" else ("interrupted", progress)


def judged(files: RunFiles) -> bool:
    """Whether its last state was evaluated."""
    return bool(files.evaluation) and int(files.evaluation.get("step") or 0) >= max(files.step, files.iterations)


def has_figures(files: RunFiles) -> bool:
    """Whether a run is done, if perhaps without what nothing makes again, such as checkpoints that were deleted."""
    if state_of(files)[0] == "ok":
        return True
    sound = files.status.get("state") == "ok" and "config.yaml" not in files.problems
    return sound and judged(files) and not files.unfinished


def reported(folder: Path) -> bool:
    """Whether a run's report is of its last state, which is recorded before the report is written."""
    try:
        return (folder / REPORT).stat().st_mtime_ns >= (folder / "status.json").stat().st_mtime_ns
    except OSError:
        return False


def runs_below(folder: Path) -> Iterator[Path]:
    """Folders with a config.yaml, sorted; nothing inside a run is searched, and no link leads back up."""
    for child in sorted(folder.iterdir()):
        if not child.is_dir() or child.name.startswith("."):
            continue
        if child.is_symlink() and folder.resolve().is_relative_to(child.resolve()):
            continue
        if (child / "config.yaml").is_file():
            yield child
        else:
            yield from runs_below(child)
