"""What a reader must know beside the figures of a run: growth held at a cap, pictures lost, splats left out."""

import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from gsx.core.plugins import hookimpl
from gsx.core.training.minibatch import sum_by_scale
from gsx.core.training.run import Run, StepResult

logger = logging.getLogger(__name__)

NOT_MEASURED = "no view is held out (scene.split=none), so quality is not measured"
"""Sentence in place of figures."""
CHECKS = {
    "colour": "changed their mean colour",
    "agreement": "disagree with their input",
    "displacement": "are displaced",
}
"""What pictures did that a check has warned of."""


class CapNotice:
    """Listener: says once that growth is held at a cap."""

    def __init__(self) -> None:
        self.said = False

    @hookimpl
    def gsx_run_started(self, run: Run) -> None:
        """A resumed run has said it."""
        self.said = any(line.get("withheld") for line in run.curves)

    @hookimpl
    def gsx_step_finished(self, run: Run, step: StepResult) -> None:
        """Say it at the first step that adds fewer primitives than density control asks for."""
        count = step.changes.get("withheld", 0)
        if count and not self.said:
            self.said = True
            logger.warning(
                "step %d: %d primitives find no room under backbone.max_primitives, which holds growth from here on: "
                "raise it, or set it to 0 for no cap",
                step.number,
                count,
            )


# -- from metrics to evaluation.json -----------------------------------------------------------------------------------


def gathered(lines: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """What lines of metrics.jsonl tell of a whole run: what a cap has `withheld`, pictures of `pseudo` views, and
    exposures, poses, distractors and blur of photographs.

    Only what there is.
    """
    lines = list(lines)
    held = [line for line in lines if line.get("withheld")]
    cap = {"step": held[0]["step"], "primitives": sum(line["withheld"] for line in held)} if held else {}
    told = [entry for line in lines for entry in line.get("pseudo", {}).items()]
    pseudo = {name: totals([facts for other, facts in told if other == name]) for name, _ in told}
    found = {"withheld": cap, "pseudo": pseudo, "exposures": judged_exposures(lines), "poses": judged_poses(lines)}
    found["distractors"], found["blur"] = judged_distractors(lines), judged_blur(lines)
    return {key: value for key, value in found.items() if value}


def judged_exposures(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """At which step exposures were judged, their spread, of how many photographs they were learnt, by how much they
    were off each time they were told again, and seconds of it all; where light within photographs was asked for, the
    spread of that, and of how many grids were."""
    told = [line for line in lines if "exposure_seconds" in line]
    if not told:
        return {}
    first = told[0]
    found = {"step": first["step"], "spread": first.get("exposure_spread"), "learnt": first["exposures"]}
    found["motions"] = [line["exposure_motion"] for line in told if "exposure_motion" in line]
    found["seconds"] = sum(line["exposure_seconds"] for line in told)
    return found | ({"within": first["light_spread"], "grids": first["grids"]} if "light_spread" in first else {})


def judged_poses(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """At which step poses were judged, px by which photographs lay beside, of how many poses were corrected, by how
    many px each time, and seconds of it all."""
    told = [line for line in lines if "pose_seconds" in line]
    if not told:
        return {}
    first = {"step": told[0]["step"], "spread": told[0].get("pose_spread"), "corrected": told[0]["poses"]}
    motions = [line["pose_motion"] for line in told if "pose_motion" in line]
    return first | {"motions": motions, "seconds": sum(line["pose_seconds"] for line in told)}


def judged_distractors(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """At which step distractors were judged, of which share of some photographs, which share of all pixels does not
    count, each time that was found, and seconds of it all. A stop before the step was taken loses what was told."""
    told = [line for line in lines if "distractor_seconds" in line]
    if not told:
        return {}
    marked = [line["distractors"] for line in told] if any(line["distractors"] for line in told) else []
    shares = [line["distractor_share"] for line in told if "distractor_share" in line]
    seconds = sum(line["distractor_seconds"] for line in told)
    return {"step": told[0]["step"], "share": (shares or [None])[0], "marked": marked, "seconds": seconds}


def judged_blur(lines: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """At which step movements of cameras were told first; at last of how many photographs of how many that were asked,
    px of the middle one; and seconds of it all."""
    told = [line for line in lines if "blur_seconds" in line]
    if not told:
        return {}
    counts = {"step": told[0]["step"], "blurred": told[-1]["blurred"], "asked": told[-1]["blur_suspects"]}
    seconds = sum(line["blur_seconds"] for line in told)
    return counts | {"length": told[-1].get("blur_length", 0.0), "seconds": seconds}


def totals(events: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Pictures asked for, and shares dropped and warned of, by scale, over the events of an augmenter."""
    asked = sum_by_scale(event["asked"] for event in events)
    checks = dict.fromkeys(check for event in events for check in event["warned"])
    return {
        "asked": asked,
        "dropped": shares(sum_by_scale(event["dropped"] for event in events), asked),
        "warned": {
            check: shares(sum_by_scale(event["warned"].get(check, {}) for event in events), asked) for check in checks
        },
    }


def shares(counts: Mapping[str, int], asked: Mapping[str, int]) -> dict[str, float]:
    """Counts by scale as shares of what was asked for at that scale; none left out."""
    return {scale: counts.get(scale, 0) / count for scale, count in asked.items()}


# -- in words ----------------------------------------------------------------------------------------------------------


def remarks_of(evaluation: Mapping[str, Any]) -> list[str]:
    """Sentences to stand beside the figures of an evaluation.json; none for a run without incident."""
    of_photographs = exposure_remarks, pose_remarks, distractor_remarks, blur_remarks
    kinds = (split_remarks, start_remarks, cap_remarks, pseudo_remarks, left_out_remarks, *of_photographs)
    return [remark for kind in kinds for remark in kind(evaluation)]


def split_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Yield that nothing is held out."""
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
    """Whether growth was held."""
    cap = evaluation.get("withheld")
    if cap:
        yield f"growth is held at backbone.max_primitives from step {cap['step']:,} on: the model may be too small"


def pseudo_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Pictures of pseudo views that were lost, or kept though they stray."""
    for name, facts in (evaluation.get("pseudo") or {}).items():
        for scale, share in facts["dropped"].items():
            if share > 0:
                yield f"{name} lost {share:.1%} of its x{scale} pictures"
        for check, by_scale in facts.get("warned", {}).items():
            for scale, share in by_scale.items():
                if share > 0:
                    yield f"{share:.1%} of {name}'s x{scale} pictures {CHECKS.get(check, check)}"


def exposure_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Exposures that were learnt: the model has none of theirs."""
    found = evaluation.get("exposures") or {}
    if found.get("learnt"):
        spread = "differ" if found["spread"] is None else f"are spread by {found['spread']:.1%}"
        yield (
            f"exposures of photographs {spread}, each has its own from step "
            f"{found['step']:,} on: the model has that of the mean photograph; eval.colours=fitted looks past that"
        )
    if found.get("grids"):
        yield (
            f"light within photographs is spread by {found['within']:.1%}, each has a bilateral grid from step "
            f"{found['step']:,} on"
        )


def pose_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Poses that were corrected: test views have those of the scene."""
    found = evaluation.get("poses") or {}
    if found.get("corrected"):
        beside = "beside the model" if found["spread"] is None else f"{found['spread']:.2f} px beside the model"
        yield (
            f"training photographs lay {beside}, their poses are corrected from step "
            f"{found['step']:,} on: those of test views are the scene's; eval.poses=aligned looks past that"
        )


def distractor_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Parts of training photographs that did not count."""
    found = evaluation.get("distractors") or {}
    if found.get("marked"):
        yield (
            f"{found['marked'][-1]:.1%} of the pixels of training photographs show what others do not, and do not "
            f"count from step {found['step']:,} on"
        )


def blur_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Photographs in which the camera moved."""
    found = evaluation.get("blur") or {}
    if found.get("blurred"):
        yield (
            f"the camera moved in {found['blurred']} training photographs, by {found['length']:.1f} px in the middle "
            f"of them: renders are blurred alike before they are compared, from step {found['step']:,} on"
        )


def left_out_remarks(evaluation: Mapping[str, Any]) -> Iterator[str]:
    """Splats that held-out renders lack."""
    count = evaluation.get("left_out") or 0
    if count:
        yield f"renders leave out {count:,.1f} splats a view, whose values cannot be drawn"
