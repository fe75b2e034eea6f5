"""Steps that no module may skip."""

from gsx.core.training.backbone import WithMilestones
from gsx.core.training.run import Run


def last_milestone(run: Run, before: int) -> int:
    """Returns the last milestone of modules or backbone before a step."""
    steps = list(run.backbone.milestones()) if isinstance(run.backbone, WithMilestones) else []
    steps += [step for module in run.modules.values() for step in module.milestones()]
    return max((step for step in steps if step < before), default=0)
