"""Options of growth, and the switches of the references' quirks."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated

from gsx.core.ranges import Gradient, Interval, Range, Share, Steps


@dataclass(frozen=True, kw_only=True)
class GrowthOptions:
    """Numbers of growing and pruning, in steps of the published run; values in conf/backbone, with their sources."""

    observe_from: Steps
    start: Steps
    stop: Steps
    every: Interval
    success: Share
    """Fraction of an interval's steps in which an anchor must have been visited before it is judged; offsets: half.
    Of a step's views each counts by its weight in the loss."""
    gradient: Gradient
    """Mean NDC gradient above which an offset grows an anchor."""
    prune_opacity: Share
    """Anchors whose opacities sum to less than this per visit are removed."""
    largest_log_scale: Annotated[float, Range(-100, 100)]
    """While growing, log-scales of the Gaussians are held below this; see `Quirks.clamp`."""
    depths: Annotated[int, Range(1, 20)]
    """Without levels: sizes of cells tried in turn."""
    hierarchy: Annotated[int, Range(2, 64)]
    """Without levels: each size is this much smaller, its threshold half as many times larger."""
    coarsest: Annotated[int, Range(1, 10**6)]
    """Without levels: voxels along the largest cell."""
    update_ratio: Annotated[float, Range(0, 100)]
    """With levels: the threshold grows by fork ** this per level."""
    bias_gradient: Annotated[float, Range(0, 100)]
    """With levels: anchors with this fraction of the threshold are drawn from a little farther."""
    bias_step: Annotated[float, Range(0, 100)]
    """With levels: by how much, in levels."""
    overlap: bool
    """With levels: cells that hold an anchor may get another."""

    def __post_init__(self) -> None:
        if not self.success > 0:
            raise ValueError(f"backbone.growth.success is {self.success}; give a share above 0")


@dataclass(frozen=True, kw_only=True)
class Quirks:
    """Behaviour of the reference code that published numbers depend on; '' takes the value of `fidelity`."""

    early_stop: str
    """yes: if the coarsest cells grow nothing, finer ones are not tried (Scaffold-GS)."""
    clamp: str
    """world: log-scales are held below growth.largest_log_scale of world units; extent: of the extent."""
    voxel: str
    """squared: the automatic voxel is the median mean SQUARED neighbour distance (Scaffold-GS); distance: its root."""
    gate: str
    """open: promotion and bias from the first growth (a bug of Octree-GS); closed: once all levels are in training.
    Of free Gaussians: splits and their bias."""
    bias: str
    """all: bias also anchors of other levels, without limit (Octree-GS); level: of the level at hand, without limit
    (Octree-AnyGS, GSOctree); own: of the level at hand, at most 1."""
    finest: str
    """bounded: the strongest gradients of the finest level grow nothing (Octree-GS); open: they do."""
    promoted: str
    """zeros: features of anchors promoted to the next level (Octree-GS); max: of their parents."""
    duplicates: str
    """next: promotion looks for a free cell among the next level's; own: its own, as in published tables (a bug)."""


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
    """Sets every switch that is '' by the fidelity; `published`: where this reference differs from `CHOICES`.

    Raises:
        ValueError: a value is unknown; it and the known ones are named.
    """
    if fidelity not in FIDELITIES:
        raise ValueError(f"backbone.fidelity is '{fidelity}'; choose {' or '.join(FIDELITIES)}")
    defaults = {**FIDELITIES[fidelity], **(published if fidelity == "reference" else {})}
    values = {name: value or defaults[name] for name, value in vars(quirks).items()}
    for name, value in values.items():
        if value not in CHOICES[name]:
            raise ValueError(f"backbone.quirks.{name} is '{value}'; choose {' or '.join(CHOICES[name])}")
    return Quirks(**values)
