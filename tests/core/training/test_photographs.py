"""Photographs where a run computes: decoded once while there is room, gone when others are trained on."""

from pathlib import Path

import pytest
import torch
from tiny import final_tensors, tiny_run
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
from gsx.core.quality.losses import blurred_target
from gsx.core.training import photographs as module
from gsx.core.training.photographs import Photographs

CAMERA = look_at((0, 0, 0), (1, 0, 0), fov_x=1, width=8, height=4)
BYTES = 3 * 8 * 4


class Counted:
    """A source of one picture that counts how often it is asked."""

    def __init__(self, value: int) -> None:
        self.picture, self.asked = torch.full((3, 4, 8), value, dtype=torch.uint8), 0

    def image(self, camera: Camera) -> Tensor:
        self.asked += 1
        return self.picture

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def test_what_has_room_is_decoded_once_and_makes_room_for_others() -> None:
    first, second, coarse = sources = [Counted(51), Counted(102), Counted(255)]
    views = [View(str(number), CAMERA, source) for number, source in enumerate(sources)]
    photographs = Photographs(torch.device("cpu"), room=BYTES)
    photographs.see(views[:2])
    for _ in range(2):
        assert torch.equal(photographs.of(views[0]), torch.full((3, 4, 8), 51.0) / 255)
        assert torch.equal(photographs.of(views[1]), torch.full((3, 4, 8), 102.0) / 255)
    assert (first.asked, second.asked, photographs.room) == (1, 2, 0)
    photographs.see(views[2:])
    assert photographs.room == BYTES
    for _ in range(2):
        assert torch.equal(photographs.of(views[2]), torch.ones(3, 4, 8))
    assert coarse.asked == 1


def test_what_ssim_takes_of_a_photograph_is_found_once_while_there_is_room(monkeypatch: pytest.MonkeyPatch) -> None:
    sources = [Counted(51), Counted(102), Counted(153)]
    views = [View(str(number), CAMERA, source) for number, source in enumerate(sources)]
    monkeypatch.setattr(module, "BLURRED_BYTES", 2 * 2 * 4 * BYTES)
    photographs = Photographs(torch.device("cpu"), room=0)
    photographs.see(views)
    for _ in range(2):
        for view, value in zip(views[:2], (51, 102), strict=True):
            found = photographs.blurred_of(view, compiled=False)
            wanted = blurred_target(torch.full((3, 4, 8), value) / 255.0)
            assert found is not None
            assert all(map(torch.equal, found, wanted))
        assert photographs.blurred_of(views[2], compiled=False) is None
    assert [source.asked for source in sources] == [1, 1, 0]
    photographs.see(views[2:])
    assert not photographs.blurred
    assert photographs.blurred_of(views[2], compiled=False) is not None


def test_training_is_the_same_whether_there_is_room_or_not(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    run = tiny_run(tmp_path / "kept", ["iterations=12"])
    assert len(run.photographs.blurred) == len(run.scene.train)
    monkeypatch.setattr(module, "BLURRED_BYTES", 0)
    assert not tiny_run(tmp_path / "found_anew", ["iterations=12"]).photographs.blurred
    kept, anew = (final_tensors(tmp_path / name) for name in ("kept", "found_anew"))
    assert kept.keys() == anew.keys()
    assert all(torch.equal(kept[name], anew[name]) for name in kept)
