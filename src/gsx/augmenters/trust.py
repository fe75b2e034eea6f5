"""Trust in an upscaler, measured on the scene's own photos: reduced, enlarged again, and compared with themselves.

The idea of learning from a scene's own reduced pictures is ZSSR's (Shocher et al. 2018); here they only measure.
"""

import math
import statistics
from collections.abc import Sequence

from torch import Tensor

from gsx.augmenters.checked_regenerator import CheckedRegenerator
from gsx.core.data.resize import resize, to_uint8
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.errors import TrainingError
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Float
from gsx.core.training.regenerator import Request
from gsx.core.training.run import Run

PHOTOS = 8
"""Most photos that are enlarged for the measurement."""
MOST_GAIN = 100.0
"""Bound of a single gain, dB: an oracle makes no error at all."""


def gain_over_filter(run: Run, regenerator: CheckedRegenerator, scale: int, event: int) -> float:
    """Returns by how much the regenerator enlarges reduced photos better than Lanczos' filter: mean gain in PSNR, dB.

    Raises:
        TrainingError: a result is no picture of the right size.
    """
    requests = [request_of(run, number, scale, event) for number in evenly(run.train_views)]
    results = regenerator.regenerate(requests)
    return statistics.fmean(map(gain, requests, results))


def evenly(views: Sequence[View]) -> list[int]:
    """Returns the numbers of up to PHOTOS views, evenly spread."""
    count = min(PHOTOS, len(views))
    return [number * len(views) // count for number in range(count)]


def request_of(run: Run, number: int, scale: int, event: int) -> Request:
    """Returns the request to enlarge a reduced photo; sides that `scale` does not divide lose their rest."""
    view = run.train_views[number]
    width, height = (side // scale * scale for side in view.camera.size)
    window = Window(0, 0, width, height)
    low = run.scene.reduction.reduce(window.cut(view.image()), scale)
    camera = window.of(view.camera).resize(width // scale, height // scale)
    return Request(
        image=to_uint8(low).float() / 255, scale=scale, reduction=run.scene.reduction, camera=camera, view=view,
        number=number, photo=False, seed=0, strength=1.0, strongest=1.0, prompt="", step=event,
    )  # fmt: skip


def gain(request: Request, result: Float[Tensor, "3 H W"]) -> float:
    """Returns the gain in PSNR of a result over Lanczos' filter, against the photo that was reduced, dB."""
    height, width = request.result_size
    if tuple(result.shape) != (3, height, width):
        raise TrainingError(f"an enlarged photo is {tuple(result.shape)} and should be {(3, height, width)}")
    photo = Window(0, 0, width, height).cut(request.view.image())
    by_filter = resize(to_uint8(request.image), width, height, "lanczos").float() / 255
    better = psnr(result.cpu().float().clamp(0, 1), photo) - psnr(by_filter, photo)
    return max(-MOST_GAIN, min(MOST_GAIN, better)) if not math.isnan(better) else 0.0
