"""Steps that no module may skip."""

from gsx.core.training.backbone import WithMilestones
from gsx.core.training.run import Run


def milestones_of(run: Run) -> list[int]:
    """Returns the milestones of modules and backbone, in no order."""
    steps = list(run.backbone.milestones()) if isinstance(run.backbone, WithMilestones) else []
    return steps + [step for module in run.modules.values() for step in module.milestones()]


def last_milestone(run: Run, before: int) -> int:
    """Returns the last milestone before a step; 0: there is none."""
    return max((step for step in milestones_of(run) if step < before), default=0)


def next_milestone(run: Run, after: int, before: int) -> int:
    """Returns the first milestone after a step; if there is none before another, that one."""
    return min((step for step in milestones_of(run) if after < step < before), default=before)
