"""Octree-GS on explicit Gaussians: on anchors, as reported, or free with clone and split."""

from dataclasses import dataclass, fields

from gsx.backbones.anchor_options import ExplicitOptions, LevelOptions, faithful
from gsx.backbones.anchors import Anchors, explicit_anchors
from gsx.backbones.clone_split import CloneSplitAcrossLevels, LevelDensityOptions, VisibleByLevel
from gsx.backbones.gs3d import GS3D
from gsx.backbones.gs3d_options import Density, GS3DOptions, Rates
from gsx.backbones.levels import all_levels_from, derive
from gsx.core.training.backbone import BackboneContext

FORMS = ("anchors", "clone_split")
QUIRKS = ("gate", "bias")
"""Quirks of the reference that apply to clone_split."""


@dataclass(frozen=True, kw_only=True)
class CloneSplitOptions:
    """Options of clone_split only."""

    rates: Rates
    density: Density
    level_density: LevelDensityOptions

    def __post_init__(self) -> None:
        if self.density.absolute:
            raise ValueError("backbone.clone_split.density.absolute is true: set it to false, levels do not support it")


@dataclass(frozen=True, kw_only=True)
class OctreeGS3DOptions(ExplicitOptions):
    """Options of both forms; values in conf/backbone/octree_gs3d.yaml; defaults for runs older than clone_split."""

    densification: str = "anchors"
    """anchors: on grid nodes (Octree-AnyGS); clone_split: free Gaussians (GSOctree)."""
    clone_split: CloneSplitOptions | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.densification not in FORMS:
            raise ValueError(f"backbone.densification is '{self.densification}'; choose {' or '.join(FORMS)}")
        if self.densification == "clone_split":
            free_options(self)


def free_options(options: OctreeGS3DOptions) -> tuple[GS3DOptions, LevelOptions, LevelDensityOptions]:
    """Returns clone_split's options of Gaussians, levels and density control.

    Raises:
        ValueError: an option is missing, or a quirk is set that has no effect.
    """
    second = options.clone_split
    if second is None or options.levels is None:
        missing = "levels" if options.levels is None else "clone_split"
        raise ValueError(f"backbone.{missing} is null, and densification is clone_split; without levels: backbone=gs3d")
    idle = [name for name, value in vars(options.quirks).items() if value and name not in QUIRKS]
    if idle:
        raise ValueError(
            f"backbone.quirks.{idle[0]} is '{getattr(options.quirks, idle[0])}', which has no effect on "
            f"densification=clone_split: leave it '', only {' and '.join(QUIRKS)} apply"
        )
    both = vars(options) | {"rates": second.rates, "density": second.density}
    gaussians = GS3DOptions(**{field.name: both[field.name] for field in fields(GS3DOptions) if field.name in both})
    levels = faithful(options.levels, options.fidelity)
    assert levels is not None
    return gaussians, levels, second.level_density


def free_gaussians(options: OctreeGS3DOptions, context: BackboneContext) -> GS3D:
    """Builds free Gaussians at several levels of detail."""
    gaussians, level_options, density = free_options(options)
    schedule = context.schedule(options.published_iterations)
    cameras = [view.camera for view in context.scene.train]
    points = context.points().positions.float()
    levels = derive(points, cameras, level_options, all_levels_from(level_options, schedule))
    control = CloneSplitAcrossLevels(gaussians, context, levels, density, options.switches())
    return GS3D(gaussians, context, VisibleByLevel(levels), control)


def octree_gs3d(options: OctreeGS3DOptions, context: BackboneContext) -> Anchors | GS3D:
    """Builds the backbone octree_gs3d in the form that the options name."""
    if options.densification == "clone_split":
        return free_gaussians(options, context)
    return explicit_anchors(options, context)
