"""Constants of planning, from conf/minutes.yaml."""

from dataclasses import dataclass, field
from functools import cache
from importlib.resources import as_file, files
from typing import Any

from omegaconf import OmegaConf

from gsx.experiments.runs.typed import typed


@dataclass(frozen=True, kw_only=True)
class ProbeOptions:
    """Extent of the measurement before a plan."""

    pixels: int
    """Most pixels of a view at the larger of both sizes."""
    warm: int
    """Steps at each size before the clock starts."""
    steps: int
    """Steps at each size."""


@dataclass(frozen=True, kw_only=True)
class CostOptions:
    """Cost model of a step, relative to a measured one."""

    late: float
    """Cost of a pixel in the whole run relative to the first steps."""
    primitives: float
    """Megapixels that cost as much as 10^6 primitives."""
    event: float
    """Steps that an event of density control costs."""
    random: float
    """Cost of pixels and primitives in the whole run relative to the first steps, if those begin with random points."""
    rows: dict[str, float]
    """Primitives that one row of a backbone's table costs; others: 1."""


@dataclass(frozen=True, kw_only=True)
class Costs:
    """Cost models by type of device."""

    cpu: CostOptions
    cuda: CostOptions

    def of(self, device: str) -> CostOptions:
        """Returns the cost model of a device."""
        return self.cuda if device == "cuda" else self.cpu


@dataclass(frozen=True, kw_only=True)
class PlanOptions:
    """Constants of a plan; values and sources in conf/minutes.yaml."""

    default: float
    """Minutes where none are chosen."""
    used: float
    """Share of the time that is planned."""
    least_steps: int
    """Fewest steps of a run."""
    enough_steps: int
    """Steps below which photos are reduced further."""
    passes: float
    """Passes over the training views below which photos are reduced further."""
    least_pixels: float
    """Fewest pixels of a training view."""
    most_pixels: float
    """Most pixels of a training view."""
    density: float
    """Primitives at the end of growth per pixel of a training view and square root of the views."""
    most_growth: float
    """Most primitives that growth adds per thousand steps."""
    events: int
    """Events of density control that a short run has at least."""
    stereo: float
    """Starting points by stereo, as a share of the primitives at the end of growth."""
    report: float
    """Seconds of export and report after evaluation."""
    probe: ProbeOptions
    cost: Costs
    """Cost model by type of device."""
    schedule: dict[str, Any] = field(default_factory=dict)
    """Values by dotted key."""


@cache
def plan_options() -> PlanOptions:
    """Reads conf/minutes.yaml."""
    with as_file(files("gsx.conf").joinpath("minutes.yaml")) as path:
        values: Any = OmegaConf.to_container(OmegaConf.load(path))
    return typed(PlanOptions, values, "minutes")
