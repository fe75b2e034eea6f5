"""What the trainer asks of a backbone, and what a backbone is given to start from."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import torch
from torch import Tensor
from torch.nn import Parameter

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import RasterSettings, Rendering
from gsx.core.shapes import Float
from gsx.core.training.schedule import Schedule

Observation: TypeAlias = dict[str, Tensor]
"""What density control learns from one render, as tensors by name, none of them 0-dimensional; empty: nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BackboneContext:
    """What a backbone is built from."""

    scene: Scene
    iterations: int
    device: torch.device
    raster: RasterSettings
    """The rules pictures are drawn by, unless the backbone asks for others (`Backbone.raster`)."""
    generator: torch.Generator
    """The run's only source of randomness (a CPU generator)."""

    def points(self) -> PointCloud:
        """What the model starts from.

        Raises:
            InputError: the scene has no points.
        """
        if len(self.scene.points) == 0:
            raise InputError(
                f"scene '{self.scene.name}' has no points to start from: give it points or scene.points=random"
            )
        return self.scene.points

    def schedule(self, published_iterations: int) -> Schedule:
        """Maps steps of a published run of that length onto this run."""
        return Schedule(
            iterations=self.iterations, published_iterations=published_iterations, views=len(self.scene.train)
        )


@runtime_checkable
class Drawn(Protocol):
    """What a backbone draws for one camera; each backbone adds what it needs to learn from the render."""

    @property
    def splats(self) -> Splats:
        """Explicit Gaussians, differentiable."""
        ...


D = TypeVar("D", bound=Drawn)


@runtime_checkable
class Backbone(Protocol[D]):
    """A scene representation that trains itself and draws itself as splats.

    A step calls, in this order: for each view `draw`, `regulariser`, (backward), `observe`; for each observation
    `accumulate`; `densify_and_prune`, `update`. Gradients of the views add up in between. Steps count from 1.
    """

    @property
    def raster(self) -> RasterSettings:
        """The rules its splats are drawn by: those of the context, with filters of its own."""
        ...

    @property
    def absolute_gradient(self) -> bool:
        """Whether `observe` wants absolute gradients in training renders."""
        ...

    def draw(self, camera: Camera, step: int) -> D:
        """The splats of this camera, as the model stands at this step."""
        ...

    def regulariser(self, drawn: D) -> Float[Tensor, ""] | None:
        """A term to add to the loss of a view, or None."""
        ...

    def observe(self, drawn: D, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """What density control learns from a render of what was drawn, after its backward pass.

        `weight`: of the render in the step's loss, whose gradients its screen means have. It counts as so much of a
        photograph (`density.Statistics`).
        """
        ...

    def accumulate(self, seen: Observation) -> None:
        """Count an observation in by its weight: one of this process, or of another that trains the same model."""
        ...

    def densify_and_prune(self, step: int) -> dict[str, int]:
        """Change the number of primitives; returns what was done, for the log, empty when nothing."""
        ...

    def update(self, step: int) -> None:
        """Let the optimiser move the parameters, by the learning rates of this step, and clear their gradients."""
        ...

    def parameters(self) -> Iterable[tuple[str, Parameter]]:
        """Name and value of everything that is learnt, in the same order on every process."""
        ...

    def gradients(self) -> Iterable[tuple[str, Tensor]]:
        """Name and gradient of every parameter that has one."""
        ...

    def remove_nonfinite(self, cameras: Sequence[Camera], step: int) -> int:
        """Remove primitives with values that are not finite, or that one of the cameras cannot draw; returns how many.

        Called when a render left some out, or when gradients are not finite. Where nothing is removed nothing changes,
        gradients included; nor where nothing would be left.
        """
        ...

    def zero_grad(self) -> None:
        """Clear the gradients without moving anything."""
        ...

    def shared(self) -> Iterable[Tensor]:
        """Parameters of colour that all primitives share (a colour network); pseudo views may leave them alone."""
        ...

    def size(self) -> tuple[int, int]:
        """(primitives, bytes of the parameters needed to render)."""
        ...

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """Explicit Gaussians of a standard splat file: those a camera draws, or (None) those that hold for all.

        Raises:
            GsxError: no camera is given, and there is no camera-independent form.
        """
        ...

    @property
    def standard_file(self) -> bool:
        """Whether `file` is a standard splat file of 3D-GS."""
        ...

    def file(self) -> dict[str, Float[Tensor, "N"]]:
        """Columns of the backbone's own splat file, in order."""
        ...

    def export_notes(self) -> list[str]:
        """Comments for the export: what a viewer must know beside the screen dilation."""
        ...

    def plan(self) -> dict[str, Any]:
        """The rescaled schedule in absolute steps, for the log and the report."""
        ...

    def tensors(self) -> dict[str, Tensor]:
        """Everything needed to go on exactly: parameters, optimiser state, statistics."""
        ...

    def restore(self, tensors: dict[str, Tensor]) -> None:
        """Take back what `tensors` gave, whatever its number of primitives."""
        ...
