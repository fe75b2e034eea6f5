"""Constants of planning, from conf/minutes.yaml, and the cost model of training: seconds of a step by its pixels and
primitives, and their sum over a schedule.
"""

from collections.abc import Iterator, Sequence
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


MILLION = 1e6


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Seconds measured on this machine and scene, before a plan."""

    base: float
    """Seconds of a step without pixels, with the primitives at the start."""
    megapixel: float
    """Seconds of a step per 10^6 pixels."""
    pixels: float
    """Mean pixels of a training view in the measurement."""
    downscale: int
    """Reduction of the photos in the measurement."""
    primitives: int
    """Rows of the model's table at the start."""
    photo: float
    """Seconds until a training photo is on the device for the first time."""
    evaluate: float
    """Seconds to evaluate one test view at all zooms."""
    check: float
    """Seconds to render a test view at x1."""
    path: str
    """Path of the rasterizer that was measured."""
    device: str
    """Type of the device that was measured: cpu or cuda."""
    random: bool = False
    """True: the model began with random points, which cover many pixels."""
    stereo: float = 0.0
    """Seconds to measure the depths of a photo by stereo; 0: the scene has no points to search around."""


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Stretch of a schedule at one resolution."""

    start: float
    """Share of the steps at which it begins."""
    stop: float
    """Share of the steps at which it ends."""
    scale: float
    """Sides of its renders, of those of photos."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Rows of a table over a run: a power of the share of the growth, then constant."""

    first: int
    last: int
    start: float
    """Share of the steps at which growth begins."""
    stop: float
    """Share of the steps at which growth ends."""
    power: float
    events: float = 0.0
    """Events of density control."""

    def at(self, share: float) -> float:
        """Returns the rows at a share of the steps."""
        passed = min(1.0, max(0.0, (share - self.start) / max(self.stop - self.start, 1e-9)))
        return self.first + (self.last - self.first) * passed**self.power

    def events_between(self, start: float, stop: float) -> float:
        """Returns the mean number of events between two shares of the steps."""
        common = max(0.0, min(stop, self.stop) - max(start, self.start))
        return self.events * common / max(self.stop - self.start, 1e-9)


def stages_of(coarse: int, coarse_until: float, fine: int, fine_from: float) -> list[Stage]:
    """Returns the stages of a schedule with coarse views first, halved in equal times, and finer renders at last.

    Args:
        coarse: Reduction of the first views, a power of two; 1: none.
        coarse_until: Share of the steps on coarse views.
        fine: Resolution of the last renders relative to photos; 1: none.
        fine_from: Share of the steps before them.
    """
    halvings = coarse.bit_length() - 1 if coarse_until > 0 else 0
    edges = [coarse_until * number / halvings for number in range(halvings + 1)] if halvings else [0.0]
    stages = [Stage(start=edges[n], stop=edges[n + 1], scale=2.0 ** (n - halvings)) for n in range(halvings)]
    plain_until = max(edges[-1], fine_from if fine > 1 else 1.0)
    stages.append(Stage(start=edges[-1], stop=plain_until, scale=1.0))
    stages.append(Stage(start=plain_until, stop=1.0, scale=float(fine)))
    return [stage for stage in stages if stage.stop > stage.start]


@dataclass(frozen=True, kw_only=True)
class StepCost:
    """Seconds of a step: base + pixels + primitives; those of an event in steps."""

    base: float
    pixel: float
    row: float
    event: float = 0.0

    def seconds(self, pixels: float, rows: float) -> float:
        """Returns the seconds of a step."""
        return self.base + self.pixel * pixels + self.row * rows


def step_cost(measurement: Measurement, options: CostOptions, backbone: str) -> StepCost:
    """Returns the cost of a step by a measurement at the start and the relative costs of the options."""
    lasting = options.random if measurement.random else 1.0
    unit = lasting * measurement.megapixel / MILLION
    row = unit * options.primitives * options.rows.get(backbone, 1.0)
    row = min(row, measurement.base / max(1, measurement.primitives))  # no more than what was measured
    base = max(0.0, lasting * measurement.base - row * measurement.primitives)
    return StepCost(base=base, pixel=unit * options.late, row=row, event=options.event)


SHARES = 40
"""Equal shares of the steps in which planned seconds are summed."""


def planned_seconds(cost: StepCost, stages: Sequence[Stage], growth: Growth, pixels: float, steps: int) -> list[float]:
    """Returns the seconds of training after each of SHARES equal shares of the steps.

    Args:
        cost: Cost of a step.
        stages: Stages that cover the schedule.
        growth: Rows over the schedule.
        pixels: Pixels of a training view.
        steps: Steps of the run.
    """
    total, sums = 0.0, list[float]()
    for number in range(SHARES):
        start, stop = number / SHARES, (number + 1) / SHARES
        rows, more = growth.at((start + stop) / 2), cost.event * growth.events_between(start, stop)
        for stage, share in stage_parts(stages, start, stop):
            seconds = cost.seconds(pixels * stage.scale**2, rows)
            total += (steps * share + more * share * SHARES) * seconds
        sums.append(total)
    return sums


def stage_parts(stages: Sequence[Stage], start: float, stop: float) -> Iterator[tuple[Stage, float]]:
    """Yields the stages between two shares of the steps, with the length of their common part."""
    for stage in stages:
        common = min(stop, stage.stop) - max(start, stage.start)
        if common > 0:
            yield stage, common
