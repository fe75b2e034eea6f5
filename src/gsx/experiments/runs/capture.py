"""Quality of a capture and photos to take again, for `gsx scenes`: sharpness, exposure, coverage, gaps."""

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
"""Points that are compared, evenly over all."""
EXPOSURE_WIDTH = 400
"""Width of pictures that exposure is read from, px: a point's colour spans several pixels."""
DARK, BRIGHT = 0.02, 0.9
"""Darker light is noise, brighter light is clipped: neither measures exposure."""
SAME_COLOUR, SAME_POINT = 0.3, 1.0
"""Largest differences in stops of a visible point from the cloud's colour: of its channels against their mean, then of
its light. With larger ones something stands before it."""
TRUSTED = 0.25
"""Share of points in view that must be visible: with fewer, the cloud's colours are not the scene's."""
ROUNDS = 10
UNEVEN = 1 / 3
"""Stops from the median from which on a photo is named: the step of cameras' dials."""
LEAST_SHARED = 0.5
"""Share of a photo's points that its best neighbour shows; less is a gap."""
FEW = 3
"""Photos that should show a point."""
CONVERGING = 0.9
"""Mean cosine between cameras' axes and the way to the point nearest to all, from which on they look at one place."""
GAP = 15.0
"""Degrees between neighbours around that place that are reported, if also three times the usual."""


def capture_lines(scene: Scene) -> Iterator[str]:
    """Yield lines on sharpness, exposure and coverage, with photos to take again."""
    views = sorted((*scene.train, *scene.test), key=lambda view: view.name)
    photos = [view.source.path for view in views if isinstance(view.source, PhotoSource)]
    if photos:
        yield sharpness_line(list(dict.fromkeys(photos)))
    gains = exposures(views, scene.points) if len(scene.points) else None
    if gains is not None:  # else the points are not the scene's, for example random
        yield exposure_line(views, gains)
        points = scene.points.positions[:: max(1, len(scene.points) // POINTS)]
        yield coverage_line(views, torch.stack([view.camera.sees(points) for view in views]))
    if in_one_place([view.camera for view in scene.train], scene.points):
        return  # rays from one place are all nearest to that place
    if (around := ring(views)) is not None:
        yield ring_line(views, around)


def named(texts: Sequence[str], most: int = 5) -> str:
    """Join the first texts."""
    return ", ".join(texts[:most]) + (", ..." if texts[most:] else "")


def light_at(view: View, points: Float[Tensor, "P 3"]) -> Float[Tensor, "P 3"]:
    """Return a photo's linear light at each point; NaN: not in view, too dark, too bright, or masked."""
    image, counted = view.image(), view.counted()
    light = linear_from_display(image)
    brightness = light.mean(0)
    known = (image < 1).all(0) & (brightness > DARK) & (brightness < BRIGHT)
    known = (known if counted is None else known & counted).float()
    planes = avg_pool2d(torch.cat([light * known, known[None]])[None], max(1, view.camera.width // EXPOSURE_WIDTH))
    pixels, _ = view.camera.project(points)
    places = 2 * pixels / pixels.new_tensor(view.camera.size) - 1
    samples = grid_sample(planes, places.float()[None, None], align_corners=False)[0, :, 0]
    usable = view.camera.sees(points) & (samples[3] > 0.5)
    return torch.where(usable, samples[:3] / samples[3], torch.nan).T


def exposure(view: View, points: Float[Tensor, "P 3"], colours: Float[Tensor, "P 3"]) -> tuple[float, float]:
    """Return (stops by which points are brighter in a view than in the cloud, visible share of the points in view).

    The stops are a median over points of about the right colour and light, found by iteration, so that occluders do
    not count; NaN without any.
    """
    light = light_at(view, points)
    stops, cloud = light.log2(), colours.clamp(min=1e-3).log2()
    hues = (stops - stops.mean(1, keepdim=True) - cloud + cloud.mean(1, keepdim=True)).abs().amax(1)
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
    """Return stops by which each view is brighter than the median; NaN: it shows no point.

    None: the colours of the points are not the scene's.
    """
    step = max(1, len(cloud) // POINTS)
    points, colours = cloud.positions[::step], linear_from_display(cloud.colours[::step].float() / 255)
    estimates = [exposure(view, points, colours) for view in views]
    gains = torch.tensor([gain for gain, _ in estimates])
    return gains - gains.nanmedian() if median(share for _, share in estimates) > TRUSTED else None


def exposure_line(views: Sequence[View], gains: Float[Tensor, "V"]) -> str:
    """Report the spread of exposures, and photos far from the median."""
    known = gains[gains.isfinite()]
    spread, rest = float(known.max() - known.min()), len(gains) - len(known)
    odd = sorted((i for i in range(len(views)) if abs(float(gains[i])) > UNEVEN), key=lambda i: -abs(float(gains[i])))
    line = f"exposure  the same points are up to {spread:.2f} stops brighter in one photo than in another"
    line += f"; {rest} show too few of them" if rest else ""
    if not odd:
        return line
    worst = named([f"{views[i].name} ({float(gains[i]):+.2f})" for i in odd])
    return f"{line}; off by more than a third: {worst}; lock exposure and white balance"


def coverage_line(views: Sequence[View], visible: Bool[Tensor, "V P"]) -> str:
    """Report how many photos show a point, and photos that share too little with any other."""
    counts = visible.sum(0)
    rare = float((counts < FEW).float().mean())
    line = f"coverage  half of the points are in {int(counts.median())} or more of {len(views)} photos"
    line += f"; {rare:.0%} in fewer than {FEW}"
    alone = sorted((share, i, j) for i, (share, j) in enumerate(shared(visible)) if share < LEAST_SHARED)
    if not alone:
        return line
    pairs = named([f"{views[i].name} ({share:.0%}, with {views[j].name})" for share, i, j in alone])
    return f"{line}; these share few points with any other photo: {pairs}; take photos in between"


def shared(visible: Bool[Tensor, "V P"]) -> list[tuple[float, int]]:
    """Return for each view (largest share of its points that another shows, that view); (1, itself) without points."""
    values = visible.float()
    shares = values @ values.T / values.sum(1, keepdim=True).clamp(min=1)
    shares.fill_diagonal_(-1)
    best = shares.max(1)
    return [
        (float(share), int(other)) if bool(points.any()) and len(visible) > 1 else (1.0, index)
        for index, (share, other, points) in enumerate(zip(best.values, best.indices, visible, strict=True))
    ]


@dataclass(frozen=True)
class Ring:
    """Directions of cameras around the place that they look at."""

    order: list[int]
    """Views by angle; the first follows the last."""
    gaps: list[float]
    """Degrees from each to the next."""


def ring(views: Sequence[View]) -> Ring | None:
    """Return cameras around the point nearest to all their axes; None: they do not look at one place."""
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
    """Report the range of directions of the cameras, and its gaps."""
    gaps = ring_gaps(views, around)
    line = f"around    cameras look at one place, from {math.ceil(360 - max(around.gaps))} of 360 degrees"
    return f"{line}; gaps of {gaps}; take photos there" if gaps else line


def ring_gaps(views: Sequence[View], around: Ring) -> str:
    """Return up to three gaps between cameras around a place, in degrees; empty without any."""
    open_side, *others = sorted(range(len(around.gaps)), key=lambda i: -around.gaps[i])
    usual, closed = median(around.gaps), around.gaps[open_side] < 90
    wide = [i for i in ([open_side] if closed else []) + others if around.gaps[i] > max(GAP, 3 * usual)]
    names = [views[i].name for i in around.order]
    return ", ".join(f"{around.gaps[i]:.0f} between {names[i]} and {names[(i + 1) % len(names)]}" for i in wide[:3])
