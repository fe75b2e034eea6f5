"""Further pictures of a report: depth of held-out views, and a flight into the finest detail."""

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.shapes import Float
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.evaluated_renders import depth_and_coverage
from gsx.experiments.reports.pictures import Pictures, colour_ramp

FRAMES = 12
"""Frames of the flight."""
LONGEST = 320
"""Longer side of its frames, px."""
DEEPEST = 4.0
"""Last zoom if no finer truth is known."""
COVERED = 0.5
"""Least coverage of a pixel with depth."""
INNER = 0.02
"""Share of the nearest and of the farthest pixels beyond the range of depth colours."""
ENOUGH = 1_000_000
"""Pixels from which that range is estimated."""


def add_depth(run: Run, pictures: Pictures, pixels: int) -> None:
    """Add depth to each view of the report: near is bright, far is dark, nothing is black."""
    for number, entry in zip(sorted(pictures.chosen), pictures.views, strict=True):
        picture, limits = depth_colours(*depth_and_coverage(run, run.scene.test[number].camera, pixels))
        entry["files"]["depth"] = pictures.save(f"{pictures.names[number]}.depth", picture)
        entry["depth"] = limits


def depth_colours(
    summed: Float[Tensor, "H W"], alpha: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, "3 H W"], list[float]]:
    """Return (colours by inverse mean depth, [nearest, farthest] in scene units)."""
    covered = alpha > COVERED
    if not covered.any():
        return torch.zeros(3, *alpha.shape), []
    inverse = alpha / summed.clamp(min=1e-12)
    values = inverse[covered][:: max(1, int(covered.sum()) // ENOUGH)]
    far, near = values.quantile(torch.tensor([INNER, 1 - INNER])).tolist()
    shade = (inverse - far) / max(near - far, 1e-12)
    picture = torch.where(covered, colour_ramp(0.1 + 0.9 * shade.clamp(0, 1)), 0)
    return picture, [1 / near, 1 / far]


def add_flight(run: Run, pictures: Pictures, pixels: int) -> None:
    """Add a strip of frames, one below the other, from a whole view into its most detailed window."""
    number = min(pictures.chosen)
    view = run.scene.test[number]
    place, zoom = goal(view, pictures)
    frames = [render(run, camera, pixels).image for camera in flight(view.camera, place, zoom)]
    file = pictures.save("_flight.render", torch.cat(frames, 1), lossy=True)
    height, width = frames[0].shape[1:]
    pictures.flight = {"view": view.name, "file": file, "frames": FRAMES, "size": [width, height], "zoom": zoom}


def goal(view: View, pictures: Pictures) -> tuple[tuple[float, float], float]:
    """Return (end of the flight as shares of the picture's sides, its zoom there): the window of the finest crop."""
    crops = [crop for crop in pictures.crops if crop["view"] == view.name and crop["factor"] > 1]
    if not crops:
        return (0.5, 0.5), DEEPEST
    crop = max(crops, key=lambda one: one["factor"])
    left, top, width, height = crop["window"]
    whole_width, whole_height = (side * crop["factor"] for side in view.camera.size)
    place = ((left + width / 2) / whole_width, (top + height / 2) / whole_height)
    return place, max(1.0, min(whole_width / width, whole_height / height))


def flight(camera: Camera, place: tuple[float, float], zoom: float) -> list[Camera]:
    """Return cameras of one raster that zoom evenly from the whole picture to `zoom` times the focal length."""
    shrink = min(1.0, LONGEST / max(camera.size))
    width, height = (max(1, round(side * shrink)) for side in camera.size)
    small, cameras = camera.resize(width, height), []
    for frame in range(FRAMES):
        factor = zoom ** (frame / (FRAMES - 1))
        along = (1 - 1 / factor) / (1 - 1 / zoom) if zoom > 1 else 0.0
        middle = [0.5 + along * (goal - 0.5) for goal in place]
        finer = small.zoom(factor)
        left, top = (
            min(max(round(at * side - size / 2), 0), max(side - size, 0))
            for at, side, size in zip(middle, finer.size, (width, height), strict=True)
        )
        cameras.append(finer.crop(left, top, width, height))
    return cameras
