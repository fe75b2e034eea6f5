"""Rows of a comparison as text and CSV."""

import math
from collections.abc import Iterator, Sequence

from gsx.core.files import csv_text
from gsx.experiments.judge.summary import PLACE, Row
from gsx.experiments.reports.page import fixed, signed
from gsx.experiments.run_folder.shapes import is_number
from gsx.experiments.tables.table_text import aligned

DIGITS = {
    "psnr": 2,
    "worst_psnr": 2,
    "agreeing_detail": 2,
    "gain_over_enlarged": 2,
    "gain_over_upscaled": 2,
    "consistency": 2,
    "explained_detail": 3,
}
"""Decimals of figures; others have 4."""
HEADINGS = {
    "psnr": "PSNR, dB",
    "worst_psnr": "worst view, dB",
    "ssim": "SSIM",
    "lpips": "LPIPS",
    "st_lpips_alex": "ST-LPIPS",
    "niqe": "NIQE",
    "explained_detail": "detail",
    "consistency": "consistency, dB",
    "agreeing_detail": "agreeing detail",
    "gain_over_enlarged": "over enlarged, dB",
    "gain_over_upscaled": "over network, dB",
}
HIDDEN = ("views", "repetitions", "consistency_truth", "ssim_inria", "ssim_torchmetrics", "ssim_valid")
"""Columns that text and page leave out; CSV has them."""
SIGNED = ("gain_over_enlarged", "gain_over_upscaled")


def columns(rows: Sequence[Row]) -> list[str]:
    """Returns the figures that any of the rows has, in a fixed order."""
    found = dict.fromkeys(key for row in rows for key in row)
    first = [key for key in HEADINGS if key in found]
    rest = [key for key in found if key not in (*HEADINGS, *PLACE, *HIDDEN) and not key.startswith("difference_")]
    return [*first[:2], *rest, *first[2:]]


def number(row: Row, key: str) -> str:
    """Formats a figure; `equal` for an infinite PSNR, empty where it was not measured."""
    value = row.get(key)
    if value == math.inf:
        return "equal"
    if not is_number(value):
        return ""
    digits = DIGITS.get(key, 4)
    return signed(value, digits) if key in SIGNED else fixed(value, digits).replace("-", "\N{MINUS SIGN}")


def gap(row: Row) -> str:
    """Formats the difference from the baseline with its interval; empty for the baseline."""
    if not is_number(row.get("difference_mean")):
        return ""
    widths = [row.get(f"difference_over_{what}") for what in ("scenes", "repetitions", "views")]
    width = next((width for width in widths if is_number(width)), None)
    return signed(row["difference_mean"]) + (f" ± {fixed(width)}" if width is not None else "")


def as_text(rows: Sequence[Row], baseline: str) -> list[str]:
    """Formats rows as aligned lines, a block for each scene and protocol."""
    lines: list[str] = []
    for scene, protocol in dict.fromkeys((row["scene"], row["protocol"]) for row in rows):
        block = [row for row in rows if (row["scene"], row["protocol"]) == (scene, protocol)]
        title = f"{scene}, protocol {protocol}" if protocol else str(scene)
        lines += ["", title, *aligned([*grid(block, baseline)])]
    return lines


def grid(rows: Sequence[Row], baseline: str) -> Iterator[list[str]]:
    """Yields headings and cells."""
    keys = columns(rows)
    compared = any(is_number(row.get("difference_mean")) for row in rows)
    yield [
        "zoom",
        "method",
        *(HEADINGS.get(key, key) for key in keys),
        *([f"PSNR over {baseline}"] if compared else []),
    ]
    for row in rows:
        figures = [number(row, key) for key in keys]
        yield [f"x{row['zoom']}", row["method"], *figures, *([gap(row)] if compared else [])]


def as_csv(rows: Sequence[Row], leading: Sequence[str]) -> str:
    """Formats rows as CSV; `leading`: first columns."""
    fields = dict.fromkeys([*leading, *(key for row in rows for key in row)])
    return csv_text(list(fields), rows)
