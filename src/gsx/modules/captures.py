"""What training photographs have wrong: asked before a step where that is due, and mended (docs/photographs.md)."""

import logging
import math
import time
from collections.abc import Iterator, Sequence
from statistics import median

from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.coarser import coarser
from gsx.core.data.scene import View
from gsx.core.rasterizer import TiledRendering
from gsx.core.shapes import Bool, Float
from gsx.core.training.importance import Probe
from gsx.core.training.parameter_table import keep_rows
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.modules.alignment import aligned, usual_depth
from gsx.modules.distractor_masks import Difference, difference_of, distractors_in
from gsx.modules.distractors import share_of, without_marked
from gsx.modules.exposure import LIGHT, Pair, log_gains
from gsx.modules.motion_blur import Movement, movement_between
from gsx.modules.poses import CORRELATED_PIXELS, shifts_by_half, spread_of_shifts, usual_shift

logger = logging.getLogger(__name__)

SMALLER = 2
"""By how much smaller pictures are than photographs that exposures, poses and distractors are told from: in a third of
the time as well."""
POSE_PIXELS = 1 << 13
"""Of pictures that poses are told from, at least: those of small photographs are not made smaller."""
BLUR_PIXELS = 1 << 18
"""Of pictures that movements are estimated from."""


def judge_photographs(run: Run) -> dict[str, float]:
    """Ask whatever is due before the next step; for its line of metrics.jsonl."""
    told = judge_poses(run) if run.poses.due(run.step + 1) else {}
    told |= judge_exposures(run) if run.exposures.due(run.step + 1) else {}
    told |= judge_blur(run) if run.blur.due(run.step + 1) else {}
    return told | (judge_distractors(run) if run.distractors.due(run.step + 1) else {})


def judge_exposures(run: Run) -> dict[str, float]:
    """Whether training photographs have exposures of their own, where that is asked first, and which, from what the
    model shows in their places; for the line of the step."""
    begun, number, exposures, views = time.perf_counter(), run.step + 1, run.exposures, run.train_views

    def look(index: int) -> Pair:
        run.refuse_if_stopping()
        small, shown = seen_smaller(run, views[index], depth=False)
        image = run.as_photographed(shown.image, small).detach().cpu()
        return image, small.image(), unsaturated(shown.image, small.counted())

    if exposures.matrices is None:
        found = told_of_light(run, *exposures.judge(look, number))
    else:
        found = {"exposures": len(views), "exposure_motion": exposures.tell(look, number)}
        logger.info("step %d: exposures are told again: %.1f %% off", number, 100 * found["exposure_motion"])
    return found | {"exposure_seconds": round(time.perf_counter() - begun, 3)}


def unsaturated(image: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None) -> Bool[Tensor, "H W"]:
    """Pixels that count of a render at the model's own exposure, which is cut off where it is light."""
    below = (image < LIGHT).all(0)
    return below if counted is None else below & counted


def told_of_light(run: Run, spread: float, within: float) -> dict[str, float]:
    """Log by how much exposures and light within photographs differ, and what follows; for the line of the step."""
    learnt, grids = run.exposures.matrices is not None, run.exposures.grids is not None
    verdict = "each has its own from here on" if learnt else "they are taken for equal"
    verdict += ", since light differs within them" if grids else ""
    logger.info("step %d: exposures of photographs are spread by %.1f %%: %s", run.step + 1, 100 * spread, verdict)
    found = {"exposure_spread": spread, "exposures": len(run.scene.train) if learnt else 0}
    return found | ({} if math.isnan(within) else told_within(run, within))


def told_within(run: Run, spread: float) -> dict[str, float]:
    """Log by how much light differs within photographs, and what follows; for the line of the step."""
    learnt = run.exposures.grids is not None
    verdict = "each has a bilateral grid from here on" if learnt else "it is taken for even"
    logger.info("step %d: light within photographs is spread by %.1f %%: %s", run.step + 1, 100 * spread, verdict)
    return {"light_spread": spread, "grids": len(run.scene.train) if learnt else 0}


def judge_poses(run: Run) -> dict[str, float]:
    """Whether poses of training photographs are wrong, where that is asked first, and correct them if so; for the line
    of the step."""
    begun, poses, told, views = time.perf_counter(), run.poses, dict[str, float](), run.train_views
    usual = math.nan
    if poses.matrices is None:
        halves = shifts_by_half(beside_renders(run, poses.judged_by(views)))
        told["pose_spread"], usual = spread_of_shifts(halves), usual_shift(halves)
        needed, verdict = poses.needed(told["pose_spread"]), "poses are corrected from here on"
        verdict = verdict if needed else "poses are taken for right"
        logger.info("step %d: photographs lie %.2f px beside: %s", run.step + 1, told["pose_spread"], verdict)
        if not needed:
            return told | {"poses": 0, "pose_seconds": round(time.perf_counter() - begun, 3)}
    told["poses"], told["pose_motion"] = len(views), correct_poses(run, views, usual)
    logger.info("step %d: poses are corrected by %.2f px", run.step + 1, told["pose_motion"])
    return told | {"pose_seconds": round(time.perf_counter() - begun, 3)}


def beside_renders(run: Run, views: Sequence[View]) -> Iterator[tuple[Tensor, Tensor, Tensor | None, float]]:
    """(render, photograph, which pixels count, px of the photograph in one of these) of views, smaller."""
    for view in views:
        run.refuse_if_stopping()
        small = coarser(view, run.scene.reduction, SMALLER)
        image = render(run, small.camera).image
        yield image, small.image(), small.counted(), view.camera.focal / small.camera.focal


def correct_poses(run: Run, views: Sequence[View], usual: float) -> float:
    """Move each photograph to where the model says that it was taken; returns how far pictures move, px. usual: px by
    which they were found to lie beside."""
    after, depths, number = list[Camera](), list[float](), run.step + 1
    error = run.poses.expected_error(number, usual)
    held = CORRELATED_PIXELS / error**2
    for view, given in zip(views, run.poses.cameras, strict=True):
        run.refuse_if_stopping()
        small, shown = seen_smaller(run, view, least=POSE_PIXELS)
        assert shown.depth is not None
        pictures = shown.image, shown.depth, shown.alpha, small.image(), small.counted()
        after.append(aligned(small.camera, *pictures, given=given, held=held))
        depths.append(usual_depth(shown.depth, shown.alpha))
    known = [depth for depth in depths if math.isfinite(depth)]
    depth = median(known) if known else run.scene.extent
    return run.poses.correct([view.camera for view in views], after, depth, number, error)


def judge_blur(run: Run) -> dict[str, float]:
    """By how much the camera moved in photographs that are less sharp than others; for the line of the step."""
    begun, number = time.perf_counter(), run.step + 1
    suspects = run.blur.suspects(run.train_views)
    lengths = run.blur.move({view: movement_of(run, view) for view in suspects}, number)
    middle = {"blur_length": median(lengths)} if lengths else {}
    told = f", by {median(lengths):.1f} px in the middle of them" if lengths else ""
    logger.info(
        "step %d: the camera moved in %d of the %d photographs that were asked%s",
        *(number, len(lengths), len(suspects), told),
    )
    seconds = round(time.perf_counter() - begun, 3)
    return {"blurred": len(lengths), "blur_suspects": len(suspects), "blur_seconds": seconds} | middle


def movement_of(run: Run, view: View) -> Movement:
    """By how many px of a photograph its camera moved; from pictures of at most BLUR_PIXELS px."""
    run.refuse_if_stopping()
    small = view
    while small.camera.width * small.camera.height > BLUR_PIXELS:
        halved = coarser(small, run.scene.reduction, 2)
        if halved is small:
            break
        small = halved
    photograph, counted = small.image(), small.counted()
    shown = render(run, small.camera, supersample=1).image
    image = at_exposure(run.exposures.applied(shown, view.name).detach().cpu(), photograph, counted)
    return movement_between(image, photograph, counted).times(view.camera.focal / small.camera.focal)


def judge_distractors(run: Run) -> dict[str, float]:
    """Whether photographs show distractors, where that is asked first, and find those of all if so; for the line of
    the step."""
    begun, views, distractors = time.perf_counter(), run.poses.views(run.scene.train), run.distractors
    seen, told, wanted = dict[View, Difference](), dict[str, float](), True
    if run.step + 1 == distractors.first:
        seen = differences(run, distractors.judged_by(views))
        told["distractor_share"] = share_of(distractors_in(list(seen.values())))
        wanted = distractors.needed(told["distractor_share"])
        tell_share(told["distractor_share"], wanted, run.step + 1)
    if wanted:
        seen |= differences(run, [view for view in views if view not in seen])
    marked = distractors_in([seen[view] for view in views]) if wanted else None
    doomed = showing_distractors(run, without_marked(views, marked)) if marked is not None else None
    told["distractors"] = distractors.mark(marked, run.step + 1)  # with their primitives, or neither
    if doomed is not None:
        told["forgotten"] = forget(run, doomed)
        logger.info(
            "step %d: %.1f %% of photographs do not count; %d primitives that show these are removed",
            *(run.step + 1, 100 * told["distractors"], told["forgotten"]),
        )
    return told | {"distractor_seconds": round(time.perf_counter() - begun, 3)}


def showing_distractors(run: Run, views: Sequence[View]) -> Bool[Tensor, "N"]:
    """Which primitives are mostly shown where pixels of photographs do not count. What they show was learnt before
    these were found."""
    probe = Probe(model=run.backbone, views=run.views, step=run.model_step)
    hidden, shown = run.background.new_zeros(2, len(run.backbone.table))
    for view in views:
        run.refuse_if_stopping()
        small = coarser(view, run.scene.reduction, SMALLER)
        uncounted, total = probe.render(small.camera).blending_weights(small.counted())
        hidden, shown = hidden + uncounted, shown + total
    return hidden > shown / 2


def forget(run: Run, doomed: Bool[Tensor, "N"]) -> int:
    """Remove primitives, unless they are all; returns how many."""
    if bool(doomed.all()):
        return 0
    keep_rows(run.backbone.table, ~doomed)
    return int(doomed.sum())


def tell_share(share: float, needed: bool, step: int) -> None:
    """Log what was found of distractors in some photographs, and what follows."""
    verdict = "they do not count from here on" if needed else "all of them counts"
    logger.info("step %d: %.1f %% of photographs show what others do not: %s", step, 100 * share, verdict)


def differences(run: Run, views: Sequence[View]) -> dict[View, Difference]:
    """Between photographs and what the model shows in their places, smaller."""
    found = dict[View, Difference]()
    for view in views:
        run.refuse_if_stopping()
        small, shown = seen_smaller(run, view)
        assert shown.depth is not None
        photograph, counted = small.image(), small.counted()
        gains = gains_between(shown.image, photograph, counted)
        image = at_exposure(run.as_photographed(shown.image, small).detach().cpu(), photograph, counted)
        found[view] = difference_of(small.camera, image, shown.depth, shown.alpha, photograph, counted, gains)
    return found


def at_exposure(
    image: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> Float[Tensor, "3 H W"]:
    """A render, as bright in each channel as its photograph; saturated as that is."""
    return (gains_between(image, photograph, counted)[:, None, None] * image).clamp(0, 1)


def gains_between(
    image: Float[Tensor, "3 H W"], photograph: Float[Tensor, "3 H W"], counted: Bool[Tensor, "H W"] | None
) -> Float[Tensor, "3"]:
    """How many times as bright as a render its photograph is, by channel; 1 where that cannot be told."""
    return log_gains(image, photograph, counted).nan_to_num(0.0).exp()


def seen_smaller(run: Run, view: View, depth: bool = True, least: int = 0) -> tuple[View, TiledRendering]:
    """(a view at a smaller size, what the model shows there, with depth or without); as it is where fewer pixels than
    `least` would be left."""
    pixels = view.camera.width * view.camera.height / SMALLER**2
    small = coarser(view, run.scene.reduction, SMALLER) if pixels >= least else view
    return small, render(run, small.camera, supersample=1, depth=depth)
