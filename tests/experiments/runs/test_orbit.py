"""Orbits of captures whose shape is known, and animations read back by what browsers and OpenImageIO see in them."""

import math
import sys
from collections.abc import Iterator
from pathlib import Path

import OpenImageIO as oiio
import pytest
import torch
from torch import Tensor

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud, Scene, View
from gsx.core.errors import InputError
from gsx.experiments.runs.orbit import arc, fit_path, orbit_cameras, write_animation

WIDTH, HEIGHT = 64, 48
CENTRE = torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)


class Nothing:
    """A source that no test asks for pictures."""

    def image(self, camera: Camera) -> Tensor:
        raise NotImplementedError

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def shot(eye: list[float], target: list[float], up: tuple[float, float, float] = (0, 0, 1)) -> Camera:
    return look_at(eye, target, up=up, fov_x=0.9, width=WIDTH, height=HEIGHT)


def scene_of(cameras: list[Camera]) -> Scene:
    points = CENTRE.float() + 0.3 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    return Scene(
        name="capture",
        train=[View(f"{i}", camera, Nothing()) for i, camera in enumerate(cameras)],
        test=[],
        points=PointCloud(points, torch.zeros(200, 3, dtype=torch.uint8)),
        background=torch.zeros(3),
        extent=3.0,
    )


def ring(bearings: list[float], radius: float = 3.0, height: float = 1.5) -> list[Camera]:
    """Cameras at these bearings around CENTRE that look at it."""
    x, y, z = CENTRE.tolist()
    eyes = [[x + radius * math.cos(b), y + radius * math.sin(b), z + height] for b in bearings]
    return [shot(eye, [x, y, z]) for eye in eyes]


def evenly(count: int, first: float = 0.0, last: float = 2 * math.pi) -> list[float]:
    return [first + (last - first) * i / count for i in range(count)]


def centres(cameras: list[Camera]) -> Tensor:
    return torch.stack([camera.centre.double() for camera in cameras])


def aims(camera: Camera, point: Tensor) -> float:
    """Cosine between the viewing direction and the direction to a point."""
    to = point - camera.centre.double()
    return float(camera.rotation[2].double() @ to / to.norm())


def test_a_full_ring_gives_the_circle_it_was_taken_from() -> None:
    orbit = orbit_cameras(scene_of(ring(evenly(17))), 24)
    offsets = centres(orbit) - CENTRE
    assert torch.allclose(offsets[:, :2].norm(dim=1), torch.full((24,), 3.0).double(), atol=1e-4)
    assert torch.allclose(offsets[:, 2], torch.full((24,), 1.5).double(), atol=1e-4)
    assert min(aims(camera, CENTRE) for camera in orbit) > 1 - 1e-6
    assert min(-float(camera.rotation[1, 2]) for camera in orbit) > 0.85  # image-up points up


def test_frames_are_evenly_spaced_and_close_the_loop() -> None:
    path = centres(orbit_cameras(scene_of(ring(evenly(9))), 30))
    steps = (path - path.roll(1, 0)).norm(dim=1)
    assert torch.allclose(steps, steps[:1].expand(30), rtol=1e-3)


def test_intrinsics_are_those_of_the_first_camera() -> None:
    cameras = ring(evenly(9))
    for camera in orbit_cameras(scene_of(cameras), 2):
        assert camera.size == (WIDTH, HEIGHT)
        assert (camera.fx, camera.fy) == pytest.approx((cameras[0].fx, cameras[0].fy))
        assert camera.near == cameras[0].near


def test_a_half_ring_is_swung_over_and_not_left() -> None:
    """Tilted cameras on one side: their mean image-up leans away from the true up, their horizons do not."""
    orbit = orbit_cameras(scene_of(ring(evenly(11, 0.2, 2.4))), 40)
    offsets = centres(orbit) - CENTRE
    bearings = torch.atan2(offsets[:, 1], offsets[:, 0])
    assert 0.2 < float(bearings.min()) < 1.0
    assert 1.4 < float(bearings.max()) < 2.3
    assert torch.allclose(offsets[:, :2].norm(dim=1), torch.tensor(3.0).double(), rtol=0.02)
    assert float((offsets[:, 2] - 1.5).abs().max()) < 0.6
    assert min(aims(camera, CENTRE) for camera in orbit) > 0.999


def test_parallel_cameras_give_a_small_ellipse_in_front_of_the_points() -> None:
    cameras = [shot([x, -4.0, z], [x, 5.0, z]) for x in (0.0, 0.5, 1, 1.5, 2) for z in (0.0, 0.5, 1.0)]
    orbit = centres(orbit_cameras(scene_of(cameras), 36))
    assert 0.4 < float(orbit[:, 0].max() - orbit[:, 0].min()) < 2
    assert 0.3 < float(orbit[:, 2].max() - orbit[:, 2].min()) < 1.5
    assert float((orbit[:, 1] + 4).abs().max()) < 0.3
    assert torch.allclose(orbit.mean(0), torch.tensor([1, -4, 0.5]).double(), atol=0.1)


def test_cameras_that_look_outward_give_a_turn_that_looks_outward() -> None:
    x, y, z = CENTRE.tolist()
    spokes = [(math.cos(b), math.sin(b)) for b in evenly(12)]
    cameras = [shot([x + 0.4 * c, y + 0.4 * s, z], [x + 5 * c, y + 5 * s, z]) for c, s in spokes]
    orbit = orbit_cameras(scene_of(cameras), 12)
    assert torch.allclose((centres(orbit) - CENTRE).norm(dim=1), torch.tensor(0.4).double(), atol=1e-3)
    assert max(aims(camera, CENTRE) for camera in orbit) < -0.999


def test_a_panorama_from_one_spot_turns_there() -> None:
    x, y, z = CENTRE.tolist()
    cameras = [shot([x, y, z], [x + math.cos(b), y + math.sin(b), z]) for b in evenly(8)]
    orbit = orbit_cameras(scene_of(cameras), 8)
    assert torch.allclose(centres(orbit), CENTRE.expand(8, 3), atol=1e-5)
    turned = torch.stack([camera.rotation[2].double() for camera in orbit])
    assert float(turned.sum(0).norm()) < 1e-5


def test_views_straight_down_circle_above() -> None:
    x, y, z = CENTRE.tolist()
    ups = [(math.cos(b), math.sin(b), 0.0) for b in evenly(6)]
    cameras = [shot([x + 0.8 * c, y + 0.8 * s, z + 4], [x + 0.3 * c, y + 0.3 * s, z], (c, s, 0)) for c, s, _ in ups]
    orbit = orbit_cameras(scene_of(cameras), 12)
    assert torch.allclose(centres(orbit)[:, 2], torch.tensor(z + 4).double(), atol=0.05)


def test_one_camera_moves_a_little() -> None:
    orbit = centres(orbit_cameras(scene_of(ring([0.3])), 10))
    assert 0.05 < float((orbit - orbit.mean(0)).norm(dim=1).max()) < 0.5


def test_too_few_frames_are_refused() -> None:
    with pytest.raises(InputError, match=r"1 frames.*--frames"):
        orbit_cameras(scene_of(ring(evenly(5))), 1)


def test_fitting_takes_the_depth_of_the_points_where_rays_are_parallel() -> None:
    cameras = [shot([x, -4.0, 0.5], [x, 5.0, 0.5]) for x in (0.5, 1.0, 1.5)]
    path = fit_path(cameras, torch.tensor([[1.0, 3.0, 0.5], [1.0, -9.0, 0.5]]), 1.0)
    assert torch.allclose(path.target, torch.tensor([1, 3, 0.5]).double())


@pytest.mark.parametrize(
    ("degrees", "middle", "half"),
    [([10, 50, 30], 30, 20), ([350, 20], 5, 15), ([-170, 170], 180, 10), ([0, 120, 240], 0, 180), ([45], 45, 0)],
)
def test_the_shortest_arc_that_holds_all_bearings(degrees: list[float], middle: float, half: float) -> None:
    found, width = arc([math.radians(d) for d in degrees])
    assert math.cos(found - math.radians(middle)) == pytest.approx(1)
    assert width == pytest.approx(math.radians(half))


# -- animations ----------------------------------------------------------------------------------------------------


def frames(count: int = 4, width: int = 33, height: int = 20) -> Iterator[Tensor]:
    """Frames that get redder."""
    for i in range(count):
        yield torch.tensor([i / count, 0.5, 0.2])[:, None, None].expand(3, height, width)


def subimages(path: Path) -> list[tuple[tuple[int, int], list[int]]]:
    """Size and first pixel of every subimage."""
    reader, out = oiio.ImageInput.open(str(path)), []
    while reader.seek_subimage(len(out), 0):
        spec = reader.spec()
        out.append(((spec.width, spec.height), reader.read_image("uint8")[0, 0, :3].tolist()))
    reader.close()
    return out


def test_gif_frames_delay_and_loop(tmp_path: Path) -> None:
    path = tmp_path / "new" / "orbit.GIF"
    write_animation(path, frames(), 12.5)
    read = subimages(path)
    assert [size for size, _ in read] == [(33, 20)] * 4
    for i, (_, pixel) in enumerate(read):
        assert pixel == pytest.approx([255 * i / 4, 127.5, 51], abs=6)
    data = path.read_bytes()
    at = data.index(b"\x21\xf9\x04")  # graphic control extension: flags, then the delay in hundredths
    assert int.from_bytes(data[at + 4 : at + 6], "little") == 8
    assert b"NETSCAPE2.0\x03\x01\x00\x00" in data  # loops for ever
    assert list(path.parent.iterdir()) == [path]


def test_frames_are_taken_one_at_a_time(tmp_path: Path) -> None:
    """Each frame is written before the next is asked for: a reference to an earlier one would keep it alive."""
    alive: list[int] = []

    def counted() -> Iterator[Tensor]:
        import weakref

        made: list[weakref.ref[Tensor]] = []
        for frame in frames(6):
            fresh = frame.clone()
            made.append(weakref.ref(fresh))
            yield fresh
            del fresh
            alive.append(sum(ref() is not None for ref in made))

    write_animation(tmp_path / "a.gif", counted(), 10)
    assert max(alive) <= 1


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_video_without_pyav_names_the_extra(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'gsx\[video\]'.*\.gif"):
        write_animation(tmp_path / f"orbit{suffix}", frames(), 10)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_videos_hold_the_frames(tmp_path: Path, suffix: str) -> None:
    av = pytest.importorskip("av", reason="PyAV (gsx[video]) is not installed")
    path = tmp_path / f"orbit{suffix}"
    write_animation(path, frames(5), 20)
    data = path.read_bytes()
    if suffix == ".webp":  # FFmpeg does not decode animated WebP
        assert data[:4] == b"RIFF"
        assert data.count(b"ANMF") == 5
        return
    with av.open(str(path)) as video:
        pictures = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        assert video.streams.video[0].average_rate == 20
    assert [picture.shape for picture in pictures] == [(20, 32, 3)] * 5
    assert pictures[3][10, 16].tolist() == pytest.approx([153, 127, 51], abs=8)
    assert data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize(
    ("name", "fps", "message"),
    [
        ("a.avi", 10, r"a\.avi.*\.gif, \.webp, \.mp4"),
        ("a.gfi", 10, r"Did you mean '\.gif'"),
        ("a", 10, r"use \.gif"),
        ("a.gif", 0, "0 frames per second"),
        ("a.gif", 60, "60 frames per second.*50"),
        ("a.gif", 1e-300, "1e-300 frames per second: use 0.1 to 50"),
    ],
)
def test_unsuitable_requests_are_refused(tmp_path: Path, name: str, fps: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        write_animation(tmp_path / name, frames(), fps)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("suffix", [".mp4", ".webp"])
def test_frames_of_one_pixel_are_no_video(tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("av", reason="PyAV (gsx[video]) is not installed")
    with pytest.raises(InputError, match="frames of 1x3 px are too small for that"):
        write_animation(tmp_path / f"a{suffix}", iter([torch.zeros(3, 3, 1)] * 2), 10)
    assert not list(tmp_path.iterdir())


def test_frames_that_do_not_fit_leave_no_file(tmp_path: Path) -> None:
    cases = {
        "no frames": iter(()),
        "the first is 33 x 20": iter([*frames(1), *frames(1, width=34)]),
        "at most 8192 px": frames(1, width=8193, height=2),
    }
    for message, given in cases.items():
        with pytest.raises(InputError, match=message):
            write_animation(tmp_path / "a.gif", given, 10)
    assert not list(tmp_path.iterdir())
