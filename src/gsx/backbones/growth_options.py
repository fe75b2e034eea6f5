"""Options of growth, and switches of the references' quirks."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

from gsx.core.ranges import Gradient, Interval, Range, Share, Steps


@dataclass(frozen=True, kw_only=True)
class GrowthOptions:
    """Options of growing and pruning, steps of the published run; values in conf/backbone, with their sources."""

    observe_from: Steps
    start: Steps
    stop: Steps
    every: Interval
    success: Share
    """Fraction of an interval's steps with visits that an anchor needs before it may be pruned; offsets: half."""
    gradient: Gradient
    """Mean NDC gradient above which an offset grows an anchor."""
    prune_opacity: Share
    """Anchors whose opacities sum to less than this per visit are removed."""
    largest_log_scale: Annotated[float, Range(-100, 100)]
    """Upper bound of the Gaussians' log-scales while growing; see `Quirks.clamp`."""
    depths: Annotated[int, Range(1, 20)]
    """Without levels: number of cell sizes."""
    hierarchy: Annotated[int, Range(2, 64)]
    """Without levels: ratio of one cell size to the next; thresholds grow by half of it."""
    coarsest: Annotated[int, Range(1, 10**6)]
    """Without levels: edge of the largest cell, voxels."""
    update_ratio: Annotated[float, Range(0, 100)]
    """With levels: the threshold grows by fork ** this per level."""
    bias_gradient: Annotated[float, Range(0, 100)]
    """With levels: fraction of the threshold above which an anchor is drawn from farther away."""
    bias_step: Annotated[float, Range(0, 100)]
    """With levels: increase of its level bias, in levels."""
    overlap: bool
    """With levels: True allows a second anchor in a cell."""

    def __post_init__(self) -> None:
        if not self.success > 0:
            raise ValueError(f"backbone.growth.success is {self.success}; give a share above 0")


@dataclass(frozen=True, kw_only=True)
class Quirks:
    """Quirks of the reference code that published numbers depend on; '' takes the value of `fidelity`."""

    early_stop: str
    """yes: stop if the coarsest cells grow nothing (Scaffold-GS)."""
    clamp: str
    """Unit of growth.largest_log_scale: world units, or the scene's extent."""
    voxel: str
    """Automatic voxel, squared: the median mean SQUARED neighbour distance (Scaffold-GS); distance: its root."""
    gate: str
    """Promotion and bias (free Gaussians: splits and bias), open: from the start (a bug of Octree-GS); closed: once all
    levels are in training."""
    bias: str
    """all: anchors of all levels get bias, without limit (Octree-GS); level: those of the level at hand, without limit
    (Octree-AnyGS, GSOctree); own: those of the level at hand, at most 1."""
    finest: str
    """bounded: the largest gradients of the finest level grow nothing (Octree-GS); open: they do."""
    promoted: str
    """Features of promoted anchors, zeros: 0 (Octree-GS); max: the largest of their parents."""
    duplicates: str
    """Level whose free cells promotion uses, next: the next one's; own: its own, as in published tables (a bug)."""


CHOICES = {
    "early_stop": ("yes", "no"),
    "clamp": ("world", "extent"),
    "voxel": ("squared", "distance"),
    "gate": ("open", "closed"),
    "bias": ("all", "own", "level"),
    "finest": ("bounded", "open"),
    "promoted": ("zeros", "max"),
    "duplicates": ("next", "own"),
}
"""Values of each quirk, the reference's first."""
SANE = {name: values[1] for name, values in CHOICES.items()} | {"duplicates": "next"}
FIDELITIES = {"reference": {name: values[0] for name, values in CHOICES.items()}, "sane": SANE}


def resolved(quirks: Quirks, fidelity: str, published: Mapping[str, str] = MappingProxyType({})) -> Quirks:
    """Sets every switch that is '' by the fidelity; ValueError: a value is unknown.

    `published`: quirks in which this reference differs from `CHOICES`.
    """
    if fidelity not in FIDELITIES:
        raise ValueError(f"backbone.fidelity is '{fidelity}'; choose {' or '.join(FIDELITIES)}")
    defaults = {**FIDELITIES[fidelity], **(published if fidelity == "reference" else {})}
    values = {name: value or defaults[name] for name, value in vars(quirks).items()}
    for name, value in values.items():
        if value not in CHOICES[name]:
            raise ValueError(f"backbone.quirks.{name} is '{value}'; choose {' or '.join(CHOICES[name])}")
    return Quirks(**values)
