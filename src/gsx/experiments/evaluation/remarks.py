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
    warned = {check: shares(counts, requested) for check, counts in sums["warned"].items()}
    return {"asked": requested, "dropped": shares(sums["dropped"], requested), "warned": warned}


def shares(counts: Mapping[str, int], requested: Mapping[str, int]) -> dict[str, float]:
    """Returns counts by scale as shares of what was requested at that scale."""
    return {scale: counts.get(scale, 0) / count for scale, count in requested.items()}


def remarks_of(evaluation: Mapping[str, Any]) -> list[str]:
    """Returns remarks on an evaluation.json: incidents, and losses to an upscaler."""
    return [*incidents_of(evaluation), *upscaler_remarks(evaluation)]


def incidents_of(evaluation: Mapping[str, Any]) -> list[str]:
    """Returns remarks on an evaluation.json; none for a run without incident."""
    kinds = (split_remarks, start_remarks, cap_remarks, pseudo_remarks, left_out_remarks, saved_remarks)
    return [remark for kind in kinds for remark in kind(evaluation)]


def split_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield a remark if no view is held out."""
    if measures_nothing(evaluation):
        yield NOT_MEASURED


def measures_nothing(evaluation: Mapping[str, Any]) -> bool:
    """Return whether an evaluation is that of a run without test views."""
    return evaluation.get("views") == [] and evaluation.get("psnr") is None


def start_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield why the splat file that a run begins with may not belong to its scene."""
    doubts = evaluation.get("start")
    yield from (str(doubt) for doubt in (doubts if isinstance(doubts, list) else []))


def cap_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield a remark if growth was held at the cap."""
    cap = evaluation.get("withheld")
    if cap:
        yield f"growth is held at backbone.max_primitives from step {cap['step']:,} on: the model may be too small"


def pseudo_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield remarks on pictures of pseudo views that were dropped or that a check warned of."""
    for name, facts in (evaluation.get("pseudo") or {}).items():
        for scale, share in facts["dropped"].items():
            if share > 0:
                yield f"{name} lost {share:.1%} of its x{scale} pictures"
        for check, by_scale in facts.get("warned", {}).items():
            for scale, share in by_scale.items():
                if share > 0:
                    yield f"{share:.1%} of {name}'s x{scale} pictures {CHECKS.get(check, check)}"


def left_out_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield a remark if held-out renders lack splats."""
    count = evaluation.get("left_out") or 0
    if count:
        yield f"renders leave out {count:,.1f} splats a view, whose values cannot be drawn"


def upscaler_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield the zooms at which an upscaler of the x1 render comes closer to the truth than the zoomed render."""
    zooms = {factor: over_upscaled(entry) for factor, entry in part(dict(evaluation), "zoom").items()}
    lost = [f"x{factor} ({-gain:.2f} dB)" for factor, gain in zooms.items() if gain is not None and gain <= -LEAST_LOSS]
    if lost:
        name = upscaler_of(dict(evaluation))
        yield f"zoomed renders lose to the x1 render enlarged by {name} at {', '.join(lost)}: zoom by that instead"


def saved_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yields the saved remarks of the run's modules; for older evaluations, remarks computed now."""
    if "remarks" in evaluation:
        yield from map(str, evaluation["remarks"])
    else:
        for module, _ in MODULES.values():
            yield from module.remarks(evaluation)
