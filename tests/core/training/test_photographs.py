"""Photographs where a run computes: decoded once while there is room, gone when others are trained on."""

import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
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
