"""Rows of a comparison as text and CSV, and its page: tables, differences, and crops next to the truth."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from gsx import __version__
from gsx.core.files import csv_text
from gsx.experiments.judge.summary import PLACE, Row
from gsx.experiments.reports.page import counted, fixed, signed, template
from gsx.experiments.run_folder.shapes import is_number
from gsx.experiments.tables.table_text import aligned

LEAST = 0.005
"""Smallest difference that is coloured, dB: smaller ones are 0.00."""


def page_of(content: Mapping[str, Any], rows: Sequence[Row], means: Sequence[Row]) -> str:
    """Renders the page of results; pictures lie in `pictures/`."""
    results = content["results"]
    blocks = [block_of(result, rows) for result in results]
    keys, scenes = columns(means), {block["scene"] for block in blocks}
    return template("judge/comparison.html").render(
        title=", ".join([counted(len(content["methods"]), "method"), counted(len(scenes), "scene")]),
        version=__version__,
        content=content,
        blocks=blocks,
        means=[cells(row, keys) for row in means],
        headings=[HEADINGS.get(key, key) for key in keys],
    )


def block_of(result: Mapping[str, Any], rows: Sequence[Row]) -> dict[str, Any]:
    """Returns what the page shows of a scene under one protocol."""
    place = result["named"], result["protocol_name"]
    own = [row for row in rows if (row["scene"], row["protocol"]) == place]
    keys = columns(own)
    return {
        "scene": result["named"],
        "protocol": result["protocol_name"],
        "hash": result["protocol"]["hash"],
        "facts": facts_of(result["protocol"]),
        "views": len(result["protocol"]["test_views"]),
        "headings": [HEADINGS.get(key, key) for key in keys],
        "rows": [cells(row, keys) for row in own],
        "compared": any(is_number(row.get("difference_mean")) for row in own),
        "crops": [{**row, "best": best_of(row["shots"])} for row in result["pictures"]],
        "notes": [(method["name"], note) for method in result["methods"] for note in method["notes"]],
        "settings": result["settings"],
    }


def cells(row: Row, keys: Sequence[str]) -> dict[str, Any]:
    """Returns a row as text."""
    difference = row["difference_mean"] if is_number(row.get("difference_mean")) else 0.0
    return {
        **{key: row[key] for key in PLACE},
        "figures": [number(row, key) for key in keys],
        "gap": gap(row),
        "better": difference >= LEAST,
        "worse": difference <= -LEAST,
    }


def best_of(shots: Sequence[Mapping[str, Any]]) -> float | None:
    """Returns the highest PSNR of several crops; None: there is none, or one alone."""
    known = [shot["psnr"] for shot in shots if is_number(shot["psnr"])]
    return max(known) if len(known) > 1 else None


def facts_of(protocol: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns the facts of a protocol in words."""
    names = {"size": "x1, px", "quantised_to_8_bit": "8 bits", "ssim": "SSIM", "lpips": "LPIPS", "rounding": "rounding"}
    facts = [(words, str(protocol[key])) for key, words in names.items() if key in protocol]
    scene = protocol.get("scene", {})
    return [*facts, *((str(key), str(value)) for key, value in scene.items() if not isinstance(value, dict | list))]


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
