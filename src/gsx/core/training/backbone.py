"""The interface of a backbone, and the context that it is built from."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias, TypeVar, runtime_checkable

import torch
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.data.window import Window
from gsx.core.errors import InputError, LostModel
from gsx.core.gaussians.splats import Gaussians, Splats
from gsx.core.rasterizer import RasterSettings, Rendering, drawable
from gsx.core.shapes import Bool, Float, Int
from gsx.core.training.distributed import Ranks
from gsx.core.training.parameter_table import ParameterTable, keep_rows
from gsx.core.training.pseudo_views import PseudoView
from gsx.core.training.schedule import Schedule
from gsx.core.training.training_views import TrainingViews

T = TypeVar("T")
MOST_LOST, FEW = 0.01, 10
"""Share of the primitives that a step may lose because they cannot be drawn, and how many of few."""
CAUTION = "caution"
"""Key of a plan's part whose text is logged as a warning."""
Observation: TypeAlias = dict[str, Tensor]
"""What density control learns from one render, as tensors by name, none of them 0-dimensional; empty: nothing."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BackboneContext:
    """Scene, schedule, rules and randomness that a backbone is built from."""

    scene: Scene
    iterations: int
    device: torch.device
    raster: RasterSettings
    """Rules of the rasterizer, unless the backbone has others (`Backbone.raster`)."""
    generator: torch.Generator
    """The run's only source of randomness (a CPU generator)."""
    views: TrainingViews
    """Training views at each step, how they are rendered, and compared with renders."""
    ranks: Ranks = Ranks()
    """The processes that train it together."""
    begins: bool = True
    """Whether the model starts from the scene; otherwise a checkpoint replaces its table."""

    def on_rank0(self, measure: Callable[[], T]) -> T:
        """Runs a measurement on rank 0 and broadcasts the result and the generator's state; tensors are on the CPU.

        All ranks then decide alike, though their renders may differ in a last bit.
        """
        result, state = self.ranks.broadcast(lambda: (measure(), self.generator.get_state()))
        self.generator.set_state(state)
        return result

    def points(self) -> PointCloud:
        """Returns the points that the model starts from.

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
    """The splats of one camera; each backbone adds what it needs to learn from the render."""

    @property
    def splats(self) -> Splats:
        """M explicit Gaussians, differentiable."""
        ...

    @property
    def rows(self) -> Int[Tensor, "M"] | None:
        """Row of the table that each splat comes from; None: splat n is row n."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnSplats:
    """Splats and their rows, for backbones that need no more."""

    splats: Splats
    rows: Int[Tensor, "M"] | None = None


D = TypeVar("D", bound=Drawn)


@runtime_checkable
class Backbone(Protocol[D]):
    """A scene representation that trains itself and draws itself as splats.

    A step calls, in this order: for each view `draw`, `regulariser`, (backward), `observe`; for each observation
    `accumulate`; `densify_and_prune`, `update`. Gradients of the views add up in between. Steps count from 1.
    Checkpoints, sizes, gradients and the removal of what is not finite follow from the table.
    """

    table: ParameterTable
    """Everything that it learns, and all that it needs to resume exactly."""
    raster: RasterSettings
    """Rules of the rasterizer for its splats: those of the context, with its filters."""
    absolute_gradient: bool
    """Whether `observe` needs absolute gradients of training renders."""

    def draw(self, camera: Camera, step: int) -> D:
        """Returns the splats of a camera at a step."""
        ...

    def regulariser(self, drawn: D) -> Float[Tensor, ""] | None:
        """Returns a term to add to the loss of a view, or None."""
        ...

    def observe(self, drawn: D, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Returns what density control learns from a render of what was drawn, after its backward pass.

        `weight`: of the render in the step's loss, whose gradients its screen means have (`backbones.density`).
        """
        ...

    def accumulate(self, observation: Observation) -> None:
        """Adds an observation of this process, or of another that trains the same model, to the statistics."""
        ...

    def densify_and_prune(self, step: int) -> Mapping[str, float]:
        """Changes the number of rows; returns metrics for the log, empty when nothing was done."""
        ...

    def update(self, step: int) -> None:
        """Moves the parameters by the learning rates of this step, and clears their gradients."""
        ...

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """Returns Gaussians of a standard splat file: those a camera draws, or (None) those that hold for all.

        Raises:
            GsxError: no camera is given, and there is no camera-independent form.
        """
        ...


@runtime_checkable
class Planned(Protocol):
    """A backbone with a schedule to log."""

    def plan(self) -> dict[str, Any]:
        """Returns the rescaled schedule in absolute steps: numbers or lists by name, in parts by name; see CAUTION."""
        ...


@runtime_checkable
class Settling(Protocol):
    """A backbone that does things once, at steps that a run must not leave out."""

    def settles(self) -> Sequence[int]:
        """Returns steps at which something is done once, or after which something is done no more."""
        ...


@runtime_checkable
class Validating(Protocol):
    """A backbone that keeps windows of training views out of the loss for a while, to measure by them."""

    def validation_window(self, view: View, step: int) -> Window | None:
        """Returns the window of the view that counts in no loss at this step; None: all of it counts."""
        ...


@runtime_checkable
class Backdrop(Protocol):
    """A backbone with splats behind the scene, which have no depth of their own."""

    def behind_scene(self, means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
        """Marks splats that are too far away for any camera to tell their depth."""
        ...


def behind_scene(backbone: Backbone[Any], means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
    """Marks splats behind the scene; none where the backbone has no backdrop."""
    if isinstance(backbone, Backdrop):
        return backbone.behind_scene(means)
    return torch.zeros_like(means[:, 0], dtype=torch.bool)


@runtime_checkable
class PseudoViewListener(Protocol):
    """A backbone that takes notice of new pseudo views."""

    def pseudo_views_made(self, views: Sequence[PseudoView], step: int) -> None:
        """Takes the pseudo views that were made for a step, mostly none, before density control and update."""
        ...


@runtime_checkable
class WithHarmonics(Protocol):
    """A backbone whose colours change with direction, by spherical harmonics."""

    sh_degree: int
    """Highest degree of its colours; code for it is compiled before the first step."""


@runtime_checkable
class WithOwnFile(Protocol):
    """A backbone whose published code writes splat files with more in them than standard ones."""

    def file_columns(self) -> dict[str, Float[Tensor, "N"]] | None:
        """Returns columns of that file, in order; None: as it is composed, a standard file says everything."""
        ...

    def file_notes(self) -> list[str]:
        """Returns comments of any file of it: what a viewer must know beside the screen dilation."""
        ...


@runtime_checkable
class Bakeable(Protocol):
    """A backbone whose splats depend on the camera, and can be followed from one camera to the next."""

    def slot_count(self) -> int:
        """Returns how many numbers there are."""
        ...

    def slots(self, drawn: Any) -> tuple[Int[Tensor, "M"], Int[Tensor, "V"]]:
        """Returns (a number for each splat drawn, the same from every camera; numbers of all that could be drawn).

        Those that could be drawn and are not have opacity 0 for this camera.
        """
        ...


@runtime_checkable
class FromGaussians(Protocol):
    """A backbone that can start from a standard splat file (`init=FILE`)."""

    def go_on_from(self, gaussians: Gaussians) -> None:
        """Replaces what it was built with by these; no band of their colours waits for a later step.

        Raises:
            InputError: it cannot, as it is composed.
        """
        ...


@torch.no_grad()
def remove_nonfinite(backbone: Backbone[Any], cameras: Sequence[Camera], step: int) -> int:
    """Removes rows with values that are not finite, or that one of the cameras cannot draw; returns how many.

    Where nothing is removed nothing changes, gradients included.

    Raises:
        LostModel: so much would be lost that what is left is another model. Nothing is removed.
    """
    rows = [parameter.detach().reshape(len(parameter), -1) for parameter in backbone.table.parameters.values()]
    kept = torch.stack([torch.isfinite(values).all(1) for values in rows]).all(0)
    for camera in cameras:
        kept &= drawable_rows(backbone, camera, step)
    lost, count = int((~kept).sum()), len(kept)
    if lost and (lost == count or lost > max(FEW, MOST_LOST * count)):
        share = f"none of {count:,} primitives has values that are finite and can be drawn"
        if lost < count:
            share = f"{lost:,} of {count:,} primitives have values that are not finite or cannot be drawn"
        raise LostModel(
            f"step {step}: {share}: lower the learning rates (backbone.rates), and see in what units the scene is"
        )
    if lost:
        keep_rows(backbone.table, kept)
    return lost


def drawable_rows(backbone: Backbone[Any], camera: Camera, step: int) -> Bool[Tensor, "N"]:
    """Marks rows that the camera draws or does not see: False for splats or volumes that are out of range.

    Where none of those in view can be drawn, networks are to blame, if there are any, and no row.
    """
    drawn, table = backbone.draw(camera, step), backbone.table
    splats = drawn.splats
    good = drawable(splats, camera, backbone.raster) & torch.isfinite(splats.scales.prod(1))
    if drawn.rows is None:
        return good
    all_rows = torch.ones(len(table), dtype=torch.bool, device=good.device)
    drawable_ones = all_rows.index_fill(0, drawn.rows[~good], False)
    networks_fail = table.networks is not None and not bool(drawable_ones[drawn.rows].any())
    return all_rows if networks_fail else drawable_ones
