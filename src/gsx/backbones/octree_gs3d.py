"""Octree-GS on explicit Gaussians in both forms: on anchors, as reported, and free with clone and split."""

from dataclasses import dataclass

from gsx.backbones.anchors import Anchors, ExplicitOptions, explicit_anchors
from gsx.backbones.clone_split import LevelDensityOptions
from gsx.backbones.gs3d import GS3D, Density, GS3DOptions, Rates
from gsx.backbones.level_options import faithful
from gsx.core.training.backbone import BackboneContext

FORMS = ("anchors", "clone_split")
QUIRKS = ("gate", "bias")
"""Quirks of the reference that the second form has, too."""


@dataclass(frozen=True, kw_only=True)
class CloneSplitOptions:
    """What the second form has of its own; everything else it shares with the first."""

    rates: Rates
    density: Density
    level_density: LevelDensityOptions

    def __post_init__(self) -> None:
        if self.density.absolute:
            raise ValueError(
                "backbone.clone_split.density.absolute is true, which density control across levels does not know"
            )


@dataclass(frozen=True, kw_only=True)
class OctreeGS3DOptions(ExplicitOptions):
    """Options of both forms; values in conf/backbone/octree_gs3d.yaml. Defaults: runs older than the second form."""

    densification: str = "anchors"
    """anchors: new ones on grid nodes (Octree-AnyGS); clone_split: of Gaussians anywhere (GSOctree)."""
    clone_split: CloneSplitOptions | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.densification not in FORMS:
            raise ValueError(f"backbone.densification is '{self.densification}'; choose {' or '.join(FORMS)}")
        if self.densification == "clone_split":
            free_gaussians(self)


def free_gaussians(options: OctreeGS3DOptions) -> GS3DOptions:
    """The options of the second form.

    Raises:
        ValueError: something that it needs is missing, or a switch is set that it does not have.
    """
    own = options.clone_split
    if own is None or options.levels is None:
        missing = "levels" if options.levels is None else "clone_split"
        raise ValueError(f"backbone.{missing} is null, and densification is clone_split; without levels: backbone=gs3d")
    idle = [name for name, value in vars(options.quirks).items() if value and name not in QUIRKS]
    if idle:
        raise ValueError(
            f"backbone.quirks.{idle[0]} is '{getattr(options.quirks, idle[0])}', which means nothing to "
            f"densification=clone_split: leave it '', only {' and '.join(QUIRKS)} do"
        )
    return GS3DOptions(
        name=options.name,
        filter=options.filter,
        published_iterations=options.published_iterations,
        sh_degree=options.sh_degree,
        sh_every=options.sh_every,
        initial_opacity=options.initial_opacity,
        max_primitives=options.max_primitives,
        rates=own.rates,
        density=own.density,
        mip=options.mip,
        levels=faithful(options.levels, options.fidelity),
        level_density=own.level_density,
        quirks=options.switches(),
        decay_until=options.decay_until,
    )


def octree_gs3d(options: OctreeGS3DOptions, context: BackboneContext) -> Anchors | GS3D:
    """The backbone octree_gs3d in the form that is asked for."""
    if options.densification == "clone_split":
        return GS3D(free_gaussians(options), context)
    return explicit_anchors(options, context)
