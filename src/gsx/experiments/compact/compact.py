"""gsx compact: a run or a splat file in, a smaller run folder out, with what was tried and what it cost."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from gsx.core.errors import ConfigError, InputError, command, first_line
from gsx.core.files import read_json, replace_file, write_json
from gsx.core.plugins import Plugins
from gsx.core.seeds import derived_seed
from gsx.core.training import checkpoint
from gsx.core.training.run import Run
from gsx.experiments.compact.shrink import (
    Shrinking,
    ShrinkOptions,
    Try,
    degree_of_run,
    figures,
    shorten_colours,
    told,
    without_bands,
)
from gsx.experiments.evaluation.remarks import measures_nothing
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.run_folder.claims import LOCK, claimed
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import finish
from gsx.experiments.runs.export import export, own_columns, read_again
from gsx.experiments.runs.file_axes import start_in_scene
from gsx.experiments.runs.load_scene import load_scene
from gsx.experiments.runs.open import as_trained, open_run, refuse_used
from gsx.experiments.runs.rasterizer_path import warm
from gsx.experiments.runs.saved_settings import write_config
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.start_file import composition_of, starting_splats
from gsx.experiments.runs.verified import verified
from gsx.formats.suffixes import STANDARD

logger = logging.getLogger(__name__)

FORMATS = (".sog", ".compressed.ply", ".spz")
"""Quantised files that are tried, beside the standard one."""
FILE_STEPS = 2000
"""Of a run that a splat file stands at the end of: its learning rates are those of such a run's last step."""
SHARE = 0.1
"""Of a run's steps that are taken to learn on, where nothing is said."""
ELSEWHERE = "give another with --to FOLDER"
"""What to do about a folder in use."""
NAME, COMPARED = "compact.json", "compared"
"""What was tried; folder of the page with the model before and after."""


def compact(
    target: Path, to: Path, max_drop: float, steps: int | None, overrides: Sequence[str], plugins: Plugins
) -> Path:
    """Write a smaller run of a run folder or splat file to a new folder; returns its report.

    Raises:
        ConfigError, InputError: the folder is in use, the target is neither or not finished, or a file has no scene.
    """
    refuse_used(str(to), ELSEWHERE)
    run, settings = opened(target, overrides, plugins)
    with claimed_anew(to):
        warm(run)
        steps = max(1, round(SHARE * run.iterations)) if steps is None else steps
        generator = torch.Generator().manual_seed(derived_seed("compact", settings.general.seed))
        shrinking = Shrinking(run, ShrinkOptions(max_drop=max_drop, steps=steps), plugins, generator)
        logger.info("judged by %d training views: %s", len(shrinking.judging), shrinking.reference)
        best = shrinking.smallest()
        if best not in shrinking.tried:
            logger.warning("nothing could go within %.3g dB: the new folder holds the model as it was", max_drop)
        shrinking.take(best)
        best = for_smallest_file(run, shrinking, best)
        found: dict[str, Any] = {
            "from": str(target.resolve()),
            "max_drop_db": max_drop,
            "judges": [view.name for view in shrinking.judging],
            "learnt_on_steps": steps,
            "before": {"primitives": len(shrinking.worth), "psnr": shrinking.before, "learnt_on": shrinking.reference},
            "tries": told(shrinking.tried),
            "chosen": told([best])[0],
        }
        run, settings = begin(run, settings, target, to, best.degree, plugins)
        found["formats"] = formats(run, shrinking, best.drop, max_drop)
        write_json(to / NAME, found)
        evaluation = finish(run, settings, plugins)
    tell(target, evaluation, found)
    return overview(target, to)


@contextmanager
def claimed_anew(to: Path) -> Iterator[None]:
    """A new folder, claimed; nothing is left of it where nothing was written.

    Raises:
        InputError: it is in use.
    """
    there = to.is_dir()
    to.mkdir(parents=True, exist_ok=True)
    try:
        with claimed(to):
            refuse_used(str(to), ELSEWHERE)
            yield
    finally:
        if not there and not any(path.name != LOCK for path in to.iterdir()):
            shutil.rmtree(to, ignore_errors=True)


def opened(target: Path, overrides: Sequence[str], plugins: Plugins) -> tuple[Run, Settings]:
    """The run to make smaller: of a folder, or one that a splat file stands at the end of.

    Raises:
        InputError: the run is not finished, or was never trained.
    """
    if target.is_dir():
        run, settings = open_run(target, plugins, overrides)
        if not run.complete:
            raise InputError(
                f"{target} is at step {run.step} of {run.iterations}: `{command('resume', target)}` finishes it first"
            )
        if not run.iterations:
            raise InputError(f"{target} judged a splat file and trained nothing: give that file, and its scene=...")
        run.raster = as_trained(run)
        return run, settings
    words = [word for word in composition_of(target, overrides) if not word.startswith("iterations=")]
    settings = compose([*words, f"iterations={FILE_STEPS}"], plugins)
    content, scene = starting_splats(settings), verified(load_scene(settings))
    start, _ = start_in_scene(settings, scene, content)
    run = build(settings, scene, Path(), training=True, start=start)
    run.step = run.iterations
    return run, settings


def begin(run: Run, settings: Settings, target: Path, to: Path, degree: int, plugins: Plugins) -> tuple[Run, Settings]:
    """The new folder, with the smaller model as its checkpoint; the run as it opens from there."""
    config = settings.resolved | {"folder": str(to)}
    if degree >= 0:
        config |= {"backbone": config["backbone"] | {"sh_degree": degree}}
        shorten_colours(run, degree)
    run.folder = to
    write_config(to / "config.yaml", config)
    for name in ("environment.json", "metrics.jsonl"):
        if (target / name).is_file():
            replace_file(to / name, (target / name).read_bytes())
    checkpoint.save(run)
    again, settings = open_run(to, plugins)
    again.raster = run.raster
    return again, settings


# -- files -------------------------------------------------------------------------------------------------------------


def for_smallest_file(run: Run, shrinking: Shrinking, best: Try) -> Try:
    """The try that the run now is: where no quantised file of the smallest model keeps the promise, one that leaves
    room for what such a file loses, if its file is smaller than the smallest model's standard one."""
    if own_columns(run) is not None:
        return best
    with TemporaryDirectory() as scratch:
        files = written(run, shrinking, Path(scratch), (STANDARD, *FORMATS), best.degree)
        most, options = files.pop(STANDARD).bytes, shrinking.options
        if any(best.drop + file.lost <= options.max_drop for file in files.values()):
            return best
        sizes = [
            (file.bytes / best.megabytes * made.megabytes, suffix, made)
            for suffix, file in files.items()
            for made in shrinking.within(file.lost)[:1]
        ]
        expected = sorted((one for one in sizes if one[0] < most), key=lambda one: one[0])
        for _, suffix, made in expected:
            logger.info("%d primitives instead, so that %s keeps the promise", made.primitives, suffix)
            shrinking.take(made)
            file = written(run, shrinking, Path(scratch), (suffix,), made.degree).get(suffix)
            if file is not None and made.drop + file.lost <= options.max_drop and file.bytes < most:
                return made
        if expected:
            shrinking.take(best)
    return best


@dataclass(frozen=True)
class File:
    """A file of the model as it is."""

    bytes: int
    lost: float
    """The most that it loses of the model at any zoom, in the views that judge, dB."""


def written(run: Run, shrinking: Shrinking, folder: Path, suffixes: Sequence[str], degree: int) -> dict[str, File]:
    """Files of the model, with bands up to a degree, in a folder, by suffix; without those that cannot be written."""
    out, own = dict[str, File](), figures(run, shrinking.judging, [float(zoom) for zoom in shrinking.before])
    for suffix in suffixes:
        path = folder / f"point_cloud{suffix}"
        try:
            with without_bands(run, degree):
                export(run, path)
            again = read_again(path, origin=run.scene.origin)
            read = figures(run, shrinking.judging, [float(zoom) for zoom in own], again)
            out[suffix] = File(path.stat().st_size, max(own[zoom] - read[zoom] for zoom in own))
        except (ConfigError, InputError) as error:  # a package is missing, or a value is beyond what it holds
            path.unlink(missing_ok=True)
            logger.info("no %s: %s", suffix, first_line(error))
    return out


def formats(run: Run, shrinking: Shrinking, lost: float, max_drop: float) -> dict[str, dict[str, Any]]:
    """Bytes and drop of every file of the model, by suffix: what the model has `lost` in views that judged it, and what
    the file loses of it now. Of the quantised ones only the smallest within the budget is left. None for models without
    a standard form."""
    if own_columns(run) is not None:
        return {}
    files = written(run, shrinking, run.folder, (STANDARD, *FORMATS), degree_of_run(run))
    out: dict[str, dict[str, Any]] = {
        suffix: {"bytes": file.bytes, "drop": lost + file.lost} for suffix, file in files.items()
    }
    within = [suffix for suffix, facts in out.items() if facts["drop"] <= max_drop]
    smallest = min(within or [STANDARD], key=lambda suffix: out[suffix]["bytes"])
    for suffix in out:
        out[suffix]["kept"] = suffix in (STANDARD, smallest)
        if not out[suffix]["kept"]:
            (run.folder / f"point_cloud{suffix}").unlink()
    return out


# -- what is told ------------------------------------------------------------------------------------------------------


def tell(target: Path, evaluation: dict[str, Any], found: dict[str, Any]) -> None:
    """What became of it, beside what it was where that is known."""
    chosen, before = found["chosen"], found["before"]
    logger.info("%d primitives of %d", evaluation["primitives"], before["primitives"])
    for suffix, facts in found["formats"].items():
        note = "" if facts["kept"] else " (not kept)"
        logger.info(
            "%s: %.2f MB, %.2f dB lost in views that judge%s", suffix, facts["bytes"] / 1e6, facts["drop"], note
        )
    was = read_json(target / "evaluation.json") if (target / "evaluation.json").is_file() else {}
    if measures_nothing(evaluation):
        logger.info("promised %.3g dB, %.2f lost in training views that judge", found["max_drop_db"], chosen["drop"])
    elif was.get("psnr") is not None:
        logger.info(
            "test views: %.2f dB, before %.2f: %.2f lost; promised %.3g, %.2f in views that judge",
            *(evaluation["psnr"], was["psnr"], was["psnr"] - evaluation["psnr"], found["max_drop_db"], chosen["drop"]),
        )


def overview(target: Path, to: Path) -> Path:
    """A page with the model before and after side by side, where there was a run before; else the report."""
    if not target.is_dir():
        return to / "report.html"
    (to / COMPARED).mkdir(exist_ok=True)
    return write_overview(to / COMPARED, [target, to])
