"""What real captures do, made on purpose, and what mends it: the tables of docs/benchmarks/photo-corrections.md.

    python benchmarks/captures.py --scenes FOLDER [--what exposure,light,appearance,poses,adjust,covered,...]
                                  [--only demo,fox] [--seeds 0,1] [--share 0.4] [--label NAME]

FOLDER holds `fox`, `desk_bottle` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photographs alone); without it only
the built-in scene is measured. `exposure`: training photographs at exposures of their own, with and without
`training.exposure.when=auto`, beside the scene as it is, with it. `light`: training photographs that are brighter
towards a side, each towards another, with and without `training.exposure.grid=auto`, likewise. `appearance`: both at
once, with exposures, grids, and codes of `training.appearance`, also fitted to test views. `poses`: training
cameras turned by half a pixel and by two, with and without `training.poses.when=auto`, likewise. `adjust`: models of
structure from motion whose cameras say something wrong, with and without `scene.adjust=auto`, likewise. `covered`:
something plain stands before a part of each training photograph, with and without `training.distractors.when=auto`,
likewise; `passed`: somebody does in the built-in scene. `faults`: a tenth of the photographs are made worse, and what
`gsx photographs` names is counted. `blur`: cameras move while they take photographs, with and without
`training.blur.when=auto`, beside the scene as it is. `sky`: what plain `gsx` trains, with and without
`backbone.sky=auto`. `phone`: a capture as it is (office), with corrections on `auto`, and
without. Finished runs below --runs are not trained again.
"""

import argparse
import math
import re
import statistics
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gsx.builtin import plugins
from gsx.core.files import read_json
from gsx.experiments.evaluation.view_coverage import LABELS
from gsx.experiments.runs.degraded import choose, pair_of
from gsx.experiments.runs.photo_check import check_photos
from measuring.wrong_models import wrong_model
from zoom import (
    SUBJECTS,
    USUAL,
    Measure,
    Measured,
    compared,
    over_seeds,
    render_probe,
    shared_arguments,
    steps_among,
    told,
    trained,
    write_tables,
)

ZOOMS = ("1", "4")
MAKING = threading.Lock()
"""Held while a model is made wrong, which is done once."""
OWN = ("backbone=mip_splatting", "backbone.rates.shortened=0.4")
FITTED = ("eval.colours=fitted",)
JUDGED, DISTURBED = ("training.exposure.when=auto",), ("scene.disturb.exposure=0.2",)
ARMS = {"as it is, auto": JUDGED, "disturbed": DISTURBED, "disturbed, auto": (*DISTURBED, *JUDGED)}
"""Overrides by the name of a row; the first is what there is to win back."""
LEAST_COST = 0.1
"""dB; of what costs less with any seed no share is told that is won back."""
MENDED = ", auto"
"""Ends the name of a row that mends the one of the same name without it."""
SHADED, EVENED = ("scene.disturb.shade=0.2",), (*JUDGED, "training.exposure.grid=auto")
LIGHT_ARMS = {"as it is, auto": EVENED, "shaded": SHADED, "shaded, auto": (*SHADED, *EVENED)}
"""The same of light within photographs."""
DIFFERENT, EXPOSED = (*DISTURBED, *SHADED), ("training.exposure.when=always",)
CODES = "training.appearance.when=always"
APPEARANCE_ARMS = {
    "unchanged": (),
    "degraded": DIFFERENT,
    "degraded, exposure": (*DIFFERENT, *EXPOSED),
    "degraded, exposure and grid": (*DIFFERENT, *EXPOSED, "training.exposure.grid=always"),
    "degraded, codes of 8": (*DIFFERENT, CODES, "training.appearance.size=8"),
    "degraded, codes of 14": (*DIFFERENT, CODES, "training.appearance.size=14"),
}
"""The same of both, with codes beside."""
CORRECTED = ("training.poses.when=auto",)
HALF, TWO = ("scene.disturb.pose=0.5",), ("scene.disturb.pose=2",)
POSE_ARMS = {
    "as it is, auto": CORRECTED,
    "0.5 px": HALF,
    "0.5 px, auto": (*HALF, *CORRECTED),
    "2 px": TWO,
    "2 px, auto": (*TWO, *CORRECTED),
}
"""The same of poses."""
ADJUSTED = ("scene.adjust=auto",)
WRONG: dict[str, dict[str, float]] = {
    "focal lengths 3 % too long": {"focal": 0.03},
    "corners 3 % too far out": {"bend": 0.03},
    "poses 0.5 px off": {"turn": 0.5},
    "poses 2 px off": {"turn": 2.0},
}
"""What cameras of a model say wrongly (`measuring.wrong_models`); turns are px of a training picture."""
COVERED = ("scene.disturb.covered=0.15",)
UNCOVERED = ("training.distractors.when=auto",)
COVERED_ARMS = {"as it is, auto": UNCOVERED, "covered": COVERED, "covered, auto": (*COVERED, *UNCOVERED)}
"""The same of what stands before the scene."""
SOMEBODY = ("scene.passer_by=true",)
PASSED_ARMS = {"as it is, auto": UNCOVERED, "passed by": SOMEBODY, "passed by, auto": (*SOMEBODY, *UNCOVERED)}
"""The same of who does, in the built-in scene."""
MOVED, STEADIED = ("scene.disturb.blur=3",), ("training.blur.when=auto",)
BLUR_ARMS = {
    "as it is, auto": STEADIED,
    "blurred": MOVED,
    "blurred, auto": (*MOVED, *STEADIED),
    "some blurred": (*MOVED, "scene.disturb.some=0.3"),
    "some blurred, auto": (*MOVED, "scene.disturb.some=0.3", *STEADIED),
}
"""The same of cameras that move: in all photographs, and in three tenths of them."""
DEFAULT = ("backbone=gs3d_zoom",)
SKY_ARMS = {"gs3d_zoom": DEFAULT, "gs3d_zoom, sky=auto": (*DEFAULT, "backbone.sky=auto")}
"""What plain `gsx` trains, and the same with something behind the scene."""
CORRECTIONS = (*JUDGED, *CORRECTED, *STEADIED, *UNCOVERED)
PHONE_ARMS = {
    "default": (),
    "corrections, auto": CORRECTIONS,
}
"""Overrides for a capture that nobody degraded."""
TESTS = {
    "exposures": ("spread", 100, "%"),
    "poses": ("spread", 1, "px"),
    "blur": ("length", 1, "px"),
    "distractors": ("share", 100, "%"),
}
"""Tests of corrections: key in evaluation.json, its figure and threshold, factor and unit."""
FEW = 0.1
"""Share of the photographs that are made worse."""
TURNED = 3.0
"""Px by which cameras are turned, standard deviation along each axis."""
FAULTS = {
    "none": ("", ""),
    "exposure": ("scene.disturb.exposure=0.7", "stops"),
    "pose": (f"scene.disturb.pose={TURNED:g}", "px beside the model's render"),
    "covered": ("scene.disturb.covered=0.05", "of its error lies in"),
}
"""What is done to them, and what a remark says that names it."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, USUAL, "outputs/captures")
    parser.add_argument("--what", default="exposure,poses,faults", help="tables, by commas")
    parser.add_argument("--share", type=float, default=1.0, help="of the steps")
    parser.add_argument("--label", default="", help="of tables over other scenes or steps: added to their names")
    return parser.parse_args(words)


def figures(
    scene: str, seed: int, name: str, wish: Sequence[str], asked: str, given: argparse.Namespace
) -> dict[str, Any]:
    """Of a run: as it was evaluated (`own`), seconds of training, and what it found of what photographs have wrong, by
    the name that evaluation.json has for that."""
    steps = round(given.share * steps_among(SUBJECTS[scene]))
    words = [*OWN, *wish, f"iterations={steps}", f"eval.zoom=[{','.join(ZOOMS)}]"]
    folder = trained(scene, seed, given, words, name)
    evaluation = read_json(folder / "evaluation.json")
    found = {"folder": folder, "own": evaluation["zoom"], "seconds": evaluation["train_seconds"]}
    return found | {asked: evaluation.get(asked, {})}


Found = Sequence[Mapping[str, Any]]
"""What was measured with each seed."""
Arms = Mapping[str, Sequence[str]]
"""Overrides by the name of a row: what there is to win back, disturbed, and mended."""


def rows_by_arm(
    arms: Arms,
    look: Callable[[str, int, str, argparse.Namespace], dict[str, Any]],
    row: Callable[[str, str, Mapping[str, Found]], dict[str, Any]],
    scenes: Sequence[str],
    given: argparse.Namespace,
) -> list[dict[str, Any]]:
    """A row of each arm of each scene, of what was found with all seeds."""
    found = over_seeds(lambda scene, seed: {arm: look(scene, seed, arm, given) for arm in arms}, scenes, given)
    by_scene = {scene: {arm: [one[arm] for one in found[scene]] for arm in arms} for scene in scenes}
    return [row(scene, arm, by_scene[scene]) for scene in scenes for arm in arms]


def row_of(
    scene: str, arm: str, by_arm: Mapping[str, Found], spread: str = "spread", learnt: str = "learnt"
) -> dict[str, Any]:
    """Figures of one arm over seeds; spread, learnt: keys of what was found, and of how many photographs learn it."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    spreads = [100 * one["exposures"][spread] for one in found if one["exposures"]]
    row["spread"] = told(spreads, ".1f") if spreads else ""
    row["learnt"] = f"{sum(one['exposures'].get(learnt, 0) > 0 for one in found)} of {len(found)}"
    asking = [100 * one["exposures"].get("seconds", 0.0) / one["seconds"] for one in found]
    row["asking"] = f"{statistics.mean(asking):.1f}" if spreads else ""
    return row | at_zooms(arm, by_arm, "fitted")


def psnr_of(found: Found, protocol: str, zoom: str) -> list[float]:
    """PSNR by a protocol with each seed."""
    return [one[protocol][zoom]["psnr"] for one in found]


def at_zooms(arm: str, by_arm: Mapping[str, Found], protocol: str) -> dict[str, str]:
    """PSNR of an arm at each zoom by a protocol and as it was evaluated; of one that mends another, what that wins back
    of what there is in the first, if there is anything to win with every seed."""
    found, best, wrong = by_arm[arm], next(iter(by_arm)), arm.removesuffix(MENDED)
    row = {f"x{zoom}": told(psnr_of(found, "own", zoom), ".2f") for zoom in ZOOMS}
    row |= {f"{protocol}{zoom}": told(psnr_of(found, protocol, zoom), ".2f") for zoom in ZOOMS if protocol != "own"}
    if wrong == arm or wrong not in by_arm:
        return row
    arms = [by_arm[name] for name in (best, wrong, arm)]
    known = [zoom for zoom in ZOOMS if min(costs(arms[0], arms[1], protocol, zoom)) > LEAST_COST]
    return row | {f"back{zoom}": told(shares_won(arms, protocol, zoom), ".2f") for zoom in known}


def cost_of(found: Found, kind: str, form: str) -> str:
    """Mean share of the training that went into what was asked of that kind, %; empty where nothing was."""
    cost = [100 * one[kind]["seconds"] / one["seconds"] for one in found if one[kind]]
    return f"{statistics.mean(cost):{form}}" if cost else ""


def costs(best: Found, worst: Found, protocol: str, zoom: str) -> list[float]:
    """What a disturbance costs with each seed, dB."""
    pairs = zip(psnr_of(best, protocol, zoom), psnr_of(worst, protocol, zoom), strict=True)
    return [without - with_it for without, with_it in pairs]


def shares_won(arms: Sequence[Found], protocol: str, zoom: str) -> list[float]:
    """Of what the disturbance cost, with each seed; `arms`: without it, with it, with it and what mends it."""
    best, worst, mended = (psnr_of(found, protocol, zoom) for found in arms)
    return [(m - w) / (b - w) for b, w, m in zip(best, worst, mended, strict=True)]


# -- which photographs are bad? ----------------------------------------------------------------------------------------


def named(scene: str, seed: int, fault: str, given: argparse.Namespace) -> dict[str, Any]:
    """How many photographs of a run were made worse, and how many of these and of the others are named."""
    steps, (word, _) = round(given.share * steps_among(SUBJECTS[scene])), FAULTS[fault]
    disturbances = [word, f"scene.disturb.some={FEW}"] if word else []
    folder = trained(scene, seed, given, [*OWN, *disturbances, f"iterations={steps}"], f"fault {fault}")
    check_photos(folder, plugins(), worst=10)
    found = read_json(folder / "photographs" / "index.json")["views"]
    bad = choose([view["name"] for view in found], FEW) if word else set()
    by_name = {view["name"]: view["remarks"] for view in found}
    return {
        "bad": len(bad),
        "good": len(found) - len(bad),
        "found": sum(any(FAULTS[fault][1] in remark for remark in by_name[name]) for name in bad),
        "wrongly": sum(bool(remarks) for name, remarks in by_name.items() if name not in bad),
        "shift": statistics.median(math.hypot(*(view["shift"] or (0, 0))) for view in found),
        "off": [error_of(view) for view in found if view["name"] in bad] if fault == "pose" else [],
    }


def error_of(view: Mapping[str, Any]) -> float:
    """How far the shift that was told is from the one that was made, px: a picture lies where its camera really was."""
    made = pair_of("pose", view["name"], TURNED)
    return math.hypot(*(told + own for told, own in zip(view["shift"] or (0, 0), made, strict=True)))


def fault_row(scene: str, fault: str, found: Found) -> dict[str, Any]:
    """Counts over seeds."""
    row: dict[str, Any] = {"scene": scene, "name": fault, "seeds": len(found)}
    if sum(one["bad"] for one in found):
        row["found"] = f"{sum(one['found'] for one in found)} of {sum(one['bad'] for one in found)}"
    row["others"] = f"{sum(one['wrongly'] for one in found)} of {sum(one['good'] for one in found)}"
    off = [error for one in found for error in one["off"]]
    row["off"] = f"{statistics.median(off):.1f}" if off else ""
    return row | {"shift": told([one["shift"] for one in found], ".2f")}


def faults(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Photographs that were made worse, found again."""
    found = over_seeds(lambda scene, seed: {f: named(scene, seed, f, given) for f in FAULTS}, scenes, given)
    rows = [fault_row(scene, fault, [one[fault] for one in found[scene]]) for scene in scenes for fault in FAULTS]
    columns = [["scene", "scene"], ["name", "made worse in"], ["seeds", "seeds"], ["found", "of these named for it"]]
    columns += [["others", "of the others named for anything"], ["shift", "median shift, px"]]
    columns += [["off", "shifts made are told to, px"]]
    note = (
        f"{given.share:g} of the steps; {FEW:.0%} of the training photographs made worse, and trained with all the "
        "same; counts over seeds. How much each is made worse is drawn, for some it is little."
    )
    return "Bad photographs, found", columns, rows, note


# -- exposure ----------------------------------------------------------------------------------------------------------


EXPOSURE_COLUMNS = [
    *(["scene", "scene"], ["name", "photographs"], ["seeds", "seeds"], ["spread", "spread found, %"]),
    *(["learnt", "learnt"], ["asking", "asking, % of training"], ["fitted1", "x1"], ["fitted4", "x4"]),
    *(["back1", "won back at x1"], ["back4", "at x4"], ["x1", "x1 as rendered"], ["x4", "x4 as rendered"]),
]
EXPOSURE_NOTE = (
    "PSNR on held-out views that are not disturbed, of right halves in colours fitted on the left (as rendered: of "
    "whole views as the model shows them); means over seeds ± half their range."
)


def in_colours(arms: Arms, kind: str) -> Callable[..., dict[str, Any]]:
    """Figures of a run of an arm by both protocols of colours, and what it found of exposures."""

    def look(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
        found = figures(scene, seed, f"{kind}{arm}", arms[arm], "exposures", given)
        return found | {"fitted": render_probe(found["folder"], "fitted", FITTED)}

    return look


def exposure(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Exposures of their own, and what mends them."""
    rows = rows_by_arm(ARMS, in_colours(ARMS, ""), row_of, scenes, given)
    note = f"{given.share:g} of the steps; {EXPOSURE_NOTE}"
    return "Photographs at exposures of their own", EXPOSURE_COLUMNS, rows, note


def light(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Light that differs within photographs, and what mends it."""

    def row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
        return row_of(scene, arm, by_arm, "within", "grids")

    rows = rows_by_arm(LIGHT_ARMS, in_colours(LIGHT_ARMS, "light "), row, scenes, given)
    note = (
        f"{given.share:g} of the steps; log gains grow by 0.2 (standard deviation) from the middle of each training "
        f"photograph to a side, across and down. {EXPOSURE_NOTE}"
    )
    return "Photographs that are brighter towards a side", EXPOSURE_COLUMNS, rows, note


# -- poses -------------------------------------------------------------------------------------------------------------


def posed(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """Figures of a run by both protocols of poses, and what it found of them."""
    found = figures(scene, seed, f"poses {arm}", POSE_ARMS[arm], "poses", given)
    return found | {"aligned": render_probe(found["folder"], "aligned", ["eval.poses=aligned"])}


def pose_row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    asked = [one["poses"] for one in found if one["poses"]]
    row["spread"] = told([one["spread"] for one in asked], ".2f") if asked else ""
    row["corrected"] = f"{sum(one['corrected'] > 0 for one in asked)} of {len(found)}" if asked else ""
    row["cost"] = cost_of(found, "poses", ".0f")
    return row | at_zooms(arm, by_arm, "aligned")


def poses(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Poses that are wrong, and what mends them."""
    rows = rows_by_arm(POSE_ARMS, posed, pose_row, scenes, given)
    columns = [["scene", "scene"], ["name", "training poses"], ["seeds", "seeds"], ["spread", "spread found, px"]]
    columns += [["corrected", "corrected"], ["cost", "% of training"], ["aligned1", "x1"], ["aligned4", "x4"]]
    columns += [["back1", "won back at x1"], ["back4", "at x4"], ["x1", "x1 as given"], ["x4", "x4 as given"]]
    note = (
        f"{given.share:g} of the steps; training cameras turned by so many px along each axis (standard deviation); "
        "PSNR on held-out views whose poses are right, of right halves from poses aligned by the left (as given: of "
        "whole views from the scene's poses); means over seeds ± half their range."
    )
    return "Poses that are wrong", columns, rows, note


# -- models of structure from motion -----------------------------------------------------------------------------------


def adjust_arms() -> list[str]:
    """Names of the rows: as it is, and what is wrong, without and with adjustment."""
    return ["as it is, auto", *(arm for wrong in WRONG for arm in (wrong, f"{wrong}, auto"))]


def of_model(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """Figures of a run from a model as it is or made wrong, by both protocols of poses, and what was done about it."""
    auto, wish = arm.endswith(MENDED), ["scene.max_reprojection_px=1000"]
    wrong = dict(WRONG.get(arm.removesuffix(MENDED), {}))
    if wrong:
        downscale = next(int(word.partition("=")[2]) for word in SUBJECTS[scene] if "downscale" in word)
        wrong |= {"turn": downscale * wrong["turn"]} if "turn" in wrong else {}
        target = given.runs / "_".join(["wrong", scene, *(f"{key}_{value:g}" for key, value in wrong.items())])
        with MAKING:
            wish.append(f"scene.path={wrong_model(given.scenes / scene, target, **wrong)}")
    found = figures(scene, seed, f"adjust {arm}", [*wish, *(ADJUSTED if auto else ())], "adjust", given)
    notes = read_json(found["folder"] / "environment.json")["scene"]["notes"]
    aligned = render_probe(found["folder"], "aligned", ["eval.poses=aligned"])
    return found | {"note": next((note for note in notes if "adjust" in note), ""), "aligned": aligned}


def adjust_row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    shifts = re.findall(r"([0-9.]+) px beside", found[0]["note"])
    row["before"], row["after"] = [*shifts, "", ""][:2]
    row["focal"] = "".join(re.findall(r"focal lengths times ([0-9.]+[0-9])", found[0]["note"]))
    return row | at_zooms(arm, by_arm, "aligned")


def adjust(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Models whose cameras say something wrong, and their adjustment."""
    rows = rows_by_arm(dict.fromkeys(adjust_arms(), ()), of_model, adjust_row, scenes, given)
    columns = [["scene", "scene"], ["name", "cameras of the model"], ["seeds", "seeds"]]
    columns += [["before", "pictures lie beside, px"], ["after", "adjusted, px"], ["focal", "focal lengths times"]]
    columns += [["aligned1", "x1"], ["aligned4", "x4"], ["back1", "won back at x1"], ["back4", "at x4"]]
    columns += [["x1", "x1 as given"], ["x4", "x4 as given"]]
    note = (
        f"{given.share:g} of the steps; cameras of training and test views say something wrong, what they observed is "
        "as it was; beside: px of the model's cameras; poses: px of training pictures (standard deviation along each "
        "axis). PSNR on held-out views, of right halves from poses aligned by the left (as given: of whole views from "
        "the poses of the model); means over seeds ± half their range."
    )
    return "Models whose cameras are wrong", columns, rows, note


# -- distractors -------------------------------------------------------------------------------------------------------


def seen_past(scene: str, seed: int, arm: str, arms: Arms, given: argparse.Namespace) -> dict[str, Any]:
    """Figures of a run by both protocols of colours, and what it found of distractors."""
    found = figures(scene, seed, f"distractors {arm}", arms[arm], "distractors", given)
    return found | {"fitted": render_probe(found["folder"], "fitted", FITTED)}


def past_row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    asked = [one["distractors"] for one in found if one["distractors"]]
    row["share"] = told([100 * one["share"] for one in asked], ".1f") if asked else ""
    row["marked"] = told([100 * (one["marked"] or [0])[-1] for one in asked], ".1f") if asked else ""
    row["cost"] = cost_of(found, "distractors", ".1f")
    return row | at_zooms(arm, by_arm, "fitted")


PAST_COLUMNS = [
    *(["scene", "scene"], ["name", "photographs"], ["seeds", "seeds"], ["share", "judged to show, %"]),
    *(["marked", "left out at last, %"], ["cost", "% of training"], ["fitted1", "x1"], ["fitted4", "x4"]),
    *(["back1", "won back at x1"], ["back4", "at x4"], ["x1", "x1 as rendered"], ["x4", "x4 as rendered"]),
]


def past(arms: Arms, scenes: Sequence[str], given: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of something in the way, and of what sees past it."""

    def look(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
        return seen_past(scene, seed, arm, arms, given)

    return rows_by_arm(arms, look, past_row, scenes, given)


PAST_NOTE = (
    "PSNR on held-out views that nothing covers, of right halves in colours fitted on the left (as rendered: of whole "
    "views as the model shows them); means over seeds ± half their range."
)


def covered(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Photographs with something in the way."""
    note = f"{given.share:g} of the steps; a plain patch covers 15 % of each training photograph, anywhere on it. "
    rows = past(COVERED_ARMS, scenes, given)
    return "Photographs with something in the way", PAST_COLUMNS, rows, note + PAST_NOTE


def passed(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Photographs with somebody in the way, in the built-in scene."""
    note = (
        f"{given.share:g} of the steps; somebody stands before each training camera, in another place, with a shadow. "
    )
    rows = past(PASSED_ARMS, [scene for scene in scenes if scene == "demo"], given)
    return "Photographs with somebody in the way", PAST_COLUMNS, rows, note + PAST_NOTE


# -- blur --------------------------------------------------------------------------------------------------------------


def steadied(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """Figures of a run, and what it found of how cameras moved."""
    return figures(scene, seed, f"blur {arm}", BLUR_ARMS[arm], "blur", given)


def blur_row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds."""
    found = by_arm[arm]
    row: dict[str, Any] = {"scene": scene, "name": arm, "seeds": len(found)}
    asked = [one["blur"] for one in found if one["blur"]]
    row["blurred"] = told([one["blurred"] for one in asked], ".1f", ".1f") if asked else ""
    row["cost"] = cost_of(found, "blur", ".1f")
    return row | at_zooms(arm, by_arm, "own")


def blur(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Photographs by cameras that moved, and what mends them."""
    rows = rows_by_arm(BLUR_ARMS, steadied, blur_row, scenes, given)
    columns = [["scene", "scene"], ["name", "photographs"], ["seeds", "seeds"], ["blurred", "found to be blurred"]]
    columns += [["cost", "% of training"], ["x1", "x1"], ["back1", "won back at x1"], ["x4", "x4"], ["back4", "at x4"]]
    note = (
        f"{given.share:g} of the steps; cameras move by so many px along each axis (standard deviation 3) while they "
        "take training photographs, all or three tenths of them; PSNR on held-out views, which are sharp; means over "
        f"seeds ± half their range; nothing is told to be won back where less than {LEAST_COST:g} dB is lost with any "
        "seed."
    )
    return "Photographs by cameras that moved", columns, rows, note


# -- sky ---------------------------------------------------------------------------------------------------------------


def sky(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """With something behind the scene, and without."""
    if given.share != 1:
        sys.exit(f"--share {given.share:g}: runs with a sky take all steps")
    return "Something behind the scene", *compared(SKY_ARMS, scenes, given)


# -- a walk with a phone -----------------------------------------------------------------------------------------------


def walked(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """Evaluation of a run in colours fitted and from poses aligned on left halves."""
    steps = round(given.share * steps_among(SUBJECTS[scene]))
    words = [*DEFAULT, *PHONE_ARMS[arm], *FITTED, "eval.poses=aligned", f"iterations={steps}", "eval.zoom=[1,4]"]
    return read_json(trained(scene, seed, given, words, f"phone {arm}") / "evaluation.json")


def phone_row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
    """Figures of one arm over seeds, those of views by coverage, and the decisions of the first seed."""
    found = by_arm[arm]
    row = {
        "scene": scene,
        "name": arm,
        "seeds": len(found),
        "seconds": told([one["train_seconds"] for one in found], ".0f"),
    }
    row |= {f"x{zoom}": told([one["zoom"][zoom]["psnr"] for one in found], ".2f") for zoom in ZOOMS}
    for name, group in found[0]["coverage"]["classes"].items():
        row |= {name: group["psnr"], f"{name}_views": group["views"]}
    row["trials"] = "; ".join(f"{key} {trial_text(one)}" for key, one in found[0].get("trials", {}).items())
    row["tests"] = "; ".join(test_text(key, found[0][key]) for key in TESTS if key in found[0])
    return row | {"notes": " ".join(found[0].get("scene_notes", []))}


def test_text(key: str, figures: Mapping[str, Any]) -> str:
    """The figure of a correction's test with its threshold."""
    name, factor, unit = TESTS[key]
    return f"{key} {factor * figures[name]:.2f} {unit} (threshold {factor * figures['thresholds'][name]:g} {unit})"


def trial_text(trial: Mapping[str, Any]) -> str:
    """A trial's gain with its standard error, and the outcome."""
    return f"{trial['gain']:+.2f} ± {trial['error']:.2f} dB: {'stays' if trial['stays'] else 'taken back'}"


def phone(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """A phone walk with corrections and without."""
    rows = rows_by_arm(PHONE_ARMS, walked, phone_row, scenes, given)
    columns = [["scene", "scene"], ["name", "settings"], ["seeds", "seeds"], ["x1", "x1"], ["x4", "x4"]]
    columns += [[key, f"{words}, x1"] for key, words in LABELS.items()] + [["tests", "tests"], ["trials", "trials"]]
    columns += [["seconds", "training s"]]
    note = (
        "PSNR of held-out views, dB: of right halves in colours fitted and from poses aligned by the left; means over "
        "seeds ± half their range. Coverage, tests and trials: of the first seed."
    )
    return "A phone walk", columns, rows, note


# -- appearance --------------------------------------------------------------------------------------------------------


def with_codes(scene: str, seed: int, arm: str, given: argparse.Namespace) -> dict[str, Any]:
    """PSNR of a run at x1: as rendered, in fitted colours, and of right halves with codes fitted to left ones."""
    steps = round(given.share * steps_among(SUBJECTS[scene]))
    words = [*OWN, *APPEARANCE_ARMS[arm], f"iterations={steps}", "eval.zoom=[1]", "eval.competitor=null"]
    folder = trained(scene, seed, given, words, f"appearance {arm}")
    evaluation = read_json(folder / "evaluation.json")
    codes = evaluation.get("fitted", {}).get("appearance", {})
    found = {"x1": evaluation["psnr"], "fitted1": render_probe(folder, "fitted", FITTED)["1"]["psnr"]}
    return found | ({"codes": codes["psnr"], "neutral": codes["psnr_rendered"]} if codes else {})


def appearance(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Photographs at exposures of their own that are brighter towards a side, and what mends that."""

    def row(scene: str, arm: str, by_arm: Mapping[str, Found]) -> dict[str, Any]:
        found = by_arm[arm]
        means = {key: told([one[key] for one in found], ".2f") for key in found[0]}
        return {"scene": scene, "name": arm, "seeds": len(found), **means}

    columns = [["scene", "scene"], ["name", "photographs"], ["seeds", "seeds"], ["fitted1", "x1"]]
    columns += [["x1", "x1 as rendered"], ["codes", "right halves, codes fitted on the left"]]
    columns += [["neutral", "the same as rendered"]]
    note = (
        f"{given.share:g} of the steps; gains of display values by 0.2 and slopes of log gains by 0.2 (standard "
        f"deviations) in each training photograph. {EXPOSURE_NOTE}"
    )
    title = "Photographs at exposures of their own that are brighter towards a side"
    return title, columns, rows_by_arm(APPEARANCE_ARMS, with_codes, row, scenes, given), note


WHAT: dict[str, Measure] = {
    "appearance": appearance,
    "exposure": exposure,
    "light": light,
    "poses": poses,
    "adjust": adjust,
    "covered": covered,
    "passed": passed,
    "faults": faults,
    "blur": blur,
    "sky": sky,
    "phone": phone,
}


def main(words: Sequence[str]) -> None:
    """Train and look, and write the tables."""
    given = arguments(words)
    write_tables(words, given, "captures", WHAT, given.label)


if __name__ == "__main__":
    main(sys.argv[1:])
