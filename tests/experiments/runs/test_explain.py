"""gsx explain: what is told is what the files say and what is composed."""

import re
from pathlib import Path

import pytest
import yaml

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.explain import entries, explain, parsed, value_at
from gsx.experiments.runs.typed import dotted

CONF = Path(__file__).parents[3] / "conf"


def test_a_value_with_its_range_and_every_file_that_sets_it() -> None:
    lines = explain("training.supersampling.factor", [], plugins())
    assert lines[:2] == ["training.supersampling.factor = 2", "  whole number from 1 to 16"]
    places = [re.fullmatch(r"  set in conf/(\S+):(\d+)  (\S+)", line) for line in lines]
    told = {found[1]: (int(found[2]), found[3]) for found in places if found}
    assert list(told) == ["preset/zoom.yaml", "module/supersampling.yaml"]
    for name, (number, value) in told.items():
        assert (CONF / name).read_text().splitlines()[number - 1].split("#")[0].strip() == f"factor: {value}"
    assert "      render at twice the density, reduced like the photos" in lines


def test_values_told_are_values_composed() -> None:
    overrides = [
        "backbone=octree_scaffold",
        "preset=octree_zoom",
        "augmenter=[upscale]",
        "scene=transforms",
        "scene.path=x",
    ]
    with Compositions(plugins()) as compositions:
        files, values = parsed(compositions.sources(overrides)), compositions.values(overrides)
    keys, missing = [key for key in dotted(values) if not isinstance(value_at(key, values), dict)], []
    for key in keys:
        value, found = value_at(key, values), entries(files, key)
        if not found:
            missing.append(key)
        elif "${" not in found[-1].value and value != "x":
            told = yaml.safe_load(found[-1].value)
            assert told == value or float(told) == value, key  # YAML takes 1e-4 for a text
    assert len(keys) > 150
    assert missing == []


def test_a_group_has_its_options_and_what_is_below() -> None:
    lines = explain("backbone=scaffold", [], plugins())
    assert lines[0] == "backbone"
    assert any(re.match(r"  mip_splatting +Mip-Splatting \(Yu et al\. 2024\): 3D-GS with a 3D", line) for line in lines)
    assert any(re.match(r"  growth\.success: 0\.8 +success_threshold$", line) for line in lines)


@pytest.mark.parametrize(
    ("key", "kind"),
    [
        ("seed", "whole number from 0 to"),
        ("eval.zoom", "list of numbers from 0.015625 to 64"),
        ("rasterizer.compensate", "true or false"),
        ("backbone.rates.quats", "number from 0 to 1"),
        ("scene.width", "whole number from"),
    ],
)
def test_kinds(key: str, kind: str) -> None:
    assert explain(key, [], plugins())[1].strip().startswith(kind)


def test_an_unknown_key_gets_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match=r"Unknown key 'trainin\.batch'\. Did you mean 'training\.batch'"):
        explain("trainin.batch", [], plugins())
    assert main(["explain", "training.batch", "training.batch=2"]) == 0
    assert capsys.readouterr().out.startswith("training.batch = 2\n")


def test_one_option_is_chosen_where_it_starts_from_another() -> None:
    """`auto` starts from `eager`, `gs3d_zoom` from `gs3d`."""
    for group, chosen in (("rasterizer", "auto"), ("backbone", "gs3d_zoom")):
        stars = [line.split()[1] for line in explain(group, [], plugins()) if line.startswith("* ")]
        assert stars == [chosen]


def test_a_key_of_another_choice_is_explained_by_it() -> None:
    with pytest.raises(ConfigError, match=r"'scene.matcher' is a setting of scene=photos: `gsx explain scene.matcher"):
        explain("scene.matcher", [], plugins())


@pytest.mark.parametrize("group", ["dataset", "tracker", "preset", "budget", "module", "regenerator/upscale", "eval"])
def test_groups_are_explained(group: str) -> None:
    """One of them has an option without content."""
    assert len(explain(group, [], plugins())) > 2
