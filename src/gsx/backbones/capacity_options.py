"""Options of capacity, the rule for the number of primitives."""

from dataclasses import dataclass
from typing import Annotated

from gsx.backbones.adaptive import Adaptive, AdaptiveOptions
from gsx.backbones.capacity import Budget, BudgetOptions, Capacity, EventSteps
from gsx.core.ranges import Count, Range
from gsx.core.training.backbone import BackboneContext

CAPACITIES = ("published", "budget", "adaptive")


@dataclass(frozen=True, kw_only=True)
class CapacityOptions:
    """Options of capacity, common to all backbones of this package."""

    max_primitives: Count
    """Cap on the number of primitives; 0: none."""
    capacity: str = "published"
    """published, budget or adaptive; the default is for runs older than this option."""
    looks: Annotated[int, Range(1, 1000)] = 4
    """With budget or adaptive: training views in which an event measures the error of each primitive."""
    budget: BudgetOptions = BudgetOptions()
    adaptive: AdaptiveOptions = AdaptiveOptions()

    def __post_init__(self) -> None:
        if self.capacity not in CAPACITIES:
            raise ValueError(f"backbone.capacity is '{self.capacity}'; choose published, budget or adaptive")
        if (self.capacity == "budget") != (self.budget.primitives > 0):
            raise ValueError(
                f"backbone.capacity is {self.capacity} and backbone.budget.primitives {self.budget.primitives}: "
                "a budget needs both, capacity=budget and a number above 0"
            )
        if 0 < self.max_primitives < self.budget.primitives:
            raise ValueError(
                f"backbone.budget.primitives is {self.budget.primitives}, above backbone.max_primitives "
                f"{self.max_primitives}: raise the latter, or set it to 0"
            )


def capacity_of(options: CapacityOptions, context: BackboneContext, events: EventSteps) -> Capacity:
    """Builds the capacity that the options name."""
    if options.capacity == "budget":
        return Budget(options.budget, context, events)
    if options.capacity == "adaptive":
        return Adaptive(options.adaptive, context, events, options.max_primitives)
    return Capacity(options.max_primitives)
