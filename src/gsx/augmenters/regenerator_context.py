"""What a regenerator may learn from, taken from a run: training views, and what the model shows as it is now."""

from gsx.core.training.regenerator import RegeneratorContext
from gsx.core.training.render import render
from gsx.core.training.run import Run


def regenerator_context(run: Run, seed: int) -> RegeneratorContext:
    """Everything but held-out views, for a run that is being trained."""
    assert run.held_out is not None
    held_out = run.held_out
    return RegeneratorContext(
        views=run.train_views,
        reduction=run.scene.reduction,
        render=lambda camera: render(run, camera).image,
        held_out=lambda share: held_out(share, seed),
        step=run.step,
        seed=seed,
        device=run.device,
        folder=run.folder / "regenerators",
        refuse_if_stopping=run.refuse_if_stopping,
    )
