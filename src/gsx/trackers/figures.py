"""Metrics of a run by name, for trackers."""

from typing import Any


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

    Perceptual figures are `evaluation/METRIC`, `evaluation/x2/METRIC` and `evaluation/x2/enlarged_METRIC`.
    """
    figures = numbers(evaluation, "evaluation/") | numbers(evaluation.get("perceptual", {}), "evaluation/")
    for factor, result in evaluation.get("zoom", {}).items():
        figures |= numbers(result, f"evaluation/x{factor}/")
        for metric, pictures in result.get("perceptual", {}).items():
            names = {"" if kind == "render" else f"{kind}_": value for kind, value in pictures.items()}
            figures |= {f"evaluation/x{factor}/{name}{metric}": value for name, value in names.items()}
    return {name: value for name, value in figures.items() if name != "evaluation/step"}
