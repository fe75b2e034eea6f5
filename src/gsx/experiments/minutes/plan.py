"""Plan of a run that ends after a fixed wall time: size, steps, growth and resolution over the steps."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsx.core.errors import ConfigError
from gsx.core.options import flattened
from gsx.experiments.minutes.cost import (
    CostOptions,
    Growth,
    Measurement,
    PlanOptions,
    planned_seconds,
    stages_of,
    step_cost,
)
from gsx.experiments.runs.settings import Settings

SIZE, WIDTH = "scene.downscale", "scene.max_width"
CAPACITY, BUDGET, MOST = "backbone.capacity", "backbone.budget.primitives", "backbone.max_primitives"
PATH, PASSES, STEREO = "rasterizer.path", "backbone.density.passes", "scene.stereo"
CHECKS, FINE_FROM = "training.test_points", "training.supersampling.start"
EVERY = 100
"""Steps between events of density control in published runs (3D-GS)."""
MOST_DOWNSCALE = 64
"""Largest reduction of photos."""
CHECKED = 8
"""Most test views that are rendered for a point of the curve."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """Run to plan."""

    settings: Settings
    fixed: frozenset[str]
    """Keys whose values the plan keeps."""
    views: int
    """Training views."""
    tests: int
    """Test views."""
    seconds: float
    """Wall time from now until the report."""
    published: int
    """Steps of the published run."""
    measurement: Measurement
    options: PlanOptions

    @property
    def values(self) -> dict[str, Any]:
        """Values of the settings by dotted key, with those of planned runs."""
        return flattened(self.settings.resolved) | schedule_of(self.settings, self.fixed, self.options)

    @property
    def cost(self) -> CostOptions:
        """Cost model of the measured device."""
        return self.options.cost.of(self.measurement.device)


def schedule_of(settings: Settings, fixed: frozenset[str], options: PlanOptions) -> dict[str, Any]:
    """Returns the values of planned runs by dotted key, of keys that the settings have and the user leaves open.

    Augmenters may use the finer renders from the first step, so their start stays with any.
    """
    config, kept = flattened(settings.resolved), {*fixed, *((FINE_FROM,) if settings.augmenters else ())}
    return {key: value for key, value in options.schedule.items() if key in config and key not in kept}


def chooses_size(settings: Settings, fixed: frozenset[str]) -> bool:
    """Returns whether a plan may choose the reduction of the photos: nothing else does."""
    values = flattened(settings.resolved)
    whole = values.get(SIZE) == 1 and values.get("scene.scales", [1]) == [1]
    return whole and hasattr(settings.scene.options, "downscale") and not fixed & {SIZE, WIDTH}


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A planned run."""

    steps: int
    downscale: int
    primitives: int
    """Rows when growth ends."""
    planned: Sequence[float]
    """Seconds of training after equal shares of the steps."""
    most: float
    """Most seconds of training."""
    other: float
    """Seconds of photos, evaluation and report."""

    @property
    def seconds(self) -> float:
        """Seconds from now until the report."""
        return self.planned[-1] + self.other


def plan_run(task: Task) -> Plan:
    """Plans a run: the finest photos over which the time allows enough passes, and as many steps as it allows.

    Raises:
        ConfigError: the time is not enough for the fewest steps.
    """
    options = task.options
    enough = min(task.published, max(options.enough_steps, math.ceil(options.passes * task.views)))
    plans = [plan_at(task, size) for size in sizes_of(task)]
    chosen = next((plan for plan in plans if plan.steps >= enough), plans[-1])
    if chosen.seconds > task.seconds or chosen.steps < min(task.published, options.least_steps):
        raise ConfigError(too_short(task, chosen))
    return chosen


def too_short(task: Task, shortest: Plan) -> str:
    """Returns the error for a time that is not enough."""
    least = task.options.least_steps
    needed = shortest.other + shortest.planned[-1] / shortest.steps * least
    return (
        f"{max(0.0, task.seconds):.0f} s are left for training, evaluation and report, and {least} steps at "
        f"1/{shortest.downscale} size take about {needed:.0f} s: give more minutes"
    )


def sizes_of(task: Task) -> list[int]:
    """Returns the reductions of photos to choose from, finest first; the present one alone if it is fixed."""
    measurement = task.measurement
    if not chooses_size(task.settings, task.fixed):
        return [measurement.downscale]
    full = measurement.pixels * measurement.downscale**2
    sizes = [1 << power for power in range(MOST_DOWNSCALE.bit_length())]
    usable = [size for size in sizes if task.options.least_pixels <= full / size**2 <= task.options.most_pixels]
    return usable or [1]


def plan_at(task: Task, downscale: int) -> Plan:
    """Returns the plan with the most steps at a reduction of the photos."""
    other = other_seconds(task, downscale)
    left = task.seconds * task.options.used - other
    low, high = 1, task.published
    while low < high:
        middle = (low + high + 1) // 2
        if training_seconds(task, downscale, middle)[-1] <= left:
            low = middle
        else:
            high = middle - 1
    return Plan(
        steps=low,
        downscale=downscale,
        primitives=growth_of(task, downscale, low).last,
        planned=training_seconds(task, downscale, low),
        most=left,
        other=other,
    )


def pixels_at(task: Task, downscale: int) -> float:
    """Returns the pixels of a training view."""
    return task.measurement.pixels * (task.measurement.downscale / downscale) ** 2


def other_seconds(task: Task, downscale: int) -> float:
    """Returns the seconds of photos, evaluation and report."""
    measurement, larger = task.measurement, pixels_at(task, downscale) / task.measurement.pixels
    checks = task.values[CHECKS] * min(task.tests, CHECKED) * measurement.check
    zooms = drawn_pixels(task, downscale) / drawn_pixels(task, measurement.downscale)
    drawn = larger * (task.tests * zooms * measurement.evaluate + checks)
    stereo = measurement.stereo if stereo_points(task, target_of(task, downscale)) else 0.0
    return task.views * (measurement.photo + stereo) + drawn + task.options.report


def with_stereo(task: Task) -> bool:
    """Returns whether Gaussians begin with points by stereo: on photos with points, unless the user chooses.

    Anchors begin without: nobody has measured them.
    """
    chosen = STEREO not in task.values or STEREO in task.fixed
    return not chosen and task.measurement.stereo > 0 and rows_of(task) == 1


def drawn_pixels(task: Task, downscale: int) -> float:
    """Returns the pixels that are drawn of a test view at all zooms that photos have, in pixels at x1."""
    if SIZE not in task.values:
        return 1.0
    return 1.0 + sum(zoom**2 for zoom in task.settings.evaluation.zoom if zoom != 1 and zoom <= downscale)


def training_seconds(task: Task, downscale: int, steps: int) -> list[float]:
    """Returns the seconds of training after equal shares of the steps."""
    values = task.values
    coarse = values.get("training.coarse_to_fine.factor", 1), values.get("training.coarse_to_fine.until", 0.0)
    fine = values.get("training.supersampling.factor", 1), values.get(FINE_FROM, 0.0)
    growth, pixels = growth_of(task, downscale, steps), pixels_at(task, downscale)
    cost = step_cost(task.measurement, task.cost, task.settings.backbone.component.name)
    return planned_seconds(cost, stages_of(*coarse, *fine), growth, pixels, steps)


def growth_of(task: Task, downscale: int, steps: int) -> Growth:
    """Returns the rows of the model over the run."""
    first, options, values = task.measurement.primitives, task.options, task.values
    target = target_of(task, downscale)
    first += stereo_points(task, target)
    last = min(target, first + options.most_growth * steps / 1000)
    if rows_of(task) > 1:  # anchors of coarse levels show much: a model that lost some drew nothing (castle)
        last = max(last, first)
    if CAPACITY in task.fixed:
        last = values.get(f"backbone.{values[CAPACITY]}.primitives", last)
    last = min(last, values.get(MOST) or last)
    start, stop = growth_window(task)
    events = events_of(task, steps)
    return Growth(first=first, last=max(1, round(last)), start=start, stop=stop, power=0.5, events=events)


def target_of(task: Task, downscale: int) -> float:
    """Returns the rows that suit the pixels of all views."""
    return task.options.density * pixels_at(task, downscale) * math.sqrt(task.views) / rows_of(task)


def stereo_points(task: Task, last: float) -> int:
    """Returns the points by stereo that a run begins with, of so many rows when growth ends."""
    if not with_stereo(task):
        return 0
    return max(0, round(task.options.stereo * last - task.measurement.primitives))


def events_of(task: Task, steps: int) -> float:
    """Returns the events of density control: a pass over the views or a published interval apart, but some at least."""
    start, stop = growth_window(task)
    growing = steps * (stop - start)
    every = max(task.views, EVERY * steps / task.published)
    return max(growing / every, min(growing, task.options.events) if PASSES in task.values else 0.0)


def rows_of(task: Task) -> float:
    """Returns the primitives that a row of the backbone's table costs."""
    return task.cost.rows.get(task.settings.backbone.component.name, 1.0)


def growth_window(task: Task) -> tuple[float, float]:
    """Returns the shares of the steps between which primitives are added."""
    values = task.values
    for group in ("backbone.density", "backbone.growth"):
        if f"{group}.start" in values:
            start, stop = (min(1.0, values[f"{group}.{edge}"] / task.published) for edge in ("start", "stop"))
            return min(start, stop), stop
    return 0.0, 0.5


def changes_of(task: Task, plan: Plan) -> Mapping[str, Any]:
    """Returns the values by dotted key that make a planned run."""
    values, fixed = task.values, task.fixed
    changes = schedule_of(task.settings, fixed, task.options)
    changes |= {"iterations": plan.steps, PATH: task.measurement.path}
    if chooses_size(task.settings, fixed):
        changes[SIZE] = plan.downscale
    changes |= capacity_of(values, fixed, plan.primitives)
    if with_stereo(task):
        changes[STEREO] = stereo_points(task, plan.primitives)
    if PASSES in values and PASSES not in fixed:
        start, stop = growth_window(task)
        changes[PASSES] = min(1.0, round(plan.steps * (stop - start) / (task.options.events * task.views), 2))
    return changes | deadline_of(values, plan)


def capacity_of(values: Mapping[str, Any], fixed: frozenset[str], primitives: int) -> dict[str, Any]:
    """Returns the values by which a run grows to a number of primitives; empty: its growth is chosen, or fixed."""
    if values.get(CAPACITY) != "published" or CAPACITY in fixed:
        return {}
    return {CAPACITY: "budget", BUDGET: min(primitives, values.get(MOST) or primitives)}


def deadline_of(values: Mapping[str, Any], plan: Plan) -> dict[str, Any]:
    """Returns the deadline of a planned run: its last stretch begins with finer renders."""
    fine = values.get("training.supersampling.factor", 1) > 1
    below = "training.deadline"
    return {
        f"{below}.seconds": float(f"{max(plan.most, plan.planned[-1]):.6g}"),
        f"{below}.steps": plan.steps,
        f"{below}.planned": [float(f"{seconds:.6g}") for seconds in plan.planned],
        **({f"{below}.to": values[FINE_FROM]} if fine and values[FINE_FROM] >= LEAST_TO else {}),
    }


LEAST_TO = 0.5
"""Least share of the steps before a last stretch."""
