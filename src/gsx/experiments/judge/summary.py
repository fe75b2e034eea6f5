"""Results of several scenes and protocols as rows: means over repetitions, and differences from one method."""

import math
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, TypeAlias

from gsx.core.errors import InputError, nearest
from gsx.experiments.judge.differences import difference, half_width
from gsx.experiments.judge.measure import by_view
from gsx.experiments.run_folder.files import part
from gsx.experiments.run_folder.shapes import is_number

Row: TypeAlias = dict[str, Any]
Results: TypeAlias = Sequence[Mapping[str, Any]]
FIGURES = ("psnr", "ssim", "ssim_inria", "ssim_torchmetrics", "ssim_valid", "lpips")
"""Means over views that a zoom has under these keys."""
GAINS = {"gain_over_enlarged": "enlarged_psnr", "gain_over_upscaled": "upscaled_psnr"}
"""Differences of `psnr` from rivals, dB."""
AGREEMENT = {"consistency": "render", "consistency_truth": "truth"}
"""Agreement of neighbouring views, dB: of a method's pictures, and of the photos."""
PLACE = ("scene", "protocol", "zoom", "method")
LOWER = ("lpips", "st_lpips_alex", "st_lpips_vgg", "lpips_alex", "lpips_vgg", "niqe")
"""Figures of which less is better."""


def named_methods(results: Results) -> list[str]:
    """Returns the names of methods, in the order of the command line."""
    return list(dict.fromkeys(method["name"] for result in results for method in result["methods"]))


def baseline_of(known: Sequence[str], name: str) -> str:
    """Returns the method that others are compared with: the first, or that of a name; InputError: there is none."""
    if name and name not in known:
        raise InputError(
            f"--against {name}: there is no such method, choose from {', '.join(known)}.{nearest(name, known)}"
        )
    return name or known[0]


def repetitions(result: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    """Returns the repetitions of a method on one scene."""
    return [method for method in result["methods"] if method["name"] == name]


def rows_of(results: Results, baseline: str) -> list[Row]:
    """Returns a row for each scene, protocol, zoom and method: figures, and the PSNR difference from the baseline."""
    return [
        row_of(result, zoom, name, baseline)
        for result in results
        for zoom in sorted({zoom for method in result["methods"] for zoom in method["zoom"]}, key=float)
        for name in named_methods([result])
        if any(zoom in method["zoom"] for method in repetitions(result, name))
    ]


def row_of(result: Mapping[str, Any], zoom: str, name: str, baseline: str) -> Row:
    """Returns the row of one method at one zoom."""
    entries = [method["zoom"][zoom] for method in repetitions(result, name) if zoom in method["zoom"]]
    found = [figures_of(entry) for entry in entries]
    levels = [finite(by_view(method["views"], zoom, "psnr")).values() for method in repetitions(result, name)]
    keys = [key for key in found[0] if all(key in figures for figures in found)]
    means = {key: statistics.fmean(figures[key] for figures in found) for key in keys}
    compared = difference_of(result, zoom, "psnr", name, baseline)
    gap = {f"difference_{key}": value for key, value in asdict(compared).items()} if compared else {}
    place = {"scene": result["named"], "protocol": result["protocol_name"], "zoom": zoom, "method": name}
    worst = {"worst_psnr": statistics.fmean(min(views) for views in levels if views)} if any(levels) else {}
    return {**place, "views": entries[0]["views"], "repetitions": len(found), **means, **worst, **gap}


def figures_of(entry: Mapping[str, Any]) -> dict[str, float]:
    """Returns the figures of one repetition at one zoom under the names of columns."""
    whole = {key: entry[key] for key in FIGURES if is_number(entry.get(key)) or entry.get(key) == math.inf}
    gains = {name: entry["psnr"] - entry[rival] for name, rival in GAINS.items() if is_number(entry.get(rival))}
    perceptual = {name: pictures["render"] for name, pictures in part(dict(entry), "perceptual").items()}
    detail = part(part(dict(entry), "detail"), "render").get("explained")
    levels = part(dict(entry), "consistency")
    agreement = {name: levels.get(kind) for name, kind in AGREEMENT.items()}
    agreement["agreeing_detail"] = part(levels, "detail").get("render")
    return {
        **whole,
        **gains,
        **perceptual,
        **({"explained_detail": detail} if is_number(detail) else {}),
        **{name: value for name, value in agreement.items() if is_number(value)},
    }


def difference_of(result: Mapping[str, Any], zoom: str, figure: str, name: str, baseline: str) -> Any:
    """Returns the paired difference of a method from the baseline on one scene; None: it is the baseline, or alone."""
    if name == baseline:
        return None
    one, other = (
        [finite(by_view(method["views"], zoom, figure)) for method in repetitions(result, method_name)]
        for method_name in (name, baseline)
    )
    one, other = ([views for views in runs if views] for runs in (one, other))
    return difference(one, other) if one and other else None


def finite(views: Mapping[str, float]) -> dict[str, float]:
    """Returns the finite figures: equal pictures have an infinite PSNR."""
    return {name: value for name, value in views.items() if math.isfinite(value)}


def over_scenes(rows: Sequence[Row], baseline: str) -> list[Row]:
    """Returns a row for each protocol, zoom and method that several scenes have: means of their rows.

    The interval of the difference is over scenes.
    """
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["protocol"], row["zoom"], row["method"]), []).append(row)
    scenes = {row["scene"] for row in rows}
    whole = {place: found for place, found in groups.items() if len(found) == len(scenes) > 1}
    return [mean_row(place, found, baseline) for place, found in whole.items()]


def mean_row(place: tuple[str, str, str], rows: Sequence[Row], baseline: str) -> Row:
    """Returns the mean over scenes."""
    kept = [key for key in rows[0] if all(is_number(row.get(key)) for row in rows) and not key.startswith("difference")]
    means = {key: statistics.fmean(row[key] for row in rows) for key in kept}
    gaps = [row["difference_mean"] for row in rows if is_number(row.get("difference_mean"))]
    gap = {"difference_mean": statistics.fmean(gaps), "difference_over_scenes": half_width(gaps)} if gaps else {}
    protocol, zoom, method = place
    return {"scene": f"mean of {len(rows)}", "protocol": protocol, "zoom": zoom, "method": method, **means, **gap}


def view_rows(results: Results) -> Iterator[Row]:
    """Yields a row for each view, zoom, method and repetition."""
    for result in results:
        for method in result["methods"]:
            for name, view in method["views"].items():
                for zoom, figures in view["zoom"].items():
                    yield {
                        "scene": result["named"],
                        "protocol": result["protocol_name"],
                        "zoom": zoom,
                        "method": method["name"],
                        "repetition": method["repetition"],
                        "view": name,
                        **figures,
                    }
