"""Who decides how many primitives a model has, as options say."""

from dataclasses import dataclass
from typing import Annotated

from gsx.backbones.adaptive import Adaptive, AdaptiveOptions
from gsx.backbones.capacity import Budget, BudgetOptions, Cap, Capacity, Growing
from gsx.core.ranges import Count, Range
from gsx.core.training.backbone import BackboneContext

CAPACITIES = ("published", "budget", "adaptive")


@dataclass(frozen=True, kw_only=True)
class CapacityOptions:
    """Who decides how many primitives there are, which every backbone of this package has."""

    max_primitives: Count
    """No primitive is added beyond this number; 0: none is withheld."""
    capacity: str = "published"
    """published, budget or adaptive. The default: runs older than this option."""
    looks: Annotated[int, Range(1, 1000)] = 4
    """Of a budget and adaptive: training views that the error of each primitive is found in at an event."""
    budget: BudgetOptions = BudgetOptions()
    adaptive: AdaptiveOptions = AdaptiveOptions()

    def __post_init__(self) -> None:
        if self.capacity not in CAPACITIES:
            raise ValueError(f"backbone.capacity is '{self.capacity}'; choose published, budget or adaptive")
        if (self.capacity == "budget") != (self.budget.primitives > 0):
            raise ValueError(
                f"backbone.capacity is {self.capacity} and backbone.budget.primitives {self.budget.primitives}: "
                "a budget of so many primitives takes both, capacity=budget and a number above 0"
            )
        if 0 < self.max_primitives < self.budget.primitives:
            raise ValueError(
                f"backbone.budget.primitives is {self.budget.primitives}, above backbone.max_primitives, which is "
                f"{self.max_primitives}: raise that, or set it to 0"
            )


def capacity_of(options: CapacityOptions, context: BackboneContext, growing: Growing) -> Capacity:
    """The one that the options name."""
    if options.capacity == "budget":
        return Budget(options.budget, context, growing)
    if options.capacity == "adaptive":
        return Adaptive(options.adaptive, context, growing, options.max_primitives)
    return Cap(options.max_primitives)
