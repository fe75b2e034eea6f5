"""Methods: pictures in folders, and models that are rendered here."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.core.shapes import Float
from gsx.core.training.parameter_table import size_of
from gsx.core.training.run import Run
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.evaluation.evaluated_renders import EvaluatedRenders
from gsx.experiments.evaluation.warp import Surface
from gsx.experiments.evaluation.zoomed import Zoomed
from gsx.experiments.judge.layouts import layout_of
from gsx.experiments.judge.matching import Matcher, Placed, PlacedPicture, refuse_other_order
from gsx.experiments.reports.page import counted
from gsx.scenes.origin import relative_camera


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A word METHOD=PATH; equal names are repetitions of one method, such as seeds."""

    name: str
    path: Path
    repetition: int = 0

    def __str__(self) -> str:
        return f"{self.name} #{self.repetition + 1}" if self.repetition else self.name


class Method(Protocol):
    """Pictures of test views by one method."""

    entry: Entry
    notes: list[str]
    """Remarks for the reader of its figures."""
    model: "Model | None"
    """The model whose depth says what is visible; None: unknown."""

    def factors(self) -> list[float] | None:
        """Returns the zooms of its pictures; None: any."""
        ...

    def camera(self, view: View, factor: float) -> Camera | None:
        """Returns the camera of its picture of a view at a zoom; None: there is no such picture."""
        ...

    def picture(self, view: View, factor: float) -> Float[Tensor, "3 H W"]:
        """Returns its picture of a view at a zoom, display values."""
        ...

    def facts(self) -> dict[str, Any]:
        """Returns what identifies the pictures or the model, for the results."""
        ...


class PictureFolder:
    """Pictures of a folder (implements `Method`)."""

    def __init__(self, entry: Entry, scene: Scene, matcher: Matcher, model: "Model | None" = None) -> None:
        """Finds the view and zoom of each picture; `model`: for depth.

        Raises:
            InputError: pictures are missing, ambiguous, of other sizes, or in another order.
        """
        self.entry, self.model, self.background = entry, model, scene.background
        layout = layout_of(entry.path)
        placed = [matcher.place(pictures) for pictures in layout.sets]
        self.program, self.pictures, twice = layout.program, *by_zoom(placed)
        self.notes = [
            *layout.notes,
            *twice,
            *dict.fromkeys(note for one in placed for note in one.notes),
            *self.peculiar(),
        ]
        for one in placed:
            if one.by_order:
                refuse_other_order(entry.path, one.pictures, scene)

    def peculiar(self) -> Iterator[str]:
        """Yields remarks on the files of the pictures, with their number."""
        headers = [one.header for pictures in self.pictures.values() for one in pictures.values()]
        for remark in dict.fromkeys(remark for header in headers for remark in header.remarks):
            count = sum(remark in header.remarks for header in headers)
            yield f"{'all pictures' if count == len(headers) else counted(count, 'picture')}: {remark}"

    def factors(self) -> list[float] | None:
        """Returns the zooms of the pictures."""
        return sorted(self.pictures)

    def placed(self, view: View, factor: float) -> PlacedPicture | None:
        """Returns the file of a view at a zoom; None: there is none."""
        return self.pictures.get(factor, {}).get(view.name)

    def camera(self, view: View, factor: float) -> Camera | None:
        """Returns the camera of a picture's size; None: there is no picture."""
        placed = self.placed(view, factor)
        return placed.camera if placed else None

    def picture(self, view: View, factor: float) -> Float[Tensor, "3 H W"]:
        """Reads a picture, over the scene's background where it is transparent."""
        placed = self.placed(view, factor)
        assert placed is not None, "`camera` says which pictures there are"
        return placed.render(self.background)

    def facts(self) -> dict[str, Any]:
        """Returns the program whose layout the folder has, and the number of pictures by zoom."""
        counts = {f"{factor:g}": len(pictures) for factor, pictures in sorted(self.pictures.items())}
        return {"kind": "pictures", "layout": self.program, "pictures": counts}


def by_zoom(placed: Sequence[Placed]) -> tuple[dict[float, dict[str, PlacedPicture]], list[str]]:
    """Returns pictures by zoom and view, and remarks: of two folders at one zoom the first counts."""
    out: dict[float, dict[str, PlacedPicture]] = {}
    remarks: list[str] = []
    for one in placed:
        factor = next(iter(one.pictures.values())).factor
        if factor in out:
            remarks.append(f"two folders hold pictures at x{factor:g} by their size: the first is measured")
        out.setdefault(factor, one.pictures)
    return out, remarks


class Model:
    """Renders of a run or a splat file (implements `Method`)."""

    def __init__(self, entry: Entry, run: Run, scene: Scene, options: EvalOptions, facts: Mapping[str, Any]) -> None:
        """Takes over a run; `scene`: that of the measured views, whose origin may be another."""
        self.entry, self.run, self.notes = entry, run, list[str]()
        self.model: Model | None = self
        self.renders = EvaluatedRenders(run, options)
        rows, size = size_of(run.backbone.table)
        self.known = {"kind": "model", **facts, "primitives": rows, "megabytes": size / 1e6}
        self.shift = [own - other for own, other in zip(run.scene.origin, scene.origin, strict=True)]

    def factors(self) -> list[float] | None:
        """Returns None: a model is rendered at any zoom."""
        return None

    def camera(self, view: View, factor: float) -> Camera | None:
        """Returns the camera of a view at a zoom; None: there is no photo."""
        finer = view.zoom(factor)
        return finer.camera if finer else None

    def picture(self, view: View, factor: float) -> Float[Tensor, "3 H W"]:
        """Renders a view at a zoom."""
        finer = view.zoom(factor)
        assert finer is not None, "`camera` says which pictures there are"
        with torch.no_grad():
            return self.renders.render(self.around_own_origin(finer), factor).image.cpu()

    def surface(self, zoomed: Zoomed) -> Surface:
        """Renders what is visible in a zoomed view."""
        with torch.no_grad():
            return self.renders.surface(replace(zoomed, view=self.around_own_origin(zoomed.view)))

    def around_own_origin(self, view: View) -> View:
        """Returns a view in the coordinates of the model."""
        return replace(view, camera=relative_camera(view.camera, self.shift))

    def facts(self) -> dict[str, Any]:
        """Returns size and origin of the model."""
        return self.known
