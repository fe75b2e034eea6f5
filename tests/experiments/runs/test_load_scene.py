"""What a scene is told to be when a run loads it."""

from pathlib import Path

import pytest
from synthetic_colmap import synthesize, write_scene

from gsx.builtin import plugins
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene


@pytest.mark.parametrize(("published", "noted"), [(11, False), (12, True), (10, True)])
def test_another_number_of_images_than_was_published_is_noted(tmp_path: Path, published: int, noted: bool) -> None:
    write_scene(synthesize("SIMPLE_PINHOLE", [80.0, 32.0, 24.0], frames=11), tmp_path / "yard")
    named = ["+dataset.scenes.yard=Yard", f"+dataset.images.yard={published}", "dataset.scene=yard"]
    scene = load_scene(compose(["dataset=own", *named, f"data_root={tmp_path}"], plugins()))
    assert [note for note in scene.notes if "published" in note] == (
        [f"images/ holds 11 files, published are {published}: figures cannot be compared with published ones."]
        if noted
        else []
    )
