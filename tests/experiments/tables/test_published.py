"""The paper's figures: those that ship against the tables as transcribed elsewhere, and a variant for every row."""

import csv
from pathlib import Path

import pytest

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.experiments.runs.compose import Compositions, listed
from gsx.experiments.tables.published import METRICS, Published, read_table, tables

TRANSCRIBED = Path(__file__).parents[4] / "shared" / "specs" / "paper_tables"


@pytest.mark.skipif(not TRANSCRIBED.is_dir(), reason=f"needs the transcribed tables in {TRANSCRIBED}")
@pytest.mark.parametrize("name", tables())
def test_figures_are_those_transcribed(name: str) -> None:
    codes = {title: code for code, title in METRICS.items()}
    with (TRANSCRIBED / f"{name}.csv").open() as stream:
        lines = [line for line in csv.DictReader(stream) if line["value"]]
    printed = {(line["method"], line["scene"], codes[line["metric"]]): float(line["value"]) for line in lines}
    with (TRANSCRIBED / "errata.csv").open() as stream:
        for line in csv.DictReader(stream):
            if line["table"] == name and line["metric"] in codes:
                printed[line["method"], line["scene"], codes[line["metric"]]] = float(line["corrected"])
    assert read_table(name).figures == printed


def test_figures_known_by_heart() -> None:
    assert len(tables()) == 14
    assert read_table("04_frameworks_mipnerf360").figures["3D-GS-UB", "Mip-NeRF360", "PSNR"] == 28.59
    assert read_table("02_bungeenerf").figures["Octree-UPx2", "Scale-3", "PSNR"] == 26.83
    real = read_table("01_real_world")
    assert real.figures["Octree-UB", "Deep Blending", "kGS"] == 117  # printed as 112
    assert len(real.notes) == 2
    assert "printed as 116.9" in real.notes[1]
    with pytest.raises(ConfigError, match="Did you mean '01_real_world'"):
        read_table("01_real_word")


def experiments() -> dict[str, dict]:
    """Every experiment that ships."""
    with Compositions(plugins()) as compositions:
        names = listed("experiment")
        return {name: compositions.node([f"+experiment={name}"], "experiment") for name in names}


def covered(table: Published, node: dict) -> set[str]:
    """Methods of a table that an experiment runs or gives a reason for."""
    return {row for row in (*node["rows"], *node["quoted"]) if row in table.methods}


def test_every_row_of_every_table_has_a_variant_or_a_reason() -> None:
    of_tables = {node["published"]: node for node in experiments().values()}
    with Compositions(plugins()):
        variants = listed("variant")
    for name in tables():
        node = of_tables[name]
        assert covered(read_table(name), node) == set(read_table(name).methods), name
        assert set(node["rows"].values()) <= set(variants)
        assert all(len(reason) > 20 for reason in node["quoted"].values())
        assert node["baseline"] in node["rows"]
