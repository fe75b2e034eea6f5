"""gsx compact: a run or a splat file in, a smaller run folder out, with its candidates and their quality."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from gsx.core.errors import InputError, command
from gsx.core.files import read_json, replace_file, write_json
from gsx.core.plugins import Plugins
from gsx.core.seeds import derived_seed
from gsx.core.training.run import Run
from gsx.experiments.compact.fine_tuning import drop_bands
from gsx.experiments.compact.quality import QUANTISED, write_files, zoomed_psnr
from gsx.experiments.compact.shrink import Search, ShrinkOptions
from gsx.experiments.evaluation.remarks import measures_nothing
from gsx.experiments.reports.overview import write_overview
from gsx.experiments.run_folder import checkpoint
from gsx.experiments.run_folder.claims import LOCK, claimed
from gsx.experiments.runs.build import build
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import finish
from gsx.experiments.runs.export import own_columns
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

FILE_STEPS = 2000
"""Steps of the run that a splat file stands at the end of: its learning rates are those of that run's last step."""
SHARE = 0.1
"""Share of a run's steps that each candidate learns on for, by default."""
ELSEWHERE = "give another with --to FOLDER"
"""Remedy for a folder in use."""
NAME, COMPARED = "compact.json", "compared"
"""File with all candidates; folder of the page with the model before and after."""


def compact(
    target: Path, to: Path, max_drop: float, steps: int | None, overrides: Sequence[str], plugins: Plugins
) -> Path:
    """Writes a smaller run of a run folder or splat file to a new folder; returns its report.

    Raises:
        ConfigError, InputError: the folder is in use, the target is neither or not finished, or a file has no scene.
    """
    refuse_used(str(to), ELSEWHERE)
    run, settings = opened(target, overrides, plugins)
    with claimed_anew(to):
        warm(run)
        steps = max(1, round(SHARE * run.iterations)) if steps is None else steps
        generator = torch.Generator().manual_seed(derived_seed("compact", settings.general.seed))
        search = Search(run, ShrinkOptions(max_drop=max_drop, steps=steps), plugins, generator)
        logger.info("%d validation views: %s dB", len(search.validation), search.reference)
        best = search.smallest()
        if best is search.untouched:
            logger.warning("no smaller model is within %.3g dB: the new folder holds the model as it was", max_drop)
        smaller, settings = saved(search.trained(best), settings, target, to, best.degree, plugins)
        record: dict[str, Any] = {
            "from": str(target.resolve()),
            "max_drop_db": max_drop,
            "judges": [view.name for view in search.validation],
            "learnt_on_steps": steps,
            "before": {
                "primitives": search.untouched.primitives,
                "psnr": search.before,
                "learnt_on": search.reference,
            },
            "tries": [candidate.as_json() for candidate in search.candidates],
            "chosen": best.as_json(),
            "formats": formats(smaller, search, best.drop),
        }
        write_json(to / NAME, record)
        evaluation = finish(smaller, settings, plugins)
    log_result(target, evaluation, record)
    return overview(target, to)


@contextmanager
def claimed_anew(to: Path) -> Iterator[None]:
    """Claims a new folder; removes it where nothing was written.

    Raises:
        InputError: it is in use.
    """
    existed = to.is_dir()
    to.mkdir(parents=True, exist_ok=True)
    try:
        with claimed(to):
            refuse_used(str(to), ELSEWHERE)
            yield
    finally:
        if not existed and not any(path.name != LOCK for path in to.iterdir()):
            shutil.rmtree(to, ignore_errors=True)


def opened(target: Path, overrides: Sequence[str], plugins: Plugins) -> tuple[Run, Settings]:
    """Opens the run to make smaller: of a folder, or one that a splat file stands at the end of.

    Raises:
        InputError: the run is not finished, or was never trained.
    """
    if target.is_dir():
        run, settings = open_run(target, plugins, overrides, evaluating=True)
        if not run.complete:
            raise InputError(
                f"{target} is at step {run.step} of {run.iterations}: `{command('resume', target)}` finishes it first"
            )
        if not run.iterations:
            raise InputError(f"{target} evaluated a splat file and trained nothing. Give that file, and its scene=...")
        run.raster = as_trained(run)
        return run, settings
    words = [word for word in composition_of(target, overrides) if not word.startswith("iterations=")]
    settings = compose([*words, f"iterations={FILE_STEPS}"], plugins)
    content, scene = starting_splats(settings), verified(load_scene(settings))
    start, _ = start_in_scene(settings, scene, content)
    run = build(settings, scene, Path(), training=True, start=start)
    run.step = run.iterations
    return run, settings


def saved(run: Run, settings: Settings, target: Path, to: Path, degree: int, plugins: Plugins) -> tuple[Run, Settings]:
    """Writes a smaller run to its folder; returns it as it opens from there."""
    config = settings.resolved | {"folder": str(to)}
    if degree >= 0:
        config |= {"backbone": config["backbone"] | {"sh_degree": degree}}
        drop_bands(run.backbone.table, degree)
    write_config(to / "config.yaml", config)
    for name in ("environment.json", "metrics.jsonl"):
        if (target / name).is_file():
            replace_file(to / name, (target / name).read_bytes())
    checkpoint.save(replace(run, folder=to))
    opened, settings = open_run(to, plugins)
    opened.raster = run.raster
    return opened, settings


def formats(run: Run, search: Search, lost: float) -> dict[str, dict[str, Any]]:
    """Writes the standard file and the smallest quantised one within the budget; returns bytes and drop by suffix.

    `lost`: what the model has lost on the validation views. Empty for models without a standard form.
    """
    if own_columns(run) is not None:
        return {}
    before = zoomed_psnr(run, search.validation, search.options.zooms)
    files = write_files(run, search.validation, before, run.folder, (STANDARD, *QUANTISED))
    within = [suffix for suffix, file in files.items() if lost + file.lost <= search.options.max_drop]
    smallest = min(within or [STANDARD], key=lambda suffix: files[suffix].bytes)
    kept = (STANDARD, smallest)
    for suffix in files.keys() - kept:
        (run.folder / f"point_cloud{suffix}").unlink()
    return {
        suffix: {"bytes": file.bytes, "drop": lost + file.lost, "kept": suffix in kept}
        for suffix, file in files.items()
    }


def log_result(target: Path, evaluation: dict[str, Any], record: dict[str, Any]) -> None:
    """Logs size and quality, before and after where that is known."""
    chosen, before, budget = record["chosen"], record["before"], record["max_drop_db"]
    logger.info("%d primitives of %d", evaluation["primitives"], before["primitives"])
    for suffix, facts in record["formats"].items():
        note = "" if facts["kept"] else " (not kept)"
        logger.info(
            "%s: %.2f MB, drop %.2f dB on validation views%s", suffix, facts["bytes"] / 1e6, facts["drop"], note
        )
    path = target / "evaluation.json"
    former = read_json(path) if path.is_file() else {}
    if measures_nothing(evaluation):
        logger.info("drop %.2f dB <= %.3g dB on validation views", chosen["drop"], budget)
    elif former.get("psnr") is not None:
        logger.info(
            "test views: %.2f dB, before %.2f dB: drop %.2f dB; on validation views %.2f dB <= %.3g dB",
            *(evaluation["psnr"], former["psnr"], former["psnr"] - evaluation["psnr"], chosen["drop"], budget),
        )


def overview(target: Path, to: Path) -> Path:
    """Writes a page with both models side by side if `target` is a run; returns that page, else the report."""
    if not target.is_dir():
        return to / "report.html"
    (to / COMPARED).mkdir(exist_ok=True)
    return write_overview(to / COMPARED, [target, to])
