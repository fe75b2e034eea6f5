"""Pictures of a run: test views with their truth, error maps, and zoomed crops with their competitor.

They go to the run's `renders/` with an `index.json`, from which the report is made.
"""

import math
import re
from collections.abc import Iterable, Sequence, Set
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from gsx.core.data.images import write_image
from gsx.core.data.masks import black_out, grown
from gsx.core.data.scene import View
from gsx.core.data.window import Window
from gsx.core.files import write_json
from gsx.core.quality.metrics import psnr
from gsx.core.shapes import Bool, Float
from gsx.experiments.evaluation.zoomed import Zoomed

DRAWN_VIEWS = 6
"""Test views that are drawn."""
PICTURE_WIDTH = 1600
"""Wider pictures are saved reduced to this, in px, since the report embeds them."""
LOSSLESS_PIXELS = 400_000
"""Larger pictures are saved as JPEG."""
WINDOW = 192
"""Edge of a zoomed crop on the finer raster, px."""
WINDOW_STEP = 8
"""Grid of crops, px."""
ERROR_FULL = 0.2
"""Mean absolute error over the channels at which an error map is brightest, in display units of [0, 1]."""
DRAWN = re.compile(r".+\.(truth|render|error|enlarged|upscaled|depth)\.(png|jpg)")
"""Names of pictures."""
ERROR_COLOURS = (
    (0.00, (0, 0, 4)),
    (0.15, (55, 14, 92)),
    (0.32, (130, 28, 106)),
    (0.47, (198, 51, 78)),
    (0.60, (236, 94, 40)),
    (0.72, (247, 145, 30)),
    (0.87, (250, 205, 75)),
    (1.00, (253, 250, 190)),
)
"""Error divided by ERROR_FULL and its display RGB. CIE lightness rises evenly, so equal steps look equal."""


class Pictures:
    """Pictures of up to DRAWN_VIEWS views and their zoomed crops, with an index (implements `zoomed.Drawing`)."""

    def __init__(self, folder: Path, step: int) -> None:
        self.folder, self.step = folder, step
        self.chosen: dict[int, dict[str, Any]] = {}
        """Index entries of the views to draw, by number."""
        self.names: dict[int, str] = {}
        """Their file names."""
        self.views: list[dict[str, Any]] = []
        self.crops: list[dict[str, Any]] = []
        self.flight: dict[str, Any] = {}
        """Entry of the flight into a view's detail."""

    def choose(self, figures: Sequence[dict[str, Any]]) -> None:
        """Chooses the views to draw, best and worst among them; removes pictures of an earlier evaluation."""
        self.folder.mkdir(parents=True, exist_ok=True)
        forget(self.folder)
        if not figures:
            return
        best, worst = extremes([figure["psnr"] for figure in figures])
        roles = {worst: "worst", best: "best"} if best != worst else {}
        numbers = spread(len(figures), DRAWN_VIEWS, {best, worst})
        keys = ("name", "group", "psnr", "ssim", "lpips", "perceptual")
        self.chosen = {i: {key: figures[i][key] for key in keys} | {"role": roles.get(i, "")} for i in numbers}
        self.names = dict(zip(numbers, file_names([figures[i]["name"] for i in numbers]), strict=True))

    def whole(self, number: int, view: View, render: Float[Tensor, "3 H W"]) -> None:
        """Draws truth, render and error of a view."""
        if number not in self.chosen:
            return
        files = self.compared(self.names[number], view, render)
        self.views.append(self.chosen[number] | {"size": list(view.camera.size), "files": files})

    def compared(self, name: str, view: View, render: Float[Tensor, "3 H W"]) -> dict[str, str]:
        """Writes truth, render and error of a view; returns their files by kind."""
        truth = view.image()
        error = error_map(*(black_out(picture, view.counted()) for picture in (render, truth)))
        images = {"truth": truth, "render": render, "error": error}
        return {kind: self.save(f"{name}.{kind}", reduced(image)) for kind, image in images.items()}

    def zoomed(self, number: int, zoomed: Zoomed) -> None:
        """Draws the window with most detail: truth, render and the x1 render resized, also by an upscaler."""
        if number not in self.chosen:
            return
        window = most_detailed(zoomed.truth, WINDOW, zoomed.counted)
        inside = None if zoomed.counted is None else window.cut(zoomed.counted[None])[0]
        if inside is not None and not inside.any():
            return
        pictures = zoomed.pictures(("truth", "render", "enlarged", "upscaled"))
        images = {kind: window.cut(picture) for kind, picture in pictures.items()}
        names = {"psnr": "render", "enlarged_psnr": "enlarged", "upscaled_psnr": "upscaled"}
        stem = f"{self.names[number]}.x{zoomed.factor:g}"
        self.crops.append(
            {
                "view": zoomed.view.name,
                "factor": zoomed.factor,
                "window": [window.left, window.top, window.width, window.height],
                **{key: psnr(images[kind], images["truth"], inside) for key, kind in names.items() if kind in images},
                "files": {kind: self.save(f"{stem}.{kind}", image, True) for kind, image in images.items()},
            }
        )

    def save(self, stem: str, image: Float[Tensor, "3 H W"], lossless: bool = False, lossy: bool = False) -> str:
        """Writes a picture; returns its file name."""
        small = image.shape[1] * image.shape[2] <= LOSSLESS_PIXELS and not lossy
        file = f"{stem}.png" if lossless or small else f"{stem}.jpg"
        write_image(self.folder / file, image)
        return file

    def write_index(self) -> None:
        """Writes the index."""
        index = {"error_full": ERROR_FULL, "step": self.step, "views": self.views, "zoom": self.crops}
        index |= {"flight": self.flight} if self.flight else {}
        write_json(self.folder / "index.json", index)


def forget(folder: Path) -> None:
    """Removes the index and the pictures of an earlier evaluation, which may be incomplete."""
    (folder / "index.json").unlink(missing_ok=True)
    for path in folder.iterdir():
        if DRAWN.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)


def extremes(qualities: Sequence[float | None]) -> tuple[int, int]:
    """Returns the indices of the best and the worst; None is worst of all."""
    known = [-math.inf if quality is None else quality for quality in qualities]
    return known.index(max(known)), known.index(min(known))


def spread(total: int, count: int, always: Set[int]) -> list[int]:
    """Chooses up to `count` of `total` indices: those in `always`, then evenly spaced ones, then the first others."""
    count = min(count, total)
    even = [round(k * (total - 1) / max(1, count - 1)) for k in range(count)]
    return sorted(list(dict.fromkeys([*sorted(always), *even, *range(total)]))[:count])


def file_names(names: Iterable[str]) -> list[str]:
    """Turns view names into file names: without image suffix and odd characters, numbered where two would be equal."""
    out: list[str] = []
    for name in names:
        plain = re.sub(r"\.(png|jpe?g|exr|webp|tiff?)$", "", name, flags=re.IGNORECASE)
        safe = re.sub(r"[^A-Za-z0-9_-]+", "_", plain).strip("_") or "view"
        candidates = (safe, *(f"{safe}_{number}" for number in range(2, len(out) + 2)))
        out.append(next(name for name in candidates if name not in out))
    return out


def error_map(image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Colours the mean absolute error over the channels: black is none, the brightest is ERROR_FULL or more."""
    return colour_ramp((image - truth).abs().mean(0) / ERROR_FULL)


def colour_ramp(values: Float[Tensor, "H W"]) -> Float[Tensor, "3 H W"]:
    """Interpolates ERROR_COLOURS linearly; clamps values to [0, 1]."""
    places = torch.tensor([place for place, _ in ERROR_COLOURS])
    colours = torch.tensor([colour for _, colour in ERROR_COLOURS]) / 255
    clamped = values.clamp(0, 1)
    upper = torch.searchsorted(places, clamped.contiguous()).clamp(1, len(places) - 1)
    lower = upper - 1
    fraction = (clamped - places[lower]) / (places[upper] - places[lower])
    return torch.lerp(colours[lower], colours[upper], fraction[..., None]).permute(2, 0, 1)


def reduced(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 h w"]:
    """Reduces a picture to at most PICTURE_WIDTH."""
    width, height = image.shape[2], image.shape[1]
    if width <= PICTURE_WIDTH:
        return image
    size = (max(1, round(height * PICTURE_WIDTH / width)), PICTURE_WIDTH)
    return interpolate(image[None], size=size, mode="bilinear", antialias=True)[0].clamp(0, 1)


def most_detailed(image: Float[Tensor, "3 H W"], edge: int, counted: Bool[Tensor, "H W"] | None = None) -> Window:
    """Finds the square of that edge, or less, with the largest gradient energy of counted pixels, on a coarse grid."""
    height, width = min(edge, image.shape[1]), min(edge, image.shape[2])
    energy = gradient_energy(image)
    if counted is not None:
        energy = energy * ~grown(~counted[None], 1)[0]
    cells = avg_pool2d(energy[None], WINDOW_STEP, ceil_mode=True)
    reach = [min(edge // WINDOW_STEP, size) for size in cells.shape[1:]]
    means = avg_pool2d(cells, reach, stride=1)[0]
    row, column = divmod(int(means.argmax()), means.shape[1])
    left, top = min(column * WINDOW_STEP, image.shape[2] - width), min(row * WINDOW_STEP, image.shape[1] - height)
    return Window(left, top, width, height)


def gradient_energy(image: Float[Tensor, "3 H W"]) -> Float[Tensor, "H W"]:
    """Sums squared differences to the right and lower neighbours over the channels."""
    energy = torch.zeros_like(image[0])
    energy[:, :-1] += (image[:, :, 1:] - image[:, :, :-1]).square().sum(0)
    energy[:-1] += (image[:, 1:] - image[:, :-1]).square().sum(0)
    return energy
