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
    """Forks from the whole box to a cell of level 0; -1: the middle level has cells of `voxel`."""
    voxel: Length
    """Cell of the middle level if base_layer is -1, scene units."""
    distance_quantile: Share
    """Upper quantile of distances, per camera and over cameras; the lower one mirrors it (Octree-GS, set_level)."""
    extend: Annotated[float, Range(1, 1000)]
    """Length of the box over the range of the points' coordinates (Octree-GS, octree_sample)."""
    extend_rule: str
    """reference: multiply both ends of the range, which misses points far from the origin (Octree-GS); sane: extend the
    box equally on both sides; '': by backbone.fidelity."""
    visible_threshold: Annotated[float, Range(-1, 1)]
    """Least fraction of training cameras that draw a primitive's level; -1: the mean fraction (Octree-GS, weed_out)."""
    mode: str
    """Rounding of levels: round, floor, ceil, or progressive, which fades the finest level in (Octree-GS)."""
    half_cell: bool | None
    """True: measure distances to a point half a cell beyond the node (Octree-GS); None: by backbone.fidelity."""
    zoom: str
    """Levels of cameras finer than those of training, finer: those of their resolution, trained or not (Octree-GS);
    training: at most those of the finest training camera."""
    coarse_until: Steps
    """Published step at which all levels are in training (Octree-GS, set_coarse_interval); 0: from the start."""
    coarse_factor: Annotated[float, Range(1, 1000)]
    """Ratio of each interval between two levels to the next (Octree-GS, set_coarse_interval)."""
    cell_pixels: Annotated[float, Range(0, 1000)] = 0.0
    """Ours: least size of a cell of level 0 at the farthest distance, px; 0: no limit, as in runs older than this."""

    def __post_init__(self) -> None:
        threshold, rules = self.visible_threshold, ", ".join(EXTEND_RULES) + ", or '' for backbone.fidelity's"
        self.demand("mode", self.mode in MODES, f"choose {', '.join(MODES)}")
        self.demand("extend_rule", self.extend_rule in ("", *EXTEND_RULES), f"choose {rules}")
        self.demand("zoom", self.zoom in ZOOM_RULES, f"choose {', '.join(ZOOM_RULES)}")
        self.demand("count", self.count != 0, "give at least 1, or -1 to take it from the scene")
        self.demand("distance_quantile", self.distance_quantile > 0.5, "give a value above 0.5, at most 1")
        self.demand("visible_threshold", threshold == -1 or 0 <= threshold < 1, "give -1, or from 0 to below 1")

    def demand(self, name: str, met: bool, advice: str) -> None:
        """Raises ValueError if an option's condition is not met."""
        if not met:
            raise ValueError(f"backbone.levels.{name} is {getattr(self, name)!r}; {advice}")


def faithful(options: LevelOptions | None, fidelity: str) -> LevelOptions | None:
    """Returns the options with unset quirks of the reference set by the fidelity."""
    if options is None:
        return None
    half_cell = fidelity == "reference" if options.half_cell is None else options.half_cell
    return replace(options, extend_rule=options.extend_rule or fidelity, half_cell=half_cell)


def checked_end(options: LevelOptions | None, published: int) -> None:
    """Raises ValueError if the finest levels would never be trained."""
    if options is not None and options.coarse_until >= published:
        raise ValueError(
            f"backbone.levels.coarse_until is {options.coarse_until}, and the published run "
            f"(backbone.published_iterations) ends at {published}, so the finest level would never train: lower it"
        )
