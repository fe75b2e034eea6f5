"""What of a dataset is on this machine."""

from pathlib import Path
from typing import Any

import pytest

from gsx.builtin import plugins
from gsx.experiments.runs.compose import compose
from gsx.experiments.tables.datasets import described, missing

YARD: dict[str, Any] = {
    "name": "set", "title": "Set", "obtained": "https://example.org", "folder": "set", "needs": ["sparse/0", "images"],
    "scenes": {"yard": "Yard"}, "images": {"yard": 3},
}  # fmt: skip


def test_a_scene_is_there_with_as_many_images_as_were_published(tmp_path: Path) -> None:
    assert missing(YARD, "yard", tmp_path).endswith("set/yard is not there")
    folder = tmp_path / "set" / "yard"
    (folder / "sparse" / "0").mkdir(parents=True)
    assert missing(YARD, "yard", tmp_path).endswith("lacks images")
    (folder / "images").mkdir()
    for name in ("a.jpg", "b.jpg", ".DS_Store"):
        (folder / "images" / name).touch()
    told = missing(YARD, "yard", tmp_path)
    assert told.endswith("set/yard/images holds 2 of the 3 published images (++dataset.images.yard=2 takes them)")
    assert f"  damaged:  {told}" in list(described(YARD, tmp_path))
    assert missing(YARD | {"images": {"yard": 2}}, "yard", tmp_path) == ""
    assert missing(YARD | {"images": {}}, "yard", tmp_path) == ""
    (folder / "images" / "c.png").touch()
    assert missing(YARD, "yard", tmp_path) == ""


@pytest.mark.parametrize("name", ["mipnerf360", "tanks_and_temples", "deep_blending"])
def test_published_counts_are_of_the_scenes(name: str) -> None:
    settings = compose([f"dataset={name}", "dataset.images.garden=3" if name == "mipnerf360" else "seed=0"], plugins())
    assert settings.dataset is not None
    assert settings.dataset.images.keys() == settings.dataset.scenes.keys()
    assert min(settings.dataset.images.values()) >= (100 if name != "mipnerf360" else 3)
