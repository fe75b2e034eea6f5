"""Photographs made worse in a known way."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_scene import Grey, small_scene, spread

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError
from gsx.experiments.runs.degraded import degrade, gains_of, pair_of
from gsx.modules.motion_blur import motion_blurred


class GreyFile(Grey):
    """A grey photograph on the disk, with a mask."""

    path = Path("grey.png")

    def counted(self, camera: Camera) -> torch.Tensor:
        return torch.zeros(camera.height, camera.width, dtype=torch.bool)


def test_training_photographs_have_the_gains_of_their_names_and_test_photographs_none() -> None:
    scene = small_scene(spread(5))
    scene = replace(scene, test=[scene.train[0]])
    worse = degrade(scene, {"exposure": 0.2})
    for view in worse.train:
        expected = (128 * gains_of(view.name, 0.2)).round().clamp(0, 255).to(torch.uint8)
        assert torch.equal(view.source.image(view.camera)[:, 0, 0], expected)
    assert worse.test == scene.test
    assert worse.provenance["disturbed"] == {"exposure": 0.2}
    assert len({tuple(gains_of(str(number), 0.2).tolist()) for number in range(50)}) == 50
    assert degrade(scene, {"exposure": 0.0}) is degrade(scene, {}) is scene


def test_gains_are_spread_as_asked() -> None:
    logs = torch.stack([gains_of(str(number), 0.2) for number in range(2000)]).log()
    assert abs(float(logs.mean(1).std()) - 0.2) < 0.01
    assert abs(float((logs - logs.mean(1, keepdim=True)).std()) - 0.25 * 0.2 * (2 / 3) ** 0.5) < 0.005


def test_a_shaded_photograph_gets_brighter_towards_a_side_at_every_size_and_in_crops() -> None:
    scene = small_scene(spread(5))
    [worse] = degrade(replace(scene, train=scene.train[:1]), {"shade": 0.2}).train
    right, down = pair_of("shade", worse.name, 0.2)
    for camera in (worse.camera, worse.camera.zoom(4)):
        x, y = (2 * torch.arange(camera.width) + 1) / camera.width - 1, (2 * torch.arange(camera.height) + 1)
        light = (right * x + down * (y / camera.height - 1)[:, None]).exp()
        expected = (128 * light).round().clamp(0, 255).to(torch.uint8)
        assert torch.equal(worse.source.image(camera)[1], expected)
    part = worse.camera.zoom(4).crop(50, 30, 20, 10)
    assert torch.equal(worse.source.image(part)[1], expected[30:40, 50:70])
    drawn = torch.tensor([pair_of("shade", str(number), 0.2) for number in range(2000)])
    assert (drawn.std(0) - 0.2).abs().max() < 0.01


def test_what_photographs_have_in_common_of_their_light_is_taken_from_them() -> None:
    scene = small_scene(spread(5))
    worse = [view.source for view in degrade(scene, {"shade": 0.2}).train]
    drawn = torch.tensor([pair_of("shade", view.name, 0.2) for view in scene.train])
    found = torch.tensor([source.slopes for source in worse])
    assert found.mean(0).abs().max() < 1e-6
    torch.testing.assert_close(found[1:] - found[0], drawn[1:] - drawn[0])
    assert degrade(replace(scene, train=[]), {"exposure": 0.2}).train == []


def test_values_saturate_and_files_and_masks_stay_those_of_the_source() -> None:
    scene = small_scene(spread(5))
    one = View("bright", scene.train[0].camera, GreyFile())
    [worse] = degrade(replace(scene, train=[one]), {"exposure": 2}).train
    assert worse.file == Path("grey.png")
    assert not worse.counted().any()
    [plain] = degrade(replace(scene, train=scene.train[:1]), {"exposure": 2}).train
    assert plain.file is None
    assert plain.counted() is None
    assert plain.zoom(2) is None
    assert worse.source.image(worse.camera).dtype == torch.uint8


class Asked(Grey):
    """Remembers the camera that was asked for."""

    def image(self, camera: Camera) -> torch.Tensor:
        self.camera = camera
        return super().image(camera)


def test_a_wrong_pose_moves_the_picture_and_the_photograph_stays_where_it_was_taken() -> None:
    scene, source = small_scene(spread(5)), Asked()
    own = View("a", scene.train[0].camera, source)
    [worse] = degrade(replace(scene, train=[own]), {"pose": 3.0}).train
    far = torch.tensor([[0.0, 0.0, 1000.0]]).double() @ own.camera.rotation + own.camera.centre  # what its middle shows
    (before, _), (after, _) = own.camera.project(far), worse.camera.project(far)
    moved = torch.tensor(pair_of("pose", "a", 3.0), dtype=torch.float64)
    torch.testing.assert_close(after - before, moved[None], atol=0.02 * 3, rtol=0)
    torch.testing.assert_close(worse.camera.centre, own.camera.centre, atol=1e-6, rtol=0)
    assert worse.image().shape == (3, 16, 24)
    assert torch.equal(source.camera.rotation, own.camera.rotation)
    finer = worse.source.image(worse.camera.zoom(2))
    assert torch.equal(source.camera.translation, own.camera.translation)
    assert (source.camera.width, finer.shape) == (48, (3, 32, 48))


def test_what_stands_before_a_photograph_covers_its_share_at_every_size() -> None:
    scene = small_scene(spread(5))
    [one] = degrade(replace(scene, train=scene.train[:1]), {"covered": 0.25}).train
    for camera in (one.camera.zoom(8), one.camera.zoom(16)):
        covered = (one.source.image(camera) != 128).any(0)
        assert abs(float(covered.float().mean()) - 0.25) < 0.01
    whole, crop = one.camera.zoom(8), one.camera.zoom(8).crop(50, 30, 60, 40)
    assert torch.equal(one.source.image(crop), one.source.image(whole)[:, 30:70, 50:110])


class Stripes(Grey):
    """Columns, light and dark, an eighth of the frame each."""

    def image(self, camera: Camera) -> torch.Tensor:
        column = (torch.arange(camera.width) + camera.frame.left) * 8 // camera.frame.width
        return (200 * (column % 2)).expand(3, camera.height, -1).to(torch.uint8)


def test_a_camera_that_moves_blurs_its_photograph_at_every_size_and_in_crops() -> None:
    scene = small_scene(spread(5))
    own = View("blurred", scene.train[0].camera.zoom(8), Stripes())
    [worse] = degrade(replace(scene, train=[own]), {"blur": 3.0}).train
    across, down = pair_of("blur", "blurred", 3.0)
    expected = motion_blurred(own.source.image(own.camera).float(), across, down).round()
    assert torch.equal(worse.source.image(own.camera), expected.byte())
    finer = own.camera.zoom(2)
    twice = motion_blurred(own.source.image(finer).float(), 2 * across, 2 * down).round()
    assert torch.equal(worse.source.image(finer), twice.byte())
    part = own.camera.crop(50, 30, 60, 40)
    assert torch.equal(worse.source.image(part), expected.byte()[:, 30:70, 50:110])
    drawn = torch.tensor([pair_of("blur", str(number), 3.0) for number in range(2000)])
    assert (drawn.std(0) - 3).abs().max() < 0.15


def test_turns_are_spread_as_asked() -> None:
    drawn = torch.tensor([pair_of("pose", str(number), 3.0) for number in range(2000)])
    assert (drawn.std(0) - 3).abs().max() < 0.15
    assert drawn.mean(0).abs().max() < 0.2


def test_some_photographs_suffer_the_same_in_every_run() -> None:
    scene = small_scene(spread(5), views=10)
    by = {"exposure": 0.5, "some": 0.3}
    first, again = (degrade(scene, by).train for _ in range(2))
    suffering = [view.source is not own.source for view, own in zip(first, scene.train, strict=True)]
    assert sum(suffering) == 3
    assert suffering == [view.source is not own.source for view, own in zip(again, scene.train, strict=True)]
    assert degrade(scene, by).notes[-1] == "disturbed: 3 of 10 training photographs (scene.disturb: exposure 0.5)"
    assert degrade(scene, {"some": 0.5}) is scene


def test_what_cannot_be_disturbed_is_named() -> None:
    with pytest.raises(ConfigError, match=r"scene\.disturb\.rain"):
        degrade(small_scene(spread(5)), {"rain": 1.0})
    with pytest.raises(ConfigError, match=r"scene\.disturb\.covered is 1; give at most 0.9"):
        degrade(small_scene(spread(5)), {"covered": 1.0})
