"""Options of levels of detail."""

from dataclasses import dataclass, replace
from typing import Annotated

from gsx.core.ranges import Length, Range, Share, Steps

MODES = ("round", "floor", "ceil", "progressive")
EXTEND_RULES = ("reference", "sane")
ZOOM_RULES = ("finer", "training")


@dataclass(frozen=True, kw_only=True)
class LevelOptions:
    """Options of the levels; values in conf/backbone, with their sources."""

    fork: Annotated[int, Range(2, 64)]
    count: Annotated[int, Range(-1, 32)]
    """Number of levels; -1: from the range of distances in the scene (Octree-GS, set_level)."""
    first: Annotated[int, Range(-1, 32)]
    """Highest level at the start; -1: half of them (Octree-GS, set_level)."""
    base_layer: Annotated[int, Range(-1, 64)]
    """Forks from the whole box to a cell of level 0; -1: such that the middle level has cells of `voxel`."""
    voxel: Length
    """Cell of the middle level where base_layer is -1, scene units."""
    distance_quantile: Share
    """Distances between this quantile and its mirror count, per camera and over cameras (Octree-GS, set_level)."""
    extend: Annotated[float, Range(1, 1000)]
    """The box is the points' range of coordinates times this (Octree-GS, octree_sample)."""
    extend_rule: str
    """reference: both ends of the range are multiplied, so that far from the origin the box misses points; sane: the
    box grows on both sides wherever it lies, to the same length (Octree-GS); '': as backbone.fidelity says."""
    visible_threshold: Annotated[float, Range(-1, 1)]
    """A primitive is kept if more than this fraction of the training cameras draw its level; -1: the mean of that
    fraction (Octree-GS, weed_out)."""
    mode: str
    """How a level becomes whole: round, floor, ceil, or progressive, which fades the finest level in (Octree-GS)."""
    half_cell: bool | None
    """Distances are taken to a point half a cell beyond the node, as the reference does (Octree-GS); None: as
    backbone.fidelity says."""
    zoom: str
    """What cameras finer than those of training draw. finer: the levels that belong to their resolution, as the
    reference does, trained there or not; training: none that the finest training camera would not draw."""
    coarse_until: Steps
    """Published step at which all levels take part in training (Octree-GS, set_coarse_interval); 0: from the start."""
    coarse_factor: Annotated[float, Range(1, 1000)]
    """Each interval between two levels is this much shorter than the one before (Octree-GS, set_coarse_interval)."""
    cell_pixels: Annotated[float, Range(0, 1000)] = 0.0
    """Ours: no more forks for the base layer than leave its cells so many pixels at the farthest; 0: whatever
    base_layer and voxel say. The default: runs older than this option."""

    def __post_init__(self) -> None:
        threshold, rules = self.visible_threshold, ", ".join(EXTEND_RULES) + ", or '' for backbone.fidelity's"
        self.demand("mode", self.mode in MODES, f"choose {', '.join(MODES)}")
        self.demand("extend_rule", self.extend_rule in ("", *EXTEND_RULES), f"choose {rules}")
        self.demand("zoom", self.zoom in ZOOM_RULES, f"choose {', '.join(ZOOM_RULES)}")
        self.demand("count", self.count != 0, "give at least 1, or -1 to take it from the scene")
        self.demand("distance_quantile", self.distance_quantile > 0.5, "give a value above 0.5, at most 1")
        self.demand("visible_threshold", threshold == -1 or 0 <= threshold < 1, "give -1, or from 0 to below 1")

    def demand(self, name: str, met: bool, advice: str) -> None:
        """Refuses a value that does not meet a condition."""
        if not met:
            raise ValueError(f"backbone.levels.{name} is {getattr(self, name)!r}; {advice}")


def faithful(options: LevelOptions | None, fidelity: str) -> LevelOptions | None:
    """Returns the options with open switches of the reference's quirks set by the fidelity."""
    if options is None:
        return None
    half_cell = fidelity == "reference" if options.half_cell is None else options.half_cell
    return replace(options, extend_rule=options.extend_rule or fidelity, half_cell=half_cell)


def checked_end(options: LevelOptions | None, published: int) -> None:
    """Refuses a schedule that ends with levels that never took part in training."""
    if options is not None and options.coarse_until >= published:
        raise ValueError(
            f"backbone.levels.coarse_until is {options.coarse_until}, and the published run "
            f"(backbone.published_iterations) ends at {published}: the finest level would never train; give less"
        )
