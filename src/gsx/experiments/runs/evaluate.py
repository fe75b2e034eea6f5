"""evaluation.json and the pictures of a run, and its summary in the log."""

import logging
import time
from collections.abc import Iterator
from typing import Any

from gsx.augmenters.store import load_views, picture_name
from gsx.core.data.images import write_image
from gsx.core.errors import TooManyPairs, first_line
from gsx.core.files import write_json
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.competitor import Competitor, competitor_for, context_of
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.evaluation.perceptual import COMPARED
from gsx.experiments.evaluation.remarks import measures_nothing, remarks_of
from gsx.experiments.evaluation.view_coverage import SceneCoverage, coverage_lines, coverage_of
from gsx.experiments.reports.pictures import Pictures
from gsx.experiments.run_folder.files import (
    DETAIL_OF,
    detail_share,
    part,
    perceptual_figure,
    perceptual_names,
    read_run,
    upscaler_of,
)
from gsx.experiments.run_folder.run_key import evaluation_settings
from gsx.experiments.runs.flight import add_depth, add_flight
from gsx.experiments.runs.progress import Countdown
from gsx.experiments.runs.retakes import takes_photos, write_retakes
from gsx.experiments.runs.settings import Settings

logger = logging.getLogger(__name__)


def evaluate(run: Run, settings: Settings) -> dict[str, Any]:
    """Write evaluation.json and the pictures of a run; return the evaluation."""
    options, started = settings.evaluation, time.perf_counter()
    evaluator = Evaluator(run, options, competitor_of(run, settings))
    pictures = Pictures(run.folder / "renders", run.step)
    if run.scene.test:
        logger.info("evaluating %d test views at zoom %s", len(run.scene.test), options.zoom)
        if evaluator.lpips is None:
            logger.info("LPIPS is not measured without weights: metrics.lpips.trunk=FILE metrics.lpips.head=FILE")
    evaluation = evaluator.evaluate(pictures, Countdown("evaluating", evaluator.work()).advance)
    if run.scene.test:
        add_depth_and_flight(run, pictures, options)
    pictures.write_index()
    write_pseudo_pictures(run, options)
    coverage = coverage_or_none(run, options, evaluation)
    evaluation |= {
        "evaluate_seconds": time.perf_counter() - started,
        "settings": evaluation_settings(settings.resolved),
    }
    files = read_run(run.folder)
    if doubts := files.environment.get("start"):
        evaluation["start"] = doubts
    if run.scene.notes:
        evaluation["scene_notes"] = list(run.scene.notes)
    warn_of_paths(files.evaluation, evaluation)
    write_json(run.folder / "evaluation.json", evaluation)
    for line in [*summary(evaluation), *remedies(run, evaluation, options.remedy), *advice(evaluation, settings)]:
        logger.info("%s", line)
    if coverage is not None and takes_photos(run):
        for line in write_retakes(run, coverage, options.tile_pixels):
            logger.info("%s", line)
    return evaluation


def coverage_or_none(run: Run, options: EvalOptions, evaluation: dict[str, Any]) -> SceneCoverage | None:
    """Add the coverage of views to an evaluation, or the reason why it is unknown (then return None)."""
    try:
        coverage = coverage_of(run, options)
    except (RuntimeError, TooManyPairs, MemoryError) as error:
        evaluation["coverage"] = {"unavailable": first_line(error)}
        return None
    evaluation |= coverage.figures(evaluation["views"], options.right_halves)
    return coverage


def competitor_of(run: Run, settings: Settings) -> Competitor | None:
    """Return the upscaler of x1 renders for the evaluated zooms; None: there is none, or it reaches none of them."""
    if (chosen := settings.competitor) is None:
        return None
    component, zooms = chosen.component, settings.evaluation.zoom
    context = context_of(run, component.name)
    return competitor_for(run.scene, component.name, lambda: component.factory(chosen.options), zooms, context)


def add_depth_and_flight(run: Run, pictures: Pictures, options: EvalOptions) -> None:
    """Draw depth and a flight for the report; figures are kept if drawing fails, not if writing does (InputError)."""
    try:
        add_depth(run, pictures, options.tile_pixels)
        if options.flight:
            add_flight(run, pictures, options.tile_pixels)
    except (RuntimeError, TooManyPairs, MemoryError) as error:
        logger.warning("the report has no depth or flight (%s)", first_line(error))


def warn_of_paths(before: dict[str, Any], now: dict[str, Any]) -> None:
    """Warn if an earlier evaluation was timed with another path of the rasterizer."""
    path = before.get("render_path")
    if path and path != now["render_path"] and before.get("render_fps"):
        logger.warning(
            "renders/s are measured with the %s path; the %.1f of the evaluation before (%s path) are not comparable",
            *(now["render_path"], before["render_fps"], path),
        )


def summary(evaluation: dict[str, Any]) -> list[str]:
    """Return the result in a few lines."""
    e = evaluation
    memory = "n/a" if e["peak_memory_mb"] is None else f"{e['peak_memory_mb']:,.0f} MB"
    speed = "" if e["render_fps"] is None else f"{e['render_fps']:.1f} renders/s ({e['render_path']}), "
    cost = (
        f"{e['primitives']:,} primitives, {e['megabytes']:.1f} MB, {speed}"
        f"{e['train_seconds']:.0f} s of training, {e['evaluate_seconds']:.0f} s of evaluation, "
        f"peak memory {memory}"
    )
    if measures_nothing(e):
        return [cost, *coverage_lines(e), *remarks_of(e)]
    lpips = "n/a (no weights)" if e["lpips"] is None else f"{e['lpips']:.4f}"
    quality = f"held-out PSNR {e['psnr']:.2f} dB, SSIM ({e['protocol']['ssim']}) {e['ssim']:.4f}, LPIPS {lpips}"
    quality += "".join(f", {name} {perceptual_figure(e, name):.4f}" for name in perceptual_names(e))
    quality += f", depth error {e['depth']['relative']:.1%}" if "depth" in e else ""
    lines = [line for factor, result in e["zoom"].items() for line in zoom_lines(factor, result, upscaler_of(e))]
    return [quality, cost, *coverage_lines(e), *lines, *remarks_of(e)]


def remedies(run: Run, evaluation: dict[str, Any], remedy: str) -> list[str]:
    """Return what to try if a plain model's zoomed render loses to the enlarged one."""
    lost = [
        factor for factor, e in evaluation["zoom"].items() if float(factor) > 1 and e.get("beats_enlarged") is False
    ]
    if not lost or not remedy or run.raster.compensate or run.raster.zoomed != "plain":
        return []
    return [f"for a model that is filtered for zooming in, repeat the command with {remedy}"]


def zoom_lines(factor: str, result: dict[str, Any], upscaler: str) -> list[str]:
    """Return the result at one zoom in lines."""
    return [zoom_line(factor, result, upscaler), *consistency_lines(factor, result, upscaler)]


def advice(evaluation: dict[str, Any], settings: Settings) -> list[str]:
    """Return what else to try on photos: a pretrained upscaler, if one is installed and training used none."""
    words, scene = settings.evaluation.advice, part(settings.resolved, "scene")
    if not words or not scene.get("path") or settings.augmenters or "networks" not in part(evaluation, "competitor"):
        return []
    return [f"a pretrained upscaler is installed: {words} trains on photos that it enlarges, in about twice the time"]


def zoom_line(factor: str, result: dict[str, Any], upscaler: str = "an upscaler") -> str:
    """Return the result at one zoom in words; `upscaler`: name of the other competitor."""
    if "unavailable" in result:
        return f"zoom x{factor}: n/a, {result['unavailable']}"
    if factor == "1":
        return f"zoom x1: {result['psnr']:.2f} dB"
    resized = "enlarged" if float(factor) > 1 else "reduced"
    text = f"zoom x{factor}: {result['psnr']:.2f} dB"
    for rival, words in {
        "enlarged": f"the {resized} x1 render",
        "upscaled": f"the x1 render enlarged by {upscaler}",
    }.items():
        if f"{rival}_psnr" in result:
            verdict = "wins against" if result[f"beats_{rival}"] else "loses to"
            text += f", {verdict} {words} ({result[f'{rival}_psnr']:.2f} dB)"
    names = {"enlarged": f"x1 {resized}", "upscaled": f"by {upscaler}", "photograph": "photo"}
    return text + detail_text(result, names) + "".join(perceptual_texts(result, names))


def detail_text(result: dict[str, Any], names: dict[str, str]) -> str:
    """Return the explained detail of a zoom's pictures; empty if it is unknown for the render."""
    shares = {kind: share for kind in DETAIL_OF if (share := detail_share(result, kind)) is not None}
    if "render" not in shares:
        return ""
    others = ", ".join(f"{names[kind]}: {share:+.3f}" for kind, share in shares.items() if kind != "render")
    return f"; detail {shares['render']:+.3f} ({others})"


def perceptual_texts(result: dict[str, Any], names: dict[str, str]) -> Iterator[str]:
    """Yield the perceptual figures of a zoom's pictures by metric."""
    for metric in part(result, "perceptual"):
        figures = {kind: value for kind in COMPARED if (value := perceptual_figure(result, metric, kind)) is not None}
        if "render" in figures:
            others = ", ".join(f"{names[kind]}: {value:.4f}" for kind, value in figures.items() if kind != "render")
            yield f"; {metric} {figures['render']:.4f} ({others})"


def consistency_lines(factor: str, result: dict[str, Any], upscaler: str) -> list[str]:
    """Return the consistency of neighbouring views at a zoom in words; none if it was not measured."""
    levels, detail = part(result, "consistency"), part(part(result, "consistency"), "detail")
    names = {"render": "", "enlarged": "x1 enlarged: ", "upscaled": f"by {upscaler}: ", "truth": "photos: "}
    texts = [
        f"{name}{levels[kind]:.2f} dB" + (f", detail {detail[kind]:.2f}" if kind in detail else "")
        for kind, name in names.items()
        if kind in levels
    ]
    return [f"zoom x{factor}: neighbouring views agree to {texts[0]} ({'; '.join(texts[1:])})"] if texts else []


MOST_VIEWS = 6
"""Pseudo views of each augmenter in the report."""


def write_pseudo_pictures(run: Run, options: EvalOptions) -> None:
    """Render pseudo views of the last events that have pictures by augmenters, and write their index."""
    folder = run.folder / "pseudo"
    entries: list[dict[str, Any]] = []
    latest = {path.stem.rpartition("_")[0]: path for path in sorted(folder.glob("*.safetensors"))}
    for augmenter, path in latest.items():
        try:
            views, _ = load_views(path)
        except (OSError, ValueError) as error:
            logger.warning("%s cannot be read (%s): the report omits its pseudo views", path, error)
            continue
        complete = [view for view in views if {"event", "scale", "kind"} <= view.provenance.keys()]
        by_name = {picture_name(augmenter, view): view for view in complete}  # one view for each picture
        pictured = [view for name, view in by_name.items() if (folder / name).is_file()][:MOST_VIEWS]
        entries += [picture_entry(run, options, augmenter, view) for view in pictured]
    if entries:
        write_json(folder / "index.json", {"views": entries})


def picture_entry(run: Run, options: EvalOptions, augmenter: str, view: PseudoView) -> dict[str, Any]:
    """Render one pseudo view; return its entry in the index."""
    after = render(run, view.camera, options.tile_pixels).image
    made = picture_name(augmenter, view)
    name = made.replace(".png", "_after.png")
    write_image(run.folder / "pseudo" / name, after)
    return {"augmenter": augmenter, "made": made, "after": name, **view.provenance}
