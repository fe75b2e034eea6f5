"""Backbones: scene representations that train themselves and are drawn as splats.

A plugin registers one by `registry.add("backbone", NAME, factory, options)`; `factory(options, context)` returns a
`Backbone`. It may implement the other protocols of this module as well.
"""

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
"""Largest loss of undrawable primitives in a step: share of all, and number in small models."""
CAUTION = "caution"
"""Key in a plan whose text is logged as a warning."""
Observation: TypeAlias = dict[str, Tensor]
"""Statistics of one render for density control: tensors of at least one dimension by name; empty: none."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BackboneContext:
    """Scene, schedule, rasterizer rules and random generator that a backbone is built from."""

    scene: Scene
    iterations: int
    """Steps of the whole run."""
    device: torch.device
    raster: RasterSettings
    """Rasterizer rules; the backbone may change them (`Backbone.raster`)."""
    generator: torch.Generator
    """CPU generator, the only source of random numbers."""
    views: TrainingViews
    """Training views at each step, with their rasters and corrections."""
    ranks: Ranks = Ranks()
    """Processes that train it together."""
    begins: bool = True
    """True: the model starts from the scene; False: a checkpoint will replace its table."""

    def on_rank0(self, measure: Callable[[], T]) -> T:
        """Runs a measurement on rank 0 and broadcasts result and generator state; tensors must be on the CPU.

        All ranks then decide alike, even if their renders differ in the last bit.
        """
        result, state = self.ranks.broadcast(lambda: (measure(), self.generator.get_state()))
        self.generator.set_state(state)
        return result

    def points(self) -> PointCloud:
        """Returns the initial points.

        Raises:
            InputError: the scene has none.
        """
        if len(self.scene.points) == 0:
            raise InputError(
                f"scene '{self.scene.name}' has no points to start from: add points or set scene.points=random"
            )
        return self.scene.points

    def schedule(self, published_iterations: int) -> Schedule:
        """Returns the map from steps of a published run of that length to this run."""
        return Schedule(
            iterations=self.iterations, published_iterations=published_iterations, views=len(self.scene.train)
        )


@runtime_checkable
class Drawn(Protocol):
    """Splats of one camera; a backbone may add what its `observe` and `regulariser` need."""

    @property
    def splats(self) -> Splats:
        """M Gaussians, differentiable."""

    @property
    def rows(self) -> Int[Tensor, "M"] | None:
        """Table row of each splat; None: splat n is row n."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DrawnSplats:
    """Splats and their table rows."""

    splats: Splats
    rows: Int[Tensor, "M"] | None = None


D = TypeVar("D", bound=Drawn)


@runtime_checkable
class Backbone(Protocol[D]):
    """A scene representation that is drawn as splats and updates its own parameters.

    A step calls, in this order: for each view `draw`, `regulariser`, (backward), `observe`; for each observation
    `accumulate`; then `densify_and_prune` and `update`. Gradients of the views add up. Steps count from 1.
    """

    table: ParameterTable
    """All learned values, and all state that an exact resume needs."""
    raster: RasterSettings
    """Rasterizer rules for its splats: the context's, with its own filters."""
    absolute_gradient: bool
    """True: `observe` needs absolute gradients of training renders."""

    def draw(self, camera: Camera, step: int) -> D:
        """Returns the splats for a camera at a step."""

    def regulariser(self, drawn: D) -> Float[Tensor, ""] | None:
        """Returns a term of the view's loss, or None."""

    def observe(self, drawn: D, rendering: Rendering, step: int, weight: float = 1.0) -> Observation:
        """Returns the statistics of a render for density control, after its backward pass.

        Args:
            drawn: Result of `draw`.
            rendering: Its render, with gradients of the step's loss at the screen means.
            step: Current step.
            weight: Weight of the render in the step's loss (`backbones.density`).
        """

    def accumulate(self, observation: Observation) -> None:
        """Adds an observation, of this or another process, to the statistics."""

    def densify_and_prune(self, step: int) -> Mapping[str, float]:
        """Adds and removes rows; returns metrics for the log, empty if nothing changed."""

    def update(self, step: int) -> None:
        """Updates the parameters by the learning rates of this step, and clears their gradients."""

    def explicit(self, camera: Camera | None, step: int) -> Gaussians:
        """Returns Gaussians for a standard splat file, as drawn for a camera or, with None, for all cameras.

        Raises:
            GsxError: the camera is None, and the splats depend on the camera.
        """


@runtime_checkable
class Planned(Protocol):
    """A backbone with a schedule to log."""

    def plan(self) -> dict[str, Any]:
        """Returns the rescaled schedule in absolute steps: numbers or lists by name, grouped by name; see CAUTION."""


@runtime_checkable
class WithMilestones(Protocol):
    """A backbone with steps that no module may skip."""

    def milestones(self) -> Sequence[int]:
        """Returns steps at which it acts once, or after which it stops acting."""


@runtime_checkable
class Validating(Protocol):
    """A backbone that keeps validation windows of training views out of the loss for a while."""

    def validation_window(self, view: View, step: int) -> Window | None:
        """Returns the view's window that enters no loss at a step; None: no window."""


@runtime_checkable
class Backdrop(Protocol):
    """A backbone with splats behind the scene, at no particular depth."""

    def behind_scene(self, means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
        """Marks splats too far away for any camera to measure their depth."""


def behind_scene(backbone: Backbone[Any], means: Float[Tensor, "M 3"]) -> Bool[Tensor, "M"]:
    """Marks splats behind the scene; none without a backdrop."""
    if isinstance(backbone, Backdrop):
        return backbone.behind_scene(means)
    return torch.zeros_like(means[:, 0], dtype=torch.bool)


@runtime_checkable
class PseudoViewListener(Protocol):
    """A backbone that uses new pseudo views."""

    def pseudo_views_made(self, views: Sequence[PseudoView], step: int) -> None:
        """Receives the pseudo views made for a step, before density control and update; mostly none."""


@runtime_checkable
class WithHarmonics(Protocol):
    """A backbone with colours in spherical harmonics."""

    sh_degree: int
    """Highest degree; its kernels are compiled before the first step."""


@runtime_checkable
class WithOwnFile(Protocol):
    """A backbone whose published code writes splat files with more columns than standard ones."""

    def file_columns(self) -> dict[str, Float[Tensor, "N"]] | None:
        """Returns the columns of that file, in order; None: a standard file is complete."""

    def file_notes(self) -> list[str]:
        """Returns comments for its files: hints for viewers other than the screen dilation."""


@runtime_checkable
class Bakeable(Protocol):
    """A backbone whose splats depend on the camera, but have numbers that do not (slots)."""

    def slot_count(self) -> int:
        """Returns the number of slots."""

    def slots(self, drawn: Any) -> tuple[Int[Tensor, "M"], Int[Tensor, "V"]]:
        """Returns the slot of each drawn splat, and the slots of all candidates of this camera.

        Candidates that are not drawn have opacity 0 for this camera.
        """


@runtime_checkable
class FromGaussians(Protocol):
    """A backbone that can start from a standard splat file (`init=FILE`)."""

    def start_from(self, gaussians: Gaussians) -> None:
        """Replaces its initial Gaussians by those of a file, with all harmonic bands active.

        Raises:
            InputError: its options do not allow that.
        """


@torch.no_grad()
def remove_nonfinite(backbone: Backbone[Any], cameras: Sequence[Camera], step: int) -> int:
    """Removes rows that are not finite or that one of the cameras cannot draw; returns their number.

    If it is 0, nothing changes, gradients included.

    Raises:
        LostModel: too many rows would be removed. Nothing is removed.
    """
    rows = [parameter.detach().reshape(len(parameter), -1) for parameter in backbone.table.parameters.values()]
    kept = torch.stack([torch.isfinite(values).all(1) for values in rows]).all(0)
    for camera in cameras:
        kept &= drawable_rows(backbone, camera, step)
    lost, count = int((~kept).sum()), len(kept)
    if lost and (lost == count or lost > max(FEW, MOST_LOST * count)):
        raise LostModel(
            f"step {step}: {lost:,} of {count:,} primitives have values that are not finite or cannot be drawn: "
            "lower the learning rates (backbone.rates), and check the units of the scene"
        )
    if lost:
        keep_rows(backbone.table, kept)
    return lost


def drawable_rows(backbone: Backbone[Any], camera: Camera, step: int) -> Bool[Tensor, "N"]:
    """Marks all rows except those in view with splats or volumes out of range.

    If no row in view can be drawn and there are networks, these are the cause, and all rows are marked.
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
