"""Octree-GS on explicit Gaussians in both forms: on anchors, as reported, and free with clone and split (spec 4)."""

from dataclasses import dataclass

from gsx.backbones.anchors import Anchors, ExplicitOptions, explicit_anchors
from gsx.backbones.gs3d import GS3D, GS3DOptions
from gsx.core.backbone import Beginning

FORMS = ("anchors", "clone_split")


@dataclass(frozen=True, kw_only=True)
class OctreeGS3DOptions(ExplicitOptions):
    """Options of both forms; values in conf/backbone/octree_gs3d.yaml."""

    densification: str
    """anchors: new ones on grid nodes (spec 4A); clone_split: of Gaussians anywhere (spec 4B)."""
    clone_split: GS3DOptions
    """What the second form has of its own; it shares levels, filter and max_primitives with the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.densification not in FORMS:
            raise ValueError(f"backbone.densification is '{self.densification}'; choose {' or '.join(FORMS)}")


def octree_gs3d(options: OctreeGS3DOptions, beginning: Beginning) -> Anchors | GS3D:
    """The backbone octree_gs3d in the form that is asked for."""
    if options.densification == "clone_split":
        return GS3D(options.clone_split, beginning)
    return explicit_anchors(options, beginning)
