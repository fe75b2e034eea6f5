"""Configurations of before: their keys are translated, and runs keep the names that they had at revision 2bc5957."""

from pathlib import Path

import pytest
import yaml

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.experiments.run_folder import renamed, run_key
from gsx.experiments.run_folder.renamed import MOVED, RENAMED, moved
from gsx.experiments.run_folder.run_key import by_older_keys, composition_key
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.saved_settings import read_config

CONFIGS = Path(__file__).parents[2] / "old_configs"
DIGESTS = {"plain": "f83de8aa37b6b3c3", "corrected": "496e7eeba0a8760c"}
"""Of `gsx`, and of octree_scaffold with augmenters, supersampling, exposure and plateau."""


def today(words: list[str]) -> list[str]:
    """Overrides with the keys that they have now."""
    pairs = [word.partition("=") for word in words]
    return [f"{RENAMED.get(key, key)}={value}" for key, _, value in pairs]


@pytest.mark.parametrize(
    ("words", "digest"),
    [
        ([], "f83de8aa37b6b3c3"),
        (["backbone=gs3d", "training.supersample=2"], "0077594583975c5e"),
        (
            [
                "backbone=mip_splatting",
                "training.supersample=2",
                "training.supersample_from=0.8",
                "training.coarse=4",
                "training.coarse_until=0.3",
                "training.exposure.when=auto",
                "training.trial.steps=0",
            ],
            "562b50519a100352",
        ),
    ],
)
def test_a_composition_keeps_its_name(words: list[str], digest: str) -> None:
    made = compose(today(words), plugins())
    assert composition_key(made.resolved, "", made.idle) == digest


@pytest.mark.parametrize("name", DIGESTS)
def test_a_saved_configuration_opens_and_keeps_its_name(name: str) -> None:
    settings = read_config(CONFIGS / f"{name}.yaml", plugins())
    assert composition_key(settings.resolved, "", settings.idle) == DIGESTS[name]
    assert settings.training.batch == 1


def test_a_value_moves_into_another_node_and_back() -> None:
    old = {"training": {"batch": 2, "coarse": 4, "supersample": 3, "supersample_from": 0.5}}
    new = moved(old, MOVED)
    assert new == {
        "training": {
            "batch": 2,
            "coarse_to_fine": {"factor": 4},
            "supersampling": {"factor": 3, "start": 0.5},
        }
    }
    assert by_older_keys(new) == old
    assert moved({"training": None}, MOVED) == {"training": None}


def test_a_removed_key_goes_where_its_value_is_what_gsx_trains_by(monkeypatch: pytest.MonkeyPatch) -> None:
    table = {"rasterizer.exact": "yes", "training.loud": None}
    for module in (renamed, run_key):
        monkeypatch.setattr(module, "REMOVED", table)
    kept, loud = {"rasterizer": {"chunk": 16}}, {"training": {"loud": 3}}
    assert renamed.renamed({"rasterizer": {"chunk": 16, "exact": "yes"}} | loud) == kept
    assert renamed.renamed({"rasterizer": {"exact": "no"}}) == {"rasterizer": {"exact": "no"}}
    assert by_older_keys(kept) == {"rasterizer": {"chunk": 16, "exact": "yes"}}
    assert "leave it out" in renamed.advice("training.loud")


def test_old_keys_that_are_typed_name_the_new_ones(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(RENAMED, "training.bunch", "training.batch")
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load((CONFIGS / "plain.yaml").read_text()) | {"trunk_gb": 10.0}))
    words = ["training.bunch=4"]
    for made in (lambda: compose(words, plugins()), lambda: read_config(path, plugins(), words)):
        with pytest.raises(ConfigError, match=r"'training\.bunch'.*\. It is now called 'training\.batch'"):
            made()
    with pytest.raises(ConfigError, match=r"'trunk_at'.*\. It is now called 'warm_start_at'"):
        compose(["trunk_at=[5]"], plugins())
