"""Commands on what a run left, in folders of their own, and what has to be the same whatever happens to them."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tiny import OVERRIDES, tiny_run

from faults.children import in_child, preload, run_in_child
from gsx.cli.dispatch import main
from gsx.engine.cache import IN_USE, released

EVENT = [f"augmenter.upscale.timing.{key}=10000" for key in ("start", "every", "span")]
"""Pseudo views once, at step 2 of 6 or 8."""
STEPS = ["iterations=6", "training.checkpoint_every=2", "training.log_every=1", "rasterizer=eager", "eval.zoom=[1,2]",
         "augmenter=[upscale]", "regenerator/upscale=lanczos", *EVENT]  # fmt: skip
TABLE = ["+experiment=table_frameworks", "dataset=demo", "budget=smoke", "experiment.only=[3D-GS,3D-GS-UP]",
         "iterations=2", "training.checkpoint_every=2", "scene.width=48", "scene.height=36", "scene.train_views=6",
         "scene.test_views=2", "scene.points=300", "scene.samples=1", "training.test_points=0", "device=cpu",
         "rasterizer=eager", "regenerator/upscale=lanczos"]  # fmt: skip
TIMES = (
    "seconds",
    "train_seconds",
    "peak_memory_mb",
    "render_seconds",
    "evaluate_seconds",
    "render_fps",
    "steps_per_second",
)
"""What is another each time."""


@dataclass(frozen=True)
class Verb:
    """A command, what it finds, and what it has to leave."""

    words: list[str]
    prepare: Callable[[], Any]
    """In the folder in which the command is given."""
    result: Callable[[Path], str]
    """Digest of what it leaves, by that folder."""
    sentences: int = 1
    """That it may say when it fails: a table tells of each of its runs."""
    every: int = 1
    """Of its calls one in so many is tried."""


def nothing() -> None:
    """An empty folder."""


def stopped() -> None:
    """A run that was interrupted after its third step."""
    tiny_run(Path("run"), STEPS, stop_after=3)


def finished() -> None:
    """A run that came to its end, with all that the command line leaves."""
    assert main([*OVERRIDES, *STEPS, "folder=run"]) == 0


def model(place: Path) -> str:
    """The newest checkpoint, which is of the last step."""
    return newest(place / "run" / "checkpoints")


def all_of_run(place: Path) -> str:
    """All results of the run `run`."""
    return all_of(place / "run")


def all_of(run: Path) -> str:
    """The newest checkpoint of a run folder, and all other results."""
    return newest(run / "checkpoints") + everything(run)


def newest(folder: Path) -> str:
    """The last of some checkpoints."""
    last = sorted(folder.glob("*.safetensors"))[-1]
    assert last.stem == "step_0000006"
    return digest_of(last.read_bytes())


def file(name: str) -> Callable[[Path], str]:
    """A file as it is."""
    return lambda place: digest_of((place / name).read_bytes())


def pictures(place: Path) -> str:
    """The test views that `gsx render` draws."""
    found = sorted((place / "run" / "renders" / "test").glob("*.png"))
    assert len(found) == 2
    return digest_of(b"".join(path.read_bytes() for path in found))


def figures(place: Path) -> str:
    """What an evaluation leaves."""
    return everything(place / "run")


def timeless(value: Any) -> Any:
    """A JSON value without what is another each time."""
    if isinstance(value, dict):
        return {key: timeless(inner) for key, inner in value.items() if key not in TIMES}
    return [timeless(inner) for inner in value] if isinstance(value, list) else value


def model_by_name(place: Path) -> str:
    """The newest checkpoint of the only run, which is named by its composition."""
    (folder,) = place.glob("outputs/demo/gs3d/[!.]*/checkpoints")
    return newest(folder)


def all_by_name(place: Path) -> str:
    """All results of the only run, which is named by its composition."""
    (run,) = place.glob("outputs/demo/gs3d/[!.]*")
    return all_of(run)


def everything(run: Path) -> str:
    """Results of a finished run beside its checkpoints: pictures, splat file, figures, a report without complaints."""
    pictures = sorted(path for path in run.rglob("*.png") if "/renders/" in str(path) or "/pseudo/" in str(path))
    assert len(pictures) > 3
    assert 'class="notice' not in (run / "report.html").read_text()
    figures = repr(timeless(json.loads((run / "evaluation.json").read_text()))).encode()
    return digest_of(b"".join(path.read_bytes() for path in [*pictures, run / "point_cloud.ply"]) + figures)


def models(place: Path) -> str:
    """The newest checkpoints of all runs of a table, which has a line for each."""
    runs = sorted(place.glob("outputs/demo/gs3d/*/checkpoints"))
    assert len(runs) == len(list(place.glob("outputs/demo/gs3d/*/evaluation.json"))) == 2
    (table,) = place.glob("outputs/experiments/*/table.csv")
    assert "failed" not in table.read_text()
    return digest_of(b"".join(sorted(run.glob("*.safetensors"))[-1].read_bytes() for run in runs))


def digest_of(content: bytes) -> str:
    """SHA-256."""
    return hashlib.sha256(content).hexdigest()


VERBS = {
    "resume": Verb(["resume", "run"], stopped, all_of_run),
    "eval": Verb(["eval", "run", "eval.zoom=[1]"], finished, figures),
    "report": Verb(["report", "run"], finished, file("run/report.html")),
    "export": Verb(["export", "run", "model.ply"], finished, file("model.ply")),
    "render": Verb(["render", "run"], finished, pictures),
    "train": Verb([*OVERRIDES, *STEPS, "folder=run"], nothing, model),
    "reuse": Verb([*OVERRIDES, *STEPS, "reuse=true"], nothing, all_by_name),
    "table": Verb(TABLE, nothing, models, sentences=3, every=8),
    "page": Verb(["report", "run", "--to", "page"], finished, file("page/report.html")),
}
"""By name."""


@dataclass
class Prepared:
    """A verb with the folder that it finds, which is put back before each case."""

    verb: Verb
    place: Path
    template: Path
    expected: str

    def put_back(self) -> None:
        """As it was before the command."""
        shutil.rmtree(self.place, ignore_errors=True)
        shutil.copytree(self.template, self.place)


def prepared(verb: Verb, folder: Path) -> Prepared:
    """A verb with what it finds, and what it leaves when nothing happens to it."""
    place, template = folder / "place", folder / "template"
    preload([*OVERRIDES, *STEPS], folder / "first")

    def job() -> int:
        verb.prepare()
        return 0

    ended = in_child(job, place)
    assert ended.code == 0, ended.said
    shutil.copytree(place, template)
    whole = run_in_child(verb.words, place)
    assert whole.code == 0, whole.said
    return Prepared(verb=verb, place=place, template=template, expected=verb.result(place))


def orphans(place: Path) -> list[str]:
    """Temporary files and locks that are left; not signs that the cache is used, which are void without a process and
    removed when somebody needs room.
    """
    left = [path for path in place.rglob(".*") if "partial" in path.name or path.name.endswith(".lock")]
    return [str(path) for path in left if path.parent.name != IN_USE or not released(path)]
