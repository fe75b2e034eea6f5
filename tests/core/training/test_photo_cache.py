"""PhotoCache where a run computes: decoded once while there is room, gone when others are trained on."""

from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from tiny import final_tensors, tiny_run
from torch import Tensor

from gsx.core.backend import EAGER
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import View
from gsx.core.quality.losses import moments_of
from gsx.core.training import photo_cache as module
from gsx.core.training.photo_cache import PhotoCache

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
    photographs = PhotoCache(torch.device("cpu"), room=BYTES)
    photographs.set_views(views[:2])
    for _ in range(2):
        assert torch.equal(photographs.of(views[0]), torch.full((3, 4, 8), 51.0) / 255)
        assert torch.equal(photographs.of(views[1]), torch.full((3, 4, 8), 102.0) / 255)
    assert (first.asked, second.asked, photographs.room) == (1, 2, 0)
    photographs.set_views(views[2:])
    assert photographs.room == BYTES
    for _ in range(2):
        assert torch.equal(photographs.of(views[2]), torch.ones(3, 4, 8))
    assert coarse.asked == 1


def test_moments_are_computed_once_if_those_of_all_photos_have_room(monkeypatch: pytest.MonkeyPatch) -> None:
    views = [View(str(number), CAMERA, Counted(51 * number)) for number in range(3)]
    pictures = [view.image() for view in views]
    monkeypatch.setattr(module, "MOMENT_BYTES", 2 * 2 * 4 * BYTES)  # two float32 pictures of two photos
    photographs = PhotoCache(torch.device("cpu"), room=0)
    photographs.set_views(views)
    assert [photographs.moments_of(*each, EAGER) for each in zip(views, pictures, strict=True)] == [None] * 3
    assert not photographs.moments
    photographs.set_views(views[:2])
    for view, picture in zip(views[:2], pictures, strict=False):
        moments = photographs.moments_of(view, picture, EAGER)
        assert moments is not None
        assert photographs.moments_of(view, picture, EAGER) is moments
        assert all(map(torch.equal, moments, moments_of(picture)))
    photographs.set_views(views[2:])
    assert not photographs.moments
    assert photographs.moments_of(views[2], pictures[2], EAGER) is not None


def test_moments_of_photos_of_several_sizes_stay_within_their_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOMENT_BYTES", 10 * 2 * 4 * BYTES)
    views = [View(str(number), CAMERA, Counted(0)) for number in range(6)]
    photographs = PhotoCache(torch.device("cpu"), room=0)
    photographs.set_views(views)
    for width, view in enumerate(views, 1):
        photographs.moments_of(view, torch.zeros(3, 4, 4 * width), EAGER)
    held = sum(moment.nbytes for moments in photographs.moments.values() for moment in moments)
    assert len(photographs.moments) == 3  # up to 12 px wide: six such photos fill 9 of the 10
    assert held == 2 * 4 * 3 * 4 * (4 + 8 + 12) <= module.MOMENT_BYTES


@pytest.mark.parametrize(
    "words", [(), ("training.coarse_to_fine.factor=2", "training.poses.when=always", "training.poses.times=2")]
)
def test_training_is_the_same_whether_there_is_room_or_not(
    words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Also where views change on the way."""
    most = []

    def set_views(self: PhotoCache, views: Sequence[View]) -> None:
        most.append(len(self.moments))
        plain(self, views)

    plain = PhotoCache.set_views
    monkeypatch.setattr(PhotoCache, "set_views", set_views)
    run = tiny_run(tmp_path / "kept", ["iterations=12", *words], evaluated=False)
    assert max(most) >= 4  # of six
    assert not run.photos.moments
    monkeypatch.setattr(module, "MOMENT_BYTES", 0)
    most.clear()
    tiny_run(tmp_path / "found_anew", ["iterations=12", *words], evaluated=False)
    assert max(most) == 0
    kept, anew = (final_tensors(tmp_path / name) for name in ("kept", "found_anew"))
    assert kept.keys() == anew.keys()
    assert all(torch.equal(kept[name], anew[name]) for name in kept)
