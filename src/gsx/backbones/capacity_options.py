"""Options of capacity, the rule for the number of primitives."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from gsx.backbones.adaptive import Adaptive, AdaptiveOptions
from gsx.backbones.capacity import Budget, BudgetOptions, Capacity, EventSteps
from gsx.core.ranges import Count, Range
from gsx.core.training.backbone import BackboneContext


@dataclass(frozen=True, kw_only=True)
class CapacityOptions:
    """Options of capacity, common to all backbones of this package."""

    max_primitives: Count
    """Cap on the number of primitives; 0: none."""
    capacity: str = "published"
    """One of `capacities`; the default is for runs older than this option."""
    looks: Annotated[int, Range(1, 1000)] = 4
    """With budget or adaptive: training views in which an event measures the error of each primitive."""
    budget: BudgetOptions = BudgetOptions()
    adaptive: AdaptiveOptions = AdaptiveOptions()

    capacities: ClassVar[tuple[str, ...]] = ("published", "budget", "adaptive")

    def __post_init__(self) -> None:
        if self.capacity not in self.capacities:
            others = "" if "mcmc" in self.capacities else ", or mcmc with backbone=gs3d, gs3d_zoom or mip_splatting"
            raise ValueError(f"backbone.capacity is '{self.capacity}'; choose {', '.join(self.capacities)}{others}")
        self.check_number("budget", self.budget.primitives)

    def check_number(self, capacity: str, primitives: int) -> None:
        """Raises ValueError unless a capacity and its number of primitives are set together, below the cap."""
        key = f"backbone.{capacity}.primitives"
        if (self.capacity == capacity) != (primitives > 0):
            raise ValueError(
                f"backbone.capacity is {self.capacity} and {key} {primitives}: give both, capacity={capacity} and a "
                "number above 0"
            )
        if 0 < self.max_primitives < primitives:
            raise ValueError(
                f"{key} is {primitives}, above backbone.max_primitives {self.max_primitives}: raise the latter, or set "
                "it to 0"
            )


def capacity_of(options: CapacityOptions, context: BackboneContext, events: EventSteps) -> Capacity:
    """Builds the capacity that the options name."""
    if options.capacity == "budget":
        return Budget(options.budget, context, events)
    if options.capacity == "adaptive":
        return Adaptive(options.adaptive, context, events, options.max_primitives)
    return Capacity(options.max_primitives)
