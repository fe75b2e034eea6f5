"""Metrics, zoom table and pictures of a run by name, for trackers."""

from pathlib import Path
from typing import Annotated, Any, TypeAlias

from gsx.core.files import read_json
from gsx.core.ranges import Range

PictureCount: TypeAlias = Annotated[int, Range(0, 10**6)]
"""Number of test views whose render, truth and zoomed crops a tracker receives at an evaluation."""


def kept_state(file: Path) -> dict[str, Any]:
    """Reads what a tracker has noted in the run folder, such as its id of the run; empty: nothing yet."""
    return read_json(file) if file.is_file() else {}


def numbers(content: dict[str, Any], prefix: str = "") -> dict[str, float]:
    """Returns the numbers directly in a mapping, finite or not, with `prefix` before their key."""
    kept = {key: value for key, value in content.items() if isinstance(value, int | float)}
    return {f"{prefix}{key}": float(value) for key, value in kept.items() if not isinstance(value, bool)}


def line_figures(line: dict[str, Any]) -> dict[str, float]:
    """Returns the numbers of a line of metrics.jsonl without its step; parts of the loss are `terms/NAME`."""
    figures = numbers(line) | numbers(line.get("terms", {}), "terms/")
    return {name: value for name, value in figures.items() if name != "step"}


def evaluation_figures(evaluation: dict[str, Any]) -> dict[str, float]:
    """Returns the numbers of evaluation.json without its step: `evaluation/psnr`, by zoom `evaluation/x2/psnr`.

    Perceptual figures are `evaluation/METRIC`.
    """
    figures = numbers(evaluation, "evaluation/") | numbers(evaluation.get("perceptual", {}), "evaluation/")
    for factor, result in evaluation.get("zoom", {}).items():
        figures |= numbers(zoom_figures(result), f"evaluation/x{factor}/")
    return {name: value for name, value in figures.items() if name != "evaluation/step"}


def zoom_figures(result: dict[str, Any]) -> dict[str, float]:
    """Returns the numbers of a zoom: `psnr`, `enlarged_psnr`, explained `detail`, `METRIC`, `enlarged_METRIC`."""
    explained = {kind: shares.get("explained") for kind, shares in result.get("detail", {}).items()}
    figures = numbers(result)
    for metric, pictures in ({"detail": explained} | result.get("perceptual", {})).items():
        figures |= numbers({metric if kind == "render" else f"{kind}_{metric}": pictures[kind] for kind in pictures})
    return figures


def zoom_table(evaluation: dict[str, Any]) -> list[dict[str, str]]:
    """Returns the figures of each zoom as texts by name, the same names in each row.

    `gain` is the PSNR over that of the enlarged x1 render, dB.
    """
    rows = []
    for factor, result in evaluation.get("zoom", {}).items():
        figures = zoom_figures(result)
        if factor != "1" and "enlarged_psnr" in figures:
            figures = {"gain": figures["psnr"] - figures["enlarged_psnr"]} | figures
        rows.append({"zoom": f"x{factor}"} | {name: f"{value:.4g}" for name, value in figures.items()})
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name, "") for name in names} for row in rows]


def markdown(table: list[dict[str, str]]) -> str:
    """Formats a table as Markdown; empty without rows."""
    cells = [[*table[0]], ["---"] * len(table[0]), *(row.values() for row in table)] if table else []
    return "".join(f"| {' | '.join(row)} |\n" for row in cells)


def html(table: list[dict[str, str]]) -> str:
    """Formats a table as HTML; empty without rows."""
    cells = [[*table[0]], *(row.values() for row in table)] if table else []
    rows = "".join(f"<tr><td>{'</td><td>'.join(row)}</td></tr>" for row in cells)
    return f'<table border="1" cellpadding="4">{rows}</table>' if rows else ""


def pictures(renders: Path, count: int) -> dict[str, Path]:
    """Returns the pictures of the first `count` test views by name: `VIEW/render`, zoomed crops `VIEW/x2/render`."""
    index = read_json(renders / "index.json")
    views = {view["name"]: view["files"] for view in index["views"][:count]}
    names = {f"{name}/{kind}": files[kind] for name, files in views.items() for kind in ("render", "truth")}
    for crop in index["zoom"]:
        if crop["view"] in views:
            names |= {f"{crop['view']}/x{crop['factor']:g}/{kind}": file for kind, file in crop["files"].items()}
    return {name: renders / Path(file).name for name, file in names.items()}
