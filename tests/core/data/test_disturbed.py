"""Photographs made worse in a known way."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_scene import Grey, small_scene, spread

from gsx.core.data.camera import Camera
from gsx.core.data.disturbed import disturbed, gains_of
from gsx.core.data.scene import FromFile, Masked, View
from gsx.core.errors import ConfigError


class GreyFile(Grey):
    """A grey photograph on the disk, with a mask."""

    path = Path("grey.png")

    def counted(self, camera: Camera) -> torch.Tensor:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)


def test_training_photographs_have_the_gains_of_their_names_and_test_photographs_none() -> None:
    scene = small_scene(spread(5))
    scene = replace(scene, test=[scene.train[0]])
    worse = disturbed(scene, {"exposure": 0.2})
    for view in worse.train:
        expected = (128 * gains_of(view.name, 0.2)).round().clamp(0, 255).to(torch.uint8)
        assert torch.equal(view.source.image(view.camera)[:, 0, 0], expected)
    assert worse.test == scene.test
    assert worse.provenance["disturbed"] == {"exposure": 0.2}
    assert len({tuple(gains_of(str(number), 0.2).tolist()) for number in range(50)}) == 50
    assert disturbed(scene, {"exposure": 0.0}) is disturbed(scene, {}) is scene


def test_gains_are_spread_as_asked() -> None:
    logs = torch.stack([gains_of(str(number), 0.2) for number in range(2000)]).log()
    assert abs(float(logs.mean(1).std()) - 0.2) < 0.01
    assert abs(float((logs - logs.mean(1, keepdim=True)).std()) - 0.25 * 0.2 * (2 / 3) ** 0.5) < 0.005


def test_values_saturate_and_files_and_masks_stay_those_of_the_source() -> None:
    scene = small_scene(spread(5))
    one = View("bright", scene.train[0].camera, GreyFile())
    [worse] = disturbed(replace(scene, train=[one]), {"exposure": 2}).train
    assert isinstance(worse.source, FromFile)
    assert worse.source.path == Path("grey.png")
    assert isinstance(worse.source, Masked)
    assert not worse.counted().any()
    [plain] = disturbed(replace(scene, train=scene.train[:1]), {"exposure": 2}).train
    assert not isinstance(plain.source, FromFile)
    assert plain.counted() is None
    assert plain.zoom(2) is None
    assert worse.source.image(worse.camera).dtype == torch.uint8


def test_what_cannot_be_disturbed_is_named() -> None:
    with pytest.raises(ConfigError, match=r"scene\.disturb\.blur"):
        disturbed(small_scene(spread(5)), {"blur": 1.0})
