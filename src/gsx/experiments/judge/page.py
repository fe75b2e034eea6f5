"""The page of a comparison: tables, differences, crops next to the truth, and how to make it again."""

from collections.abc import Mapping, Sequence
from typing import Any

from gsx import __version__
from gsx.experiments.judge.counts import counted
from gsx.experiments.judge.summary import Row
from gsx.experiments.judge.tables import HEADINGS, columns, gap, number
from gsx.experiments.reports.page import template
from gsx.experiments.run_folder.shapes import is_number

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
        "crops": [crop_row(row) for row in result["pictures"]],
        "notes": [(method["name"], note) for method in result["methods"] for note in method["notes"]],
        "settings": result["settings"],
    }


def cells(row: Row, keys: Sequence[str]) -> dict[str, Any]:
    """Returns a row as text."""
    figures = [number(row, key) for key in keys]
    return {"scene": row["scene"], "protocol": row["protocol"], "zoom": row["zoom"], "method": row["method"]} | {
        "figures": figures,
        "gap": gap(row),
        "better": is_number(row.get("difference_mean")) and row["difference_mean"] >= LEAST,
        "worse": is_number(row.get("difference_mean")) and row["difference_mean"] <= -LEAST,
    }


def crop_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a row of crops with the best marked."""
    known = [shot["psnr"] for shot in row["shots"] if is_number(shot["psnr"])]
    best = max(known, default=None) if len(known) > 1 else None
    return {**row, "shots": [{**shot, "best": shot["psnr"] == best} for shot in row["shots"]]}


def facts_of(protocol: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Returns the facts of a protocol in words."""
    names = {"size": "x1, px", "quantised_to_8_bit": "8 bits", "ssim": "SSIM", "lpips": "LPIPS", "rounding": "rounding"}
    facts = [(words, str(protocol[key])) for key, words in names.items() if key in protocol]
    scene = protocol.get("scene", {})
    return [*facts, *((str(key), str(value)) for key, value in scene.items() if not isinstance(value, dict | list))]
