"""Is this capture good enough, and what should be photographed again? For `gsx scenes`."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import median

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from gsx.core.data.resize import linear_from_display
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.quality.sharpness import sharpness_line
from gsx.core.shapes import Bool, Float
from gsx.experiments.runs.load_scene import in_one_place
from gsx.experiments.runs.orbit import axes_about, nearest_to_rays
from gsx.experiments.viewer.up_direction import upright
from gsx.scenes.photo_source import PhotoSource

POINTS = 3000
"""Points that are looked up, evenly over all."""
LOOKED_AT = 400
"""Width of pictures that exposure is read from, px: a point's own colour, not its pixel's."""
DARK, BRIGHT = 0.02, 0.9
"""Light below and above says nothing of exposure: noise, and what is clipped."""
SAME_COLOUR, SAME_POINT = 0.3, 1.0
"""Stops by which a point's channels, against their mean, and then its light, may differ from the cloud's colour and
still be seen: else something stands before it."""
TRUSTED = 0.25
"""Share of points in view that are seen so: with fewer, the cloud's colours are not the scene's."""
ROUNDS = 10
UNEVEN = 1 / 3
"""Stops from the middle from which on a photograph is named: the step of cameras' dials."""
LEAST_SHARED = 0.5
"""Of what a photograph sees, with the photograph that shares most; less leaves a gap."""
FEW = 3
"""Photographs that should see a point."""
CONVERGING = 0.9
"""Mean cosine between cameras' axes and the way to the point nearest to all, from which on they look at one place."""
GAP = 15.0
"""Degrees between neighbours around it that are worth naming, where it is three times the usual, too."""


def capture_lines(scene: Scene) -> Iterator[str]:
    """Yields lines on sharpness, exposure and coverage, with what to photograph again.

    Raises:
        InputError: a photograph cannot be read.
    """
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    photos = [view.source.path for view in views if isinstance(view.source, PhotoSource)]
    if photos:
        yield sharpness_line(list(dict.fromkeys(photos)))
    gains = exposures(views, scene.points) if len(scene.points) else None
    if gains is not None:  # else points are not the scene's: random ones, for example
        yield exposure_line(views, gains)
        points = scene.points.positions[:: max(1, len(scene.points) // POINTS)]
        yield coverage_line(views, torch.stack([view.camera.sees(points) for view in views]))
    still = in_one_place([view.camera for view in scene.train], scene.points)
    around = None if still else ring(views)  # the place that rays from one place are nearest to is that place
    if around is not None:
        yield ring_line(views, around)


def light_at(view: View, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Returns light where a view shows each point; nan: not in view, too dark, too bright, or not counted."""
    image, counted = view.image(), view.counted()
    light = linear_from_display(image)
    brightness = light.mean(0)
    known = (image < 1).all(0) & (brightness > DARK) & (brightness < BRIGHT)
    known = (known if counted is None else known & counted).float()
    planes = avg_pool2d(torch.cat([light * known, known[None]])[None], max(1, view.camera.width // LOOKED_AT))
    pixels, _ = view.camera.project(points)
    places = 2 * pixels / pixels.new_tensor(view.camera.size) - 1
    samples = grid_sample(planes, places.float()[None, None], align_corners=False)[0, :, 0]
    usable = view.camera.sees(points) & (samples[3] > 0.5)
    return torch.where(usable, samples[:3] / samples[3], torch.nan).T


def exposure(view: View, points: Float[Tensor, "P 3"], colours: Float[Tensor, "P 3"]) -> tuple[float, float]:
    """Returns (stops by which points are brighter in a view than in the cloud, share of those in view that it shows).

    The stops are a median over points of the right colour and about the right light, found around itself in rounds, so
    that what stands before a point does not enter; NaN where there is none.
    """
    light = light_at(view, points)
    stops, own = light.log2(), colours.clamp(min=1e-3).log2()
    hues = (stops - stops.mean(1, keepdim=True) - own + own.mean(1, keepdim=True)).abs().amax(1)
    differences = light.mean(1).log2() - colours.mean(1).clamp(min=1e-3).log2()
    known = differences.isfinite()
    alike, gain = known & (hues < SAME_COLOUR), torch.tensor(0.0)
    near = alike
    for _ in range(ROUNDS):
        if not near.any():
            return math.nan, 0.0
        gain = differences[near].median()
        near = alike & ((differences - gain).abs() < SAME_POINT)
    return float(gain), float(near.sum() / known.sum())


def exposures(views: Sequence[View], cloud: PointCloud) -> Float[Tensor, "V"] | None:
    """Returns stops by which each view is brighter than the middle one; NaN for a view that shows no point.

    None: the colours of the points are not the scene's.
    """
    step = max(1, len(cloud) // POINTS)
    points, colours = cloud.positions[::step], linear_from_display(cloud.colours[::step].float() / 255)
    estimates = [exposure(view, points, colours) for view in views]
    gains = torch.tensor([gain for gain, _ in estimates])
    return gains - gains.nanmedian() if median(share for _, share in estimates) > TRUSTED else None


def exposure_line(views: Sequence[View], gains: Float[Tensor, "V"]) -> str:
    """Returns how alike photographs are exposed, and which are not."""
    known = gains[gains.isfinite()]
    spread, rest = float(known.max() - known.min()), len(gains) - len(known)
    odd = sorted((i for i in range(len(views)) if abs(float(gains[i])) > UNEVEN), key=lambda i: -abs(float(gains[i])))
    line = f"exposure  the same points are up to {spread:.2f} stops brighter in one photograph than in another"
    line += f"; {rest} show too few of them" if rest else ""
    if not odd:
        return line
    worst = ", ".join(f"{views[i].name} ({float(gains[i]):+.2f})" for i in odd[:5]) + (", ..." if odd[5:] else "")
    return f"{line}; off by more than a third: {worst}; lock exposure and white balance"


def coverage_line(views: Sequence[View], visible: Bool[Tensor, "V P"]) -> str:
    """Returns how often points are in view, and which photographs share too little with any other."""
    counts = visible.sum(0)
    rare = float((counts < FEW).float().mean())
    often = f"{int(counts.median())} of {len(views)} photographs"
    line = f"coverage  points are in view of {often}; {rare:.0%} of fewer than {FEW}"
    alone = [(share, index, other) for index, (share, other) in enumerate(shared(visible)) if share < LEAST_SHARED]
    if not alone:
        return line
    named = ", ".join(f"{views[i].name} ({share:.0%}, with {views[j].name})" for share, i, j in sorted(alone)[:5])
    more = ", ..." if alone[5:] else ""
    return f"{line}; share little of what they see with any other: {named}{more}; photograph in between"


def shared(visible: Bool[Tensor, "V P"]) -> list[tuple[float, int]]:
    """Returns for each view (largest share of its points that another sees, which one); (1, itself) without points."""
    values = visible.float()
    shares = values @ values.T / values.sum(1, keepdim=True).clamp(min=1)
    shares.fill_diagonal_(-1)
    best = shares.max(1)
    return [
        (float(share), int(other)) if bool(own.any()) and len(visible) > 1 else (1.0, index)
        for index, (share, other, own) in enumerate(zip(best.values, best.indices, visible, strict=True))
    ]


@dataclass(frozen=True)
class Ring:
    """Cameras around what they look at."""

    order: list[int]
    """Views by angle; after the last comes the first."""
    gaps: list[float]
    """Degrees from each to the next."""


def ring(views: Sequence[View]) -> Ring | None:
    """Returns how cameras stand around the point nearest to all their axes; None: they look at no one place."""
    cameras = [view.camera for view in views]
    rotations = torch.stack([camera.rotation.double() for camera in cameras])
    centres = torch.stack([camera.centre.double() for camera in cameras])
    axes = rotations[:, 2]
    system, right = nearest_to_rays(centres, axes)
    middle = torch.linalg.lstsq(system, right[:, None]).solution[:, 0]
    way = middle - centres
    cosines = (axes * way).sum(1) / way.norm(dim=1).clamp(min=1e-12)
    if len(views) < 4 or float(cosines.mean()) < CONVERGING:
        return None
    north, east, _ = axes_about(upright(rotations), way[0])
    angles = torch.rad2deg(torch.atan2(way @ east, way @ north))
    order = angles.argsort().tolist()
    sorted_angles = angles[order]
    gaps = torch.cat([sorted_angles[1:], sorted_angles[:1] + 360]) - sorted_angles
    return Ring(order, gaps.tolist())


def ring_line(views: Sequence[View], around: Ring) -> str:
    """Returns over how many degrees cameras stand, and where there is a gap."""
    open_side, *others = sorted(range(len(around.gaps)), key=lambda i: -around.gaps[i])
    reach = 360 - around.gaps[open_side]
    usual = median(around.gaps)
    closed = around.gaps[open_side] < 90
    named = [i for i in ([open_side] if closed else []) + others if around.gaps[i] > max(GAP, 3 * usual)]
    line = f"around    cameras look at one place, from {math.ceil(reach)} of 360 degrees"
    if not named:
        return line
    places = ", ".join(
        f"{around.gaps[i]:.0f} between {views[around.order[i]].name} and "
        f"{views[around.order[(i + 1) % len(views)]].name}"
        for i in named[:3]
    )
    return f"{line}; gaps of {places}; photograph there"
