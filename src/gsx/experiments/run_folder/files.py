"""Content of a run folder, read from files alone: any of them may be missing, cut short or damaged."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from gsx.core.errors import InputError, command, first_line
from gsx.core.files import is_file, read_json
from gsx.experiments.run_folder import shapes
from gsx.experiments.run_folder.renamed import renamed
from gsx.experiments.run_folder.shapes import fits, is_number
from gsx.formats.detect import MOST_HEADER
from gsx.formats.ply import length_of
from gsx.formats.suffixes import suffix_of

DETAIL_OF = ("render", "enlarged", "upscaled", "photograph")
"""Pictures of a zoom whose explained detail is measured, the model's render first."""
SPLATS = "point_cloud.ply"
RESULTS = ("evaluation.json", "renders/index.json", SPLATS)
"""Files that end every run; `gsx eval` writes them again."""
FIRST_FILES, LOG = ("environment.json", "metrics.jsonl"), "log.txt"
"""Files that a run starts with."""
COMPACT = "compact.json"
"""File of a `gsx compact` run, which has no log; it has FIRST_FILES only if it was made from a run."""
REPORT = "report.html"
LOST = ("metrics.jsonl", "checkpoints/")
"""Files of a finished run that cannot be made again."""
PHOTO_FINDINGS = "photographs/index.json"
"""Optional: written by `gsx photographs`."""
RETAKES = "retakes/index.json"
"""Optional: written by evaluations of scenes of photos."""
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
    """Content of renders/index.json."""
    pseudo: dict[str, Any]
    """Content of pseudo/index.json."""
    photographs: dict[str, Any]
    """Content of photographs/index.json."""
    retakes: dict[str, Any]
    """Content of retakes/index.json."""
    status: dict[str, Any]
    problems: dict[str, str]
    """Errors in words, by file."""
    namesake: int = 0
    """Number of other scenes of the same name before this one, in a report over runs."""

    @property
    def step(self) -> int:
        """Return the last step that any file mentions."""
        logged = self.lines[-1]["step"] if self.lines else 0
        return max(int(self.status.get("step") or 0), evaluated_step(self), int(logged))

    @property
    def iterations(self) -> int:
        """Return the steps of the whole run; 0: unknown."""
        iterations = self.config.get("iterations")
        return int(iterations) if is_number(iterations) else 0

    @property
    def remedy(self) -> str:
        """Return the command that completes the run."""
        only_results = not any(name.startswith((*self.first_files, "checkpoints/")) for name in self.lacking)
        verb = "eval" if only_results and 0 < self.iterations <= self.step else "resume"
        return command(verb, self.folder)

    @cached_property
    def first_files(self) -> tuple[str, ...]:
        """Return the files that the start of the run leaves."""
        made = read_mapping(self.folder, COMPACT, {}, shapes.COMPACT)
        if not made:
            return (*FIRST_FILES, LOG)
        return () if suffix_of(Path(made["from"])) else FIRST_FILES

    @cached_property
    def missing(self) -> list[str]:
        """Return the missing files of a complete run, except the report, which is made of them."""
        names = [*self.first_files, *RESULTS, *pictures_in(self.pictures), "status.json"]
        step = max(newest_checkpoint(self.folder), evaluated_step(self))
        if self.evaluation:
            names += [f"checkpoints/step_{step:07d}{suffix}" for suffix in (".safetensors", ".json")]
        return [name for name in names if not is_file(self.folder / name)]

    @cached_property
    def damaged(self) -> dict[str, str]:
        """Return the problem of each damaged file: by content for those that are read, by size for the others."""
        found = {
            name: problem for name, problem in self.problems.items() if name not in (*LOST, PHOTO_FINDINGS, RETAKES)
        }
        if self.iterations > 0 and not self.lines and "metrics.jsonl" in self.first_files:
            found["metrics.jsonl"] = "metrics.jsonl holds no line of the run"
        found[SPLATS] = splats_problem(self.folder / SPLATS)
        found["checkpoints/"] = checkpoint_problem(self.folder)
        return {name: problem for name, problem in found.items() if problem and name not in self.missing}

    @property
    def lacking(self) -> list[str]:
        """Return the missing or damaged files."""
        return [*self.missing, *self.damaged]

    @property
    def lost(self) -> list[str]:
        """Return the lacking files that cannot be made again."""
        return [name for name in self.lacking if name.startswith(LOST)]

    @property
    def unfinished(self) -> list[str]:
        """Return the lacking files that the run writes again when it is resumed."""
        resumable = not any(name.startswith("checkpoints/") for name in self.lacking)
        return [name for name in self.lacking if name in RESULTS or (resumable and name not in self.lost)]

    @property
    def scene(self) -> str:
        """Return the scene's name, with the last part of its folder."""
        node = part(self.config, "scene")
        number = f"({self.namesake + 1})" if self.namesake else ""
        words = (str(node.get("name", "?")), Path(str(node.get("path") or "")).name, number)
        return " ".join(word for word in words if word)

    @property
    def backbone(self) -> str:
        """Return the names of backbone and augmenters."""
        names = [part(self.config, "backbone").get("name", "?"), *part(self.config, "augmenter")]
        return " + ".join(map(str, names))

    @property
    def variant(self) -> str:
        """Return the variant in config.yaml, else backbone and augmenters."""
        name = self.config.get("variant")
        return name if isinstance(name, str) and name else self.backbone

    @property
    def protocol_hash(self) -> str:
        """Return the hash of the evaluation protocol; empty without an evaluation."""
        return str(part(self.evaluation, "protocol").get("hash", ""))


def part(content: dict[str, Any], key: str) -> dict[str, Any]:
    """Return a mapping inside a mapping; empty if there is none."""
    value = content.get(key)
    return value if isinstance(value, dict) else {}


def evaluated_step(run: RunFiles) -> int:
    """Return the step that a run was evaluated at; 0: none."""
    return int(run.evaluation.get("step") or 0)


def read_run(folder: Path) -> RunFiles:
    """Read all readable content of a run."""
    problems: dict[str, str] = {}
    config, text = read_yaml(folder / "config.yaml", problems)

    def read(name: str, shape: shapes.Shape) -> dict[str, Any]:
        return read_mapping(folder, name, problems, shape)

    evaluation = read("evaluation.json", shapes.EVALUATION)
    if evaluation and not (is_number(evaluation.get("psnr")) or "views" in evaluation):
        problems["evaluation.json"] = "evaluation.json holds no figures"
        evaluation = {}
    return RunFiles(
        folder=folder,
        config=renamed(config),
        config_text=text,
        environment=read("environment.json", shapes.ENVIRONMENT),
        lines=read_lines(folder / "metrics.jsonl", problems),
        evaluation=evaluation,
        pictures=read("renders/index.json", shapes.DRAWN),
        pseudo=read("pseudo/index.json", shapes.PSEUDO_VIEWS),
        photographs=read(PHOTO_FINDINGS, shapes.PHOTOGRAPHS),
        retakes=read(RETAKES, shapes.RETAKES),
        status=read("status.json", shapes.STATUS),
        problems=problems,
    )


def read_yaml(path: Path, problems: dict[str, str]) -> tuple[dict[str, Any], str]:
    """Read the mapping and the text of a YAML file; empty if it is damaged."""
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


def read_mapping(folder: Path, name: str, problems: dict[str, str], shape: shapes.Shape) -> dict[str, Any]:
    """Read a JSON object; empty if the file is missing, damaged, or does not fit its shape."""
    try:
        content = read_json(folder / name)
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        problems[name] = f"{name} cannot be read ({first_line(error)})"
        return {}
    if not fits(content, shape):
        problems[name] = f"{name} is not what gsx writes"
        return {}
    return content


def read_lines(path: Path, problems: dict[str, str]) -> list[dict[str, Any]]:
    """Read the intact lines of metrics.jsonl in order of their steps; a killed run may have cut one short."""
    if not path.is_file():
        return []
    lines = [parsed(text) for text in path.read_text(encoding="utf-8", errors="replace").splitlines()]
    intact = [line for line in lines if fits(line, shapes.LINE)]
    if len(intact) < len(lines):
        problems[path.name] = f"{len(lines) - len(intact)} lines of {path.name} are damaged and left out"
    return sorted(intact, key=lambda line: line["step"])


def parsed(text: str) -> Any:
    """Parse JSON; None if it is damaged."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def pictures_in(index: dict[str, Any]) -> list[str]:
    """List the pictures of a renders/index.json as files of the run folder."""
    entries = [*index.get("views", []), *index.get("zoom", [])]
    names = [name for entry in entries for name in part(entry, "files").values()]
    names += [index["flight"]["file"]] if "flight" in index else []
    return [f"renders/{Path(name).name}" for name in names]


def runs_below(folder: Path) -> Iterator[Path]:
    """Yield folders with a config.yaml in order; search nothing inside a run and follow no link back up."""
    for child in sorted(folder.iterdir()):
        if not child.is_dir() or child.name.startswith("."):
            continue
        if child.is_symlink() and folder.resolve().is_relative_to(child.resolve()):
            continue
        if (child / "config.yaml").is_file():
            yield child
        else:
            yield from runs_below(child)


def gain_of(entry: dict[str, Any], figure: str = "psnr", rival: str = "enlarged") -> float | None:
    """Subtract the figure of the resized x1 render from that of the zoomed render; positive: closer to the truth.

    rival: enlarged (bicubic) | upscaled (by an upscaler).
    """
    render, other = entry.get(figure), entry.get(f"{rival}_{figure}")
    return render - other if is_number(render) and is_number(other) else None


def over_upscaled(entry: dict[str, Any]) -> float | None:
    """Return the gain in PSNR over the x1 render that an upscaler enlarged, dB."""
    return gain_of(entry, rival="upscaled")


def upscaler_of(evaluation: dict[str, Any]) -> str:
    """Return the name of the upscaler that zoomed renders are compared with."""
    return str(part(evaluation, "competitor").get("name") or "an upscaler")


def detail_share(entry: dict[str, Any], kind: str = "render") -> float | None:
    """Return the explained detail above the training Nyquist frequency of a picture at a zoom (DETAIL_OF)."""
    share = part(part(entry, "detail"), kind).get("explained")
    return share if is_number(share) else None


def perceptual_names(evaluation: dict[str, Any]) -> list[str]:
    """List the perceptual metrics of which an evaluation has figures."""
    return [name for name, value in part(evaluation, "perceptual").items() if is_number(value)]


def perceptual_figure(entry: dict[str, Any], metric: str, picture: str = "render") -> float | None:
    """Return a perceptual figure of an evaluation, a view or a group; of a zoom, that of one of its pictures."""
    value = part(entry, "perceptual").get(metric)
    if isinstance(value, dict):
        value = value.get(picture)
    return value if is_number(value) else None


def state_of(run: RunFiles, reporting: bool = False) -> tuple[str, str]:
    """Return one of STATES and, unless it is `ok`, the reason; `reporting`: its report is about to be written."""
    recorded = run.status.get("state")
    for name in ("config.yaml", "evaluation.json"):
        if name in run.problems:
            return "corrupted", run.problems[name]
    if recorded == "failed":
        return "failed", str(run.status.get("reason") or "no reason recorded")
    done = is_evaluated(run)
    if done and run.damaged:
        return "corrupted", "; ".join(run.damaged.values())
    missing = [*run.missing, *([] if reporting or is_file(run.folder / REPORT) else [REPORT])]
    if done and not missing:
        return "ok", ""
    progress = f"{run.step:,} of {run.iterations:,} steps, "
    progress += f"evaluated at step {evaluated_step(run):,}" if run.evaluation else "not evaluated"
    if done:
        progress += f", without {', '.join(missing)}"
    return ("running", f"running or killed: {progress}") if recorded == "running" else ("interrupted", progress)


def is_evaluated(run: RunFiles) -> bool:
    """Return True if the last state of a run was evaluated."""
    return bool(run.evaluation) and evaluated_step(run) >= max(run.step, run.iterations)


def has_figures(run: RunFiles) -> bool:
    """Return True if a run is done, perhaps without files that cannot be made again, such as deleted checkpoints."""
    if state_of(run)[0] == "ok":
        return True
    ended = run.status.get("state") == "ok" and "config.yaml" not in run.problems
    return ended and is_evaluated(run) and not run.unfinished


def reported(folder: Path) -> bool:
    """Return True if a run's report is newer than its status, which is written before the report."""
    try:
        return (folder / REPORT).stat().st_mtime_ns >= (folder / "status.json").stat().st_mtime_ns
    except OSError:
        return False


def splats_problem(path: Path) -> str:
    """Describe what is wrong with a splat file by its header; empty: nothing."""
    try:
        with path.open("rb") as stream:
            length = length_of(stream.read(MOST_HEADER))
        size = path.stat().st_size
    except (OSError, InputError) as error:
        return f"{path.name} cannot be read ({error})"
    return "" if size == length else f"{path.name} has {size:,} bytes, its header says {length:,}"


def newest_checkpoint(folder: Path) -> int:
    """Return the step of a run's newest checkpoint; -1: it has none."""
    from gsx.core.files import sidecars, step_of

    return max(map(step_of, sidecars(folder / "checkpoints")), default=-1)


def checkpoint_problem(folder: Path) -> str:
    """Describe what is wrong with a run's newest checkpoint by its sidecar and header; empty: nothing, or none."""
    from safetensors import SafetensorError, safe_open

    from gsx.core.files import sidecars, step_of
    from gsx.experiments.run_folder.checkpoint import is_valid

    for sidecar in sidecars(folder / "checkpoints")[-1:]:
        tensors = sidecar.with_suffix(".safetensors")
        try:
            meta = read_json(sidecar)
            with safe_open(tensors, "numpy"):  # compares the file's size with its header
                pass
        except FileNotFoundError:
            return ""
        except (OSError, ValueError, SafetensorError) as error:
            return f"checkpoint {tensors.name} cannot be read ({error})"
        if not (isinstance(meta, dict) and is_valid(meta, step_of(sidecar))):
            return f"checkpoint {sidecar.name} is not what gsx writes"
    return ""
