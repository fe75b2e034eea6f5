"""A held-out view at a zoom with its competitors, and receivers of its pictures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsx.core.data.scene import View
from gsx.core.shapes import Bool, Float


@dataclass(frozen=True, eq=False, kw_only=True)
class Zoomed:
    """A view at a zoom: truth, render, and the x1 render enlarged, as they are measured."""

    view: View
    factor: float
    truth: Float[Tensor, "3 H W"]
    render: Float[Tensor, "3 H W"]
    photograph: Float[Tensor, "3 H W"] | None = None
    """The truth at the training resolution, enlarged: the best picture without new detail; None: it is not measured."""
    enlarged: Float[Tensor, "3 H W"] | None = None
    """The x1 render enlarged by bicubic interpolation; None: there is no x1 render."""
    upscaled: Float[Tensor, "3 H W"] | None = None
    """The x1 render enlarged by `eval.competitor`; None: it is not measured."""
    counted: Bool[Tensor, "H W"] | None = None
    """Pixels that count, None: all; pixels outside of masks are black in every picture."""

    def pictures(self, names: Iterable[str]) -> dict[str, Float[Tensor, "3 H W"]]:
        """Returns pictures by their names here, without those that are not measured."""
        return {name: picture for name in names if (picture := getattr(self, name)) is not None}


@runtime_checkable
class Drawing(Protocol):
    """Receiver of pictures during evaluation; views are counted as in `scene.test`."""

    def choose(self, figures: Sequence[dict[str, Any]]) -> None:
        """Receives the figures of all views at the training resolution, before the first picture."""
        ...

    def whole(self, number: int, view: View, render: Float[Tensor, "3 H W"]) -> None:
        """Receives a view at the training resolution."""
        ...

    def zoomed(self, number: int, zoomed: Zoomed) -> None:
        """Receives the same view at another zoom; all of its zooms come before the next view."""
        ...
