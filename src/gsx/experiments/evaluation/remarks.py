"""Remarks for the reader of a run's figures: growth held at a cap, pictures lost, splats left out."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from gsx.core.plugins import hookimpl
from gsx.core.training.minibatch import sum_accounts
from gsx.core.training.run import Run, StepResult
from gsx.experiments.run_folder.files import over_upscaled, part, upscaler_of
from gsx.modules.catalogue import MODULES

logger = logging.getLogger(__name__)

NOT_MEASURED = "no view is held out (scene.split=none), so quality is not measured"
"""Sentence that replaces figures."""
LEAST_LOSS = 0.005
"""Least loss to an upscaler that is remarked on, dB: smaller ones are 0.00."""
CHECKS = {
    "colour": "changed their mean colour",
    "agreement": "disagree with their input",
    "displacement": "are displaced",
}
"""Words for the pictures that a check warns of."""


class CapNotice:
    """Listener that logs once that growth is held at a cap."""

    def __init__(self) -> None:
        self.logged = False

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """Learn from the metrics of a resumed run whether it was logged."""
        self.logged = any(line.get("withheld") for line in run.progress.curves)

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Log the first step that adds fewer primitives than density control requests."""
        count = step.changes.get("withheld", 0)
        if count and not self.logged:
            self.logged = True
            logger.warning(
                "step %d: %d primitives exceed backbone.max_primitives, which holds growth from here on: "
                "raise it, or set it to 0 for no cap",
                step.number,
                count,
            )


def gathered(lines: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns counts of primitives over the cap and of pseudo views' pictures, from lines of metrics.jsonl."""
    lines = list(lines)
    held = [line for line in lines if line.get("withheld")]
    cap = {"step": held[0]["step"], "primitives": sum(line["withheld"] for line in held)} if held else {}
    facts_by_name = [entry for line in lines for entry in line.get("pseudo", {}).items()]
    pseudo = {name: totals([facts for other, facts in facts_by_name if other == name]) for name, _ in facts_by_name}
    return ({"withheld": cap} if cap else {}) | ({"pseudo": pseudo} if pseudo else {})


def module_summaries(run: Run) -> dict[str, Any]:
    """Returns the figures of the run's modules, by their own keys."""
    figures: dict[str, Any] = {}
    for module in run.modules.values():
        figures |= module.summary(run.progress.curves)
    return figures


def module_remarks(run: Run, evaluation: Mapping[str, Any]) -> dict[str, list[str]]:
    """Returns the sentences of the run's modules about an evaluation, under the key `remarks`; empty: none has any."""
    remarks = [remark for module in run.modules.values() for remark in module.remarks(evaluation)]
    return {"remarks": remarks} if remarks else {}


def totals(events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Sums requested pictures, shares dropped and shares warned of, by scale, over the events of an augmenter."""
    sums = sum_accounts(events)
    requested = sums["asked"]

    def shares(counts: Mapping[str, int]) -> dict[str, float]:
        return {scale: counts.get(scale, 0) / count for scale, count in requested.items()}

    warned = {check: shares(counts) for check, counts in sums["warned"].items()}
    return {"asked": requested, "dropped": shares(sums["dropped"]), "warned": warned}


def remarks_of(evaluation: Mapping[str, Any]) -> list[str]:
    """Returns remarks on an evaluation.json: incidents, and losses to an upscaler."""
    return [*incidents_of(evaluation), *upscaler_remarks(evaluation)]


def incidents_of(evaluation: Mapping[str, Any]) -> list[str]:
    """Returns remarks on an evaluation.json; none for a run without incident.

    Remarks of the run's modules are saved with it; for older evaluations they are computed now.
    """
    cap, count = evaluation.get("withheld"), evaluation.get("left_out") or 0
    doubts = evaluation.get("start")
    remarks = [NOT_MEASURED] if measures_nothing(evaluation) else []
    remarks += map(str, doubts if isinstance(doubts, list) else [])
    if cap:
        words = f"from step {cap['step']:,} on: the model may be too small"
        remarks.append(f"growth is held at backbone.max_primitives {words}")
    for name, facts in (evaluation.get("pseudo") or {}).items():
        remarks += pseudo_remarks(name, facts)
    if count:
        remarks.append(f"renders leave out {count:,.1f} splats a view, whose values cannot be drawn")
    if "remarks" in evaluation:
        return [*remarks, *map(str, evaluation["remarks"])]
    return [*remarks, *(remark for module, _ in MODULES.values() for remark in module.remarks(evaluation))]


def pseudo_remarks(name: str, facts: Mapping[str, Any]) -> Iterator[str]:
    """Yield remarks on pictures of pseudo views that were dropped or that a check warned of."""
    for scale, share in facts["dropped"].items():
        if share > 0:
            yield f"{name} lost {share:.1%} of its x{scale} pictures"
    for check, by_scale in facts.get("warned", {}).items():
        for scale, share in by_scale.items():
            if share > 0:
                yield f"{share:.1%} of {name}'s x{scale} pictures {CHECKS.get(check, check)}"


def measures_nothing(evaluation: Mapping[str, Any]) -> bool:
    """Return whether an evaluation is that of a run without test views."""
    return evaluation.get("views") == [] and evaluation.get("psnr") is None


def upscaler_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield the zooms at which an upscaler of the x1 render comes closer to the truth than the zoomed render."""
    zooms = {factor: over_upscaled(entry) for factor, entry in part(dict(evaluation), "zoom").items()}
    lost = [f"x{factor} ({-gain:.2f} dB)" for factor, gain in zooms.items() if gain is not None and gain <= -LEAST_LOSS]
    if lost:
        name = upscaler_of(dict(evaluation))
        yield f"zoomed renders lose to the x1 render enlarged by {name} at {', '.join(lost)}: zoom by that instead"
