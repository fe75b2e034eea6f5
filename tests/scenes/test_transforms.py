"""transforms.json scenes against cameras, lenses and dots placed by hand."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from synthetic_colmap import shipped

from gsx.builtin import plugins
from gsx.core.data.images import write_image
from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError
from gsx.experiments.runs.inspect import readable
from gsx.formats.ply import write_ply
from gsx.scenes.blender import BlenderOptions
from gsx.scenes.blender import load as load_blender
from gsx.scenes.orientation import oriented, oriented_camera
from gsx.scenes.pose_files import plain_name
from gsx.scenes.transforms import TransformsOptions, load

WIDTH, HEIGHT = 120, 90
COMMON = {"fl_x": 110.0, "fl_y": 100.0, "cx": 63.0, "cy": 41.0, "w": 120.0, "h": 90.0}
BENT = {"k1": 0.12, "k2": -0.05, "p1": 0.004, "p2": -0.006}
# look along +y with z up: right is +x, up is +z, back is -y
POSES = [[[1, 0, 0, x], [0, 0, -1, -4], [0, 1, 0, 0.5 * x], [0, 0, 0, 1]] for x in (-1.0, 0.0, 1.0)]


def write(folder: Path, poses: list[Any] = POSES, image: torch.Tensor | None = None, **content: Any) -> None:
    (folder / "images").mkdir(exist_ok=True)
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]
    file = COMMON | {"frames": frames} | content
    (folder / "transforms.json").write_text(json.dumps({k: v for k, v in file.items() if v is not None}))
    for i in range(len(poses)):
        photo = folder / "images" / f"{i}.png"
        photo.unlink(missing_ok=True)
        write_image(photo, torch.zeros(3, HEIGHT, WIDTH) if image is None else image)
        photo.write_bytes(photo.read_bytes() + bytes([i]))  # after its end: pictures are alike, files are not


def frame_changes(**changes: Any) -> list[dict[str, Any]]:
    """The standard frames, the second one with changes."""
    frames = [{"file_path": f"images/{i}.png", "transform_matrix": pose} for i, pose in enumerate(POSES)]
    frames[1] |= changes
    return frames


def options(folder: Path, **changes: Any) -> TransformsOptions:
    """The shipped configuration with changes."""
    small = {"path": str(folder), "random_points": 50}
    merged = OmegaConf.merge(OmegaConf.structured(TransformsOptions), shipped("transforms"), small, changes)
    made = OmegaConf.to_object(merged)
    assert isinstance(made, TransformsOptions)
    return made


def blender_options(folder: Path, **changes: Any) -> BlenderOptions:
    small = {"path": str(folder), "random_points": 50}
    merged = OmegaConf.merge(OmegaConf.structured(BlenderOptions), shipped("blender"), small, changes)
    made = OmegaConf.to_object(merged)
    assert isinstance(made, BlenderOptions)
    return made


def views(scene: Scene) -> list[View]:
    return sorted([*scene.train, *scene.test], key=lambda view: view.name)


def dot(x: float, y: float) -> torch.Tensor:
    """A bell of sigma 1.5 px at (x, y), pixel centres at +0.5."""
    columns, rows = torch.arange(WIDTH) + 0.5 - x, torch.arange(HEIGHT) + 0.5 - y
    return torch.exp(-(columns[None] ** 2 + rows[:, None] ** 2) / 4.5).expand(3, HEIGHT, WIDTH)


def centroid(image: torch.Tensor) -> torch.Tensor:
    weight = image[0].double()
    columns, rows = torch.arange(image.shape[2]) + 0.5, torch.arange(image.shape[1]) + 0.5
    return torch.stack([(weight * columns).sum(), (weight * rows[:, None]).sum()]) / weight.sum()


def bend(x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float = 0.0) -> tuple[float, float]:
    """Brown's lens model on the plane at depth 1, as OpenCV documents it."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    return bent_x, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def test_points_project_where_the_hand_says(tmp_path: Path) -> None:
    write(tmp_path)
    camera = views(load(options(tmp_path)))[2].camera
    # the camera at (1, -4, 0.5) sees (2, 0, 0) 4 ahead, 1 to the right, 0.5 down
    pixel, depth = camera.project(torch.tensor([[2.0, 0.0, 0.0]]))
    torch.testing.assert_close(pixel, torch.tensor([[63 + 110 / 4, 41 + 100 * 0.5 / 4]]))
    assert depth.tolist() == [4]


@pytest.mark.parametrize("further", [{}, {"k3": 0.03}])
@pytest.mark.parametrize("point", [(0.9, 0.0, 0.8), (-1.2, 1.0, -0.6), (0.1, -1.0, 0.0)])
def test_a_dot_of_a_bent_lens_lands_where_the_pinhole_says(
    tmp_path: Path, point: tuple[float, float, float], further: dict[str, float]
) -> None:
    ahead, right, up = point[1] + 4, point[0], point[2]  # from the middle camera at (0, -4, 0)
    x, y = bend(right / ahead, -up / ahead, **BENT, **further)
    write(tmp_path, image=dot(63 + 110 * x, 41 + 100 * y), camera_model="OPENCV", **BENT, **further)
    scene = load(options(tmp_path))
    view = views(scene)[1]
    pixel, _ = view.camera.project(torch.tensor([point], dtype=torch.float64))
    assert (centroid(view.image()) - pixel[0]).abs().max() < 0.02
    assert any("undistorted" in note for note in scene.notes)


def bend_fisheye(x: float, y: float, ks: list[float]) -> tuple[float, float]:
    """OpenCV's fisheye as it documents it: the angle to the axis, theta, lies at theta (1 + sum of k_i theta^2i)."""
    theta = math.atan(math.hypot(x, y))
    radius = theta * (1 + sum(k * theta ** (2 * i) for i, k in enumerate(ks, 1)))
    return x * radius / math.hypot(x, y), y * radius / math.hypot(x, y)


def bend_aria(x: float, y: float, params: list[float]) -> tuple[float, float]:
    """Fisheye624 as Project Aria documents it: a fisheye of six terms, two tangential ones, four of a thin prism."""
    u, v = bend_fisheye(x, y, params[:6])
    p0, p1, s0, s1, s2, s3 = params[6:]
    r2 = u * u + v * v
    tangent = 2 * (u * p0 + v * p1)
    return u + u * tangent + r2 * p0 + s0 * r2 + s1 * r2**2, v + v * tangent + r2 * p1 + s2 * r2 + s3 * r2**2


ARIA = [0.05, -0.02, 0.01, -0.004, 0.002, -0.001, 0.003, -0.002, 0.001, -0.0005, 0.002, 0.0004]
WIDE = {"fl_x": 60.0, "fl_y": 58.0}
LENSES: list[tuple[dict[str, Any], Callable[[float, float], tuple[float, float]]]] = [
    ({"camera_model": "SIMPLE_RADIAL", "k1": -0.1, "k2": 0.0}, lambda x, y: bend(x, y, -0.1, 0, 0, 0)),
    ({"camera_model": "RADIAL", "k1": -0.1, "k2": 0.02}, lambda x, y: bend(x, y, -0.1, 0.02, 0, 0)),
    (
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": -0.02, "k3": 0.01, "k4": -0.004},
        lambda x, y: bend_fisheye(x, y, ARIA[:4]),
    ),
    ({"camera_model": "OPENCV_FISHEYE"}, lambda x, y: bend_fisheye(x, y, [])),
    ({"camera_model": "opencv_fisheye", "k1": 0.05}, lambda x, y: bend_fisheye(x, y, ARIA[:1])),
    ({"is_fisheye": True, "k1": 0.05, "k2": -0.02}, lambda x, y: bend_fisheye(x, y, ARIA[:2])),
    ({"camera_model": "RADIAL_FISHEYE", "k1": 0.05, "k2": -0.02}, lambda x, y: bend_fisheye(x, y, ARIA[:2])),
    ({"camera_model": "FISHEYE624", "distortion_params": ARIA}, lambda x, y: bend_aria(x, y, ARIA)),
]


@pytest.mark.parametrize(("lens", "bent"), LENSES, ids=[str(i) for i in range(len(LENSES))])
def test_a_dot_of_every_lens_that_nerfstudio_reads(
    tmp_path: Path, lens: dict[str, Any], bent: Callable[[float, float], tuple[float, float]]
) -> None:
    """The middle camera looks along +y from (0, -4, 0): a point far from its axis is where the pinhole says, within
    what stretching the bell moves its centroid; any other lens is farther off by far."""
    point = (1.9, 0.0, -1.2)
    x, y = bent(1.9 / 4, 1.2 / 4)
    write(tmp_path, image=dot(63 + 60 * x, 41 + 58 * y), **WIDE, **lens)
    scene = load(options(tmp_path))
    view = views(scene)[1]
    pixel, _ = view.camera.project(torch.tensor([point], dtype=torch.float64))
    assert (centroid(view.image()) - pixel[0]).abs().max() < 0.12
    assert math.hypot(60 * (x - 1.9 / 4), 58 * (y - 1.2 / 4)) > 0.9
    assert any("undistorted" in note for note in scene.notes)


def test_full_opencv_is_a_ratio_of_polynomials(tmp_path: Path) -> None:
    x, y = 1.9 / 4, 1.2 / 4
    r2 = x * x + y * y
    ratio = (1 + 0.1 * r2 - 0.05 * r2**2 + 0.02 * r2**3) / (1 + 0.03 * r2 + 0.01 * r2**2 - 0.01 * r2**3)
    keys = {"k1": 0.1, "k2": -0.05, "k3": 0.02, "k4": 0.03, "k5": 0.01, "k6": -0.01}
    write(tmp_path, image=dot(63 + 60 * x * ratio, 41 + 58 * y * ratio), camera_model="FULL_OPENCV", **WIDE, **keys)
    view = views(load(options(tmp_path)))[1]
    pixel, _ = view.camera.project(torch.tensor([(1.9, 0.0, -1.2)], dtype=torch.float64))
    assert (centroid(view.image()) - pixel[0]).abs().max() < 0.03


def test_each_frame_may_have_a_lens_of_its_own(tmp_path: Path) -> None:
    """As colmap2nerf and ns-process-data write several cameras: all of a camera stands in each frame."""
    write(tmp_path, **WIDE, frames=frame_changes(is_fisheye=True, k1=0.05, fl_x=58.0))
    first, second, third = views(load(options(tmp_path)))
    assert first.camera.size == third.camera.size == (WIDTH, HEIGHT)
    assert second.camera.size != (WIDTH, HEIGHT)


def test_pycolmap_agrees_on_the_bent_lens(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    lens = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=[110, 100, 63, 41, *BENT.values()])
    at = lens.img_from_cam(np.array([[0.3, -0.2, 1.0]]))[0]
    x, y = bend(0.3, -0.2, **BENT)
    np.testing.assert_allclose(at, [63 + 110 * x, 41 + 100 * y], atol=1e-9)


def test_reduced_photos_of_a_bent_lens(tmp_path: Path) -> None:
    x, y = bend(0.9 / 4, -0.2, **BENT)
    bell = dot((63 + 110 * x) / 2, (41 + 100 * y) / 2)[:, :45, :60]
    write(tmp_path, image=bell, **BENT)
    view = views(load(options(tmp_path)))[1]
    pixel, _ = view.camera.project(torch.tensor([[0.9, 0.0, 0.8]], dtype=torch.float64))
    assert view.camera.width < 62
    assert (centroid(view.image()) - pixel[0]).abs().max() < 0.02


def test_photos_of_another_size_are_refused(tmp_path: Path) -> None:
    write(tmp_path, image=torch.zeros(3, 120, 90))
    refused(r"0\.png' is 90 x 120 and the camera model says 120 x 90", load, options(tmp_path))


def test_one_frame_may_have_its_own_camera(tmp_path: Path) -> None:
    write(tmp_path, frames=frame_changes(fl_x=200.0, cy=50.0))
    first, second, _ = (view.camera for view in views(load(options(tmp_path))))
    assert (first.fx, first.fy, first.cx, first.cy) == (110, 100, 63, 41)
    assert (second.fx, second.fy, second.cx, second.cy) == (200, 100, 63, 50)


def test_angles_of_view_stand_in_for_focal_lengths(tmp_path: Path) -> None:
    angles = {"camera_angle_x": 2 * math.atan(0.5), "camera_angle_y": 2 * math.atan(0.25)}
    write(tmp_path, fl_x=None, fl_y=None, cx=None, cy=None, w=None, h=None, **angles)
    camera = views(load(options(tmp_path)))[0].camera
    assert (camera.fx, camera.fy) == (pytest.approx(120), pytest.approx(180))
    assert (camera.cx, camera.cy) == (60, 45)
    write(tmp_path, fl_x=None, fl_y=None, camera_angle_x=angles["camera_angle_x"])
    camera = views(load(options(tmp_path)))[0].camera
    assert (camera.fx, camera.fy) == (pytest.approx(120), pytest.approx(120))


def test_degrees_of_instant_ngp_and_a_frames_own_angle(tmp_path: Path) -> None:
    """The width is 120: a quarter turn has a focal length of 60, and tan(x / 2) = 1 / 2 one of 120."""
    own = frame_changes(camera_angle_x=2 * math.atan(0.5))
    write(tmp_path, fl_x=None, fl_y=None, x_fov=90, frames=own)
    cameras = [view.camera for view in views(load(options(tmp_path)))]
    assert [camera.fx for camera in cameras] == [pytest.approx(60), pytest.approx(120), pytest.approx(60)]
    write(tmp_path, fl_y=None, camera_angle_x=1.0, frames=own)  # fl_x of the file is in all but that frame
    assert [view.camera.fx for view in views(load(options(tmp_path)))] == [110, pytest.approx(120), 110]


def test_simple_pinhole_has_one_focal_length(tmp_path: Path) -> None:
    write(tmp_path, camera_model="SIMPLE_PINHOLE")
    camera = views(load(options(tmp_path)))[0].camera
    assert (camera.fx, camera.fy) == (110, 110)


def test_centred_principal_point(tmp_path: Path) -> None:
    write(tmp_path)
    camera = views(load(options(tmp_path, principal_point="centred")))[0].camera
    assert (camera.cx, camera.cy) == (60, 45)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"camera_model": "PINHOL"}, r"camera_model PINHOL,.*Did you mean 'PINHOLE'\?"),
        ({"camera_model": 5}, "camera_model 5: give a name"),
        ({"camera_model": "OPENCV", "is_fisheye": True}, "is OPENCV and has is_fisheye: remove the wrong one"),
        (
            {"camera_model": "OPENCV_FISHEYE", "p1": 0.1},
            "is OPENCV_FISHEYE and has distortion p1, of which that has k1",
        ),
        ({"camera_model": "SIMPLE_RADIAL", "k2": 0.1}, "is SIMPLE_RADIAL and has distortion k2"),
        ({"is_fisheye": True, "fl_x": None, "camera_angle_x": 1.0}, "camera_angle_x does not give: add it in pixels"),
        ({"camera_model": "FISHEYE624", "distortion_params": [0.1]}, r"distortion_params \[0\.1\]: give a list of 12"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR, which sees too wide for a pinhole: cut the photos"),
        ({"equirectangular": True}, "EQUIRECTANGULAR, which sees too wide"),
        ({"latlong": True}, "LATLONG, which sees too wide"),
        ({"ftheta_p0": 0.0}, "FTHETA, which is not read .*undistort the photos, or load .*scene=colmap"),
        ({"camera_model": "ORTHOPHOTO"}, "ORTHOPHOTO, which has no perspective"),
        ({"camera_model": "THIN_PRISM_FISHEYE"}, "THIN_PRISM_FISHEYE, which is not read .*scene=colmap"),
        ({"x_fov": 180}, "x_fov 3.14159, no angle between 0 and pi"),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "is PINHOLE and has distortion"),
        ({"k1": 0.1, "k4": 0.2}, "has distortion k4"),
        ({"fl_x": None}, "neither fl_x nor camera_angle_x"),
        ({"fl_x": -5.0}, "focal lengths -5, 100"),
        ({"fl_x": math.nan}, "fl_x nan"),
        ({"cx": "middle"}, "cx 'middle'"),
        ({"w": 0}, "size 0 x 90"),
        ({"w": 1e20}, r"size 1e\+20 x 90"),
        ({"w": 10**400}, r"w 10+\.\.\.0+, which is no finite number"),
        ({"fl_x": None, "camera_angle_x": 5e-324}, "no angle between 0 and pi"),
        ({"k1": math.nan}, "k1 nan"),
        ({"k4": 10**400}, "k4 10+"),
        ({"frames": frame_changes(transform_matrix=None)}, "pose that is no matrix"),
        ({"frames": frame_changes(transform_matrix=[*POSES[0][:3], [0, 0, 4, 1]])}, "fourth row .*transposed"),
        ({"frames": frame_changes(transform_matrix=[[math.inf] * 4] * 4)}, "finite numbers"),
        ({"frames": frame_changes(transform_matrix=[[10**400] * 4] * 4)}, "pose that is no matrix"),
    ],
)
def test_cameras_that_cannot_be_used_are_refused_by_name(tmp_path: Path, content: dict[str, Any], message: str) -> None:
    write(tmp_path, **content)
    refused(rf"Frame 'images/\d\.png' of .*transforms\.json' .*{message}", load, options(tmp_path))


@pytest.mark.parametrize("value", [1e12, 1e300, -1e300])
@pytest.mark.parametrize("key", ["k1", "k2", "p1", "p2", "k3"])
def test_a_distortion_beyond_recognition_is_refused(tmp_path: Path, key: str, value: float) -> None:
    write(tmp_path, **{key: value})
    refused(r"images/0\.png' cannot be undistorted.* of a 120x90 photo .*: correct its", load, options(tmp_path))


@pytest.mark.parametrize("name", ["images/0.png", "./images/0.png", "images\\0.png"])
def test_a_photo_that_is_listed_twice_is_refused(tmp_path: Path, name: str) -> None:
    """One of them could be trained on and the other tested on."""
    write(tmp_path, frames=frame_changes(file_path=name))
    refused(r"has 'images/0\.png' twice", load, options(tmp_path))


@pytest.mark.parametrize("way", ["symbolic link", "hard link", "detour", "no suffix"])
def test_a_photo_under_two_names_is_refused(tmp_path: Path, way: str) -> None:
    write(tmp_path)
    one, other = tmp_path / "images" / "0.png", tmp_path / "images" / "1.png"
    if way == "symbolic link":
        other.unlink()
        other.symlink_to(one)
    elif way == "hard link":
        other.unlink()
        other.hardlink_to(one)
    name = {"detour": "images/../images/0.png", "no suffix": "images/0"}.get(way, "images/1.png")
    content = json.loads((tmp_path / "transforms.json").read_text()) | {"frames": frame_changes(file_path=name)}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    if way.endswith("link"):  # of which those that are all trained on may be
        said = r"images/1\.png' is '[^']*images/0\.png' byte for byte"
    else:
        said = rf"transforms\.json' has 'images/0\.png' and '{name}', which are one file"
    refused(said, load, options(tmp_path))


def test_a_copy_of_a_training_photo_cannot_be_tested_on(tmp_path: Path) -> None:
    names = ("0", "1", "2")
    write(tmp_path, train_filenames=[f"images/{i}.png" for i in names[1:]], test_filenames=["images/0.png"])
    photos = [tmp_path / "images" / f"{i}.png" for i in names]
    photos[2].write_bytes(photos[1].read_bytes())
    assert len(load(options(tmp_path)).train) == 2  # trained on twice, which gives no test away
    photos[2].write_bytes(photos[0].read_bytes())
    refused(r"1 test photographs .*'[^']*images/2\.png' is '[^']*images/0\.png' byte for", load, options(tmp_path))


def test_a_name_without_suffix_is_that_of_the_photo_that_is_there(tmp_path: Path) -> None:
    """instant-ngp tries suffixes, NeRF-synthetic means .png: that comes first."""
    write(tmp_path)
    (tmp_path / "images" / "1.png").rename(tmp_path / "images" / "1.JPG")
    (tmp_path / "images" / "2.png").rename(tmp_path / "images" / "2.5.webp")
    (tmp_path / "images" / "0.jpg").write_bytes(b"another")
    frames = frame_changes(file_path=".\\images\\1")
    frames[0]["file_path"], frames[2]["file_path"] = "./images/../images/0", str(tmp_path / "images" / "2.5")
    (tmp_path / "transforms.json").write_text(json.dumps(COMMON | {"frames": frames}))
    shown = {view.name: view.source.path.name for view in views(load(options(tmp_path)))}
    assert shown == {"images/../images/0": "0.png", "images/1": "1.JPG", str(tmp_path / "images" / "2.5"): "2.5.webp"}


@pytest.mark.parametrize(
    ("named", "there"),
    [
        ("images/1.jpg", "images/1.png"),
        ("Images/../images/1.PNG", "images/1.png"),
        ("images/1.PNG", "images/1.png"),
        ("/home/somebody/data/fox/images/1.png", "images/1.png"),
        ("C:\\Users\\somebody\\fox\\images\\1.png", "images/1.png"),
        ("../fox/images/1.png", "images/1.png"),
        ("images/seven.png", ""),
        ("elsewhere/images/0.png", ""),  # that one is another frame's
    ],
)
def test_a_photo_under_another_name_is_named(tmp_path: Path, named: str, there: str) -> None:
    write(tmp_path, frames=frame_changes(file_path=named))
    remedy = f"'{there}' is there, correct '{plain_name(named)}' in the file" if there else "complete them"
    with pytest.raises(InputError) as caught:
        load(options(tmp_path))
    assert f"{remedy}, or train on the others with scene.missing=0.34" in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-32"])
def test_a_byte_order_mark_is_passed_over(tmp_path: Path, encoding: str) -> None:
    """Editors and shells of Windows write them."""
    write(tmp_path)
    text = (tmp_path / "transforms.json").read_text()
    (tmp_path / "transforms.json").write_bytes(text.encode(encoding))
    assert len(views(load(options(tmp_path)))) == 3


def test_what_is_left_out_of_instant_ngp_is_said(tmp_path: Path) -> None:
    write(
        tmp_path, rolling_shutter=[0, 0.5, 0, 0], white_transparent=False, aabb_scale=4, sharpness=3.0, offset=[1, 2, 3]
    )
    told = "transforms.json states rolling_shutter: left out, photos are used as stored."
    assert told in load(options(tmp_path)).notes
    write(tmp_path, rolling_shutter=[0, 0, 0, 0], depth_file_path="a.png", orientation_override="none")
    assert not any("left out" in note for note in load(options(tmp_path)).notes)


def test_a_file_of_sdfstudio_is_refused_by_name(tmp_path: Path) -> None:
    content = {"camera_model": "OPENCV", "frames": [{"rgb_path": "0.png", "camtoworld": [], "intrinsics": []}]}
    (tmp_path / "meta_data.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"is of SDFStudio \(rgb_path\), which gsx does not read: export transforms"):
        load(options(tmp_path / "meta_data.json"))


def test_points_that_a_file_names_and_that_are_missing_are_refused(tmp_path: Path) -> None:
    for name in ("sparse_pc.ply", "", ".", "a\0b.ply", "n" * 300 + ".ply"):
        write(tmp_path, ply_file_path=name)
        refused(r"scene\.points=random", load, options(tmp_path))
    write(tmp_path, ply_file_path=7)
    refused(r"ply_file_path 7.*scene\.points=random", load, options(tmp_path))


@pytest.mark.parametrize("name", [*(f"images/{chr(code)}.png" for code in (0, 0xD800, 0xDCFF))])
def test_a_name_that_is_no_text_is_refused(tmp_path: Path, name: str) -> None:
    write(tmp_path, frames=frame_changes(file_path=name))
    with pytest.raises(InputError, match=r"names a photo 'images/\\[xu][0-9a-f]+\.png', which is no text: rename"):
        load(options(tmp_path, missing=1.0))


@pytest.mark.parametrize("listed", [None, 5, "images/0.png", {"images/0.png": 1}])
@pytest.mark.parametrize("key", ["train_filenames", "test_filenames"])
def test_lists_that_are_none_are_refused(tmp_path: Path, key: str, listed: object) -> None:
    write(tmp_path, train_filenames=["images/1.png", "images/2.png"], test_filenames=["images/0.png"])
    content = json.loads((tmp_path / "transforms.json").read_text()) | {key: listed}
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    refused(rf"{key} of .*transforms\.json' is .*: give a list", load, options(tmp_path))


@pytest.mark.parametrize("name", ["/", ".", "..", "", "n" * 300])
def test_a_name_that_is_no_photo_is_a_missing_photo(tmp_path: Path, name: str) -> None:
    write(tmp_path, frames=frame_changes(file_path=name))
    refused(r"1 of the 3 images of .* are not on disk", load, options(tmp_path))


def test_a_camera_that_is_nowhere_near_is_refused(tmp_path: Path) -> None:
    write(tmp_path, frames=frame_changes(transform_matrix=[[1, 0, 0, 1e300], *POSES[0][1:]]))
    refused(r"images/1\.png' is more than 1e\+09 units away", load, options(tmp_path))


def test_a_camera_far_off_all_others_is_refused_by_name(tmp_path: Path) -> None:
    """Half of them are within two units of their middle."""
    write(tmp_path, frames=frame_changes(transform_matrix=[[1, 0, 0, 1e3], *POSES[0][1:]]))
    assert len(views(load(options(tmp_path)))) == 3
    write(tmp_path, frames=frame_changes(transform_matrix=[[1, 0, 0, 1e6], *POSES[0][1:]]))
    refused(r"images/1\.png' is 5e\+05 times as far .*: correct its pose, or", load, options(tmp_path))


@pytest.mark.parametrize("jitter", [0.0, 1e-17, 5e-7])
def test_all_but_one_camera_may_stand_at_one_place(tmp_path: Path, jitter: float) -> None:
    """The faces of a panorama, and a camera a metre beside it."""
    along = [jitter * (number % 3) for number in range(11)] + [1.0]
    write(tmp_path, poses=[[[1, 0, 0, x], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] for x in along])
    assert len(views(load(options(tmp_path)))) == 12


def test_half_of_a_video_may_stand_still(tmp_path: Path) -> None:
    """Its centres jitter by a ten-thousandth; then it walks thirty units away."""
    along = [1e-4 * number for number in range(6)] + [6.0 * number for number in range(1, 6)]
    write(tmp_path, poses=[[[1, 0, 0, x], *POSES[0][1:]] for x in along])
    assert len(views(load(options(tmp_path)))) == 11


def test_most_cameras_may_stand_on_a_tripod(tmp_path: Path) -> None:
    """Turned about a corner far from the origin: rounding moves their centres, and the last one stands elsewhere."""
    poses = []
    for turn in (0.0, 0.3, 0.9, 2.0):
        c, s = math.cos(turn), math.sin(turn)
        poses.append([[c, 0, s, 1e3 / 3], [s, 0, -c, 2e3 / 3], [0, 1, 0, 7.1], [0, 0, 0, 1]])
    poses.append([*[[*row[:3], row[3] + 1] for row in poses[0][:3]], [0, 0, 0, 1]])
    write(tmp_path, poses=poses)
    scene = load(options(tmp_path, split="none"))
    assert scene.extent == pytest.approx(1.1 * 0.8 * math.sqrt(3))


def test_a_file_of_brackets_alone_is_one_sentence(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "transforms.json").write_text("[" * 100_000)
    refused(r"no valid JSON \(its brackets are nested too deeply\)", load, options(tmp_path))


def test_missing_photos_are_named_and_skipped(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "images" / "1.png").unlink()
    with pytest.raises(InputError, match=r"1 of the 3 images of .*not on disk \(images/1\.png\).*scene\.missing=0\.34"):
        load(options(tmp_path, split="none", missing=0.32))
    scene = load(options(tmp_path, split="none", missing=0.34))
    assert [view.name for view in scene.train] == ["images/0.png", "images/2.png"]
    assert any("Skipped 1 of the 3 images" in note and "images/1.png" in note for note in scene.notes)
    (tmp_path / "images" / "0.png").unlink()
    refused("at least 2 images", load, options(tmp_path, split="none", missing=1.0))
    (tmp_path / "images" / "2.png").unlink()
    refused(r"None of the 3 images .*images/0\.png, images/1\.png, images/2\.png", load, options(tmp_path))


def test_the_files_own_split(tmp_path: Path) -> None:
    lists = {"train_filenames": ["images/2.png", "images/0.png"], "test_filenames": ["./images/1.png"]}
    write(tmp_path, **lists)
    scene = load(options(tmp_path))
    assert [view.name for view in scene.train] == ["images/0.png", "images/2.png"]
    assert [view.name for view in scene.test] == ["images/1.png"]
    for rule in ("every:8", "sharp:8"):  # of pictures as small nothing is known: the first
        assert [view.name for view in load(options(tmp_path, split=rule)).test] == ["images/0.png"]
    write(tmp_path, train_filenames=lists["train_filenames"], val_filenames=["images/1.png"])
    assert [view.name for view in load(options(tmp_path)).test] == ["images/1.png"]


def test_a_list_to_test_on_alone_leaves_the_others_to_train_on(tmp_path: Path) -> None:
    write(tmp_path, test_filenames=["images/1.png"])
    scene = load(options(tmp_path))
    assert [view.name for view in scene.train] == ["images/0.png", "images/2.png"]
    assert [view.name for view in scene.test] == ["images/1.png"]


def write_pair(folder: Path, test: str = "transforms_test.json", common: dict[str, Any] = COMMON) -> None:
    """Two files as instant-ngp's tools write them: two frames to train on, one to test on, all through a lens."""
    write(folder)
    frames = frame_changes()
    for name, part in (("transforms_train.json", frames[:2]), (test, frames[2:])):
        (folder / name).write_text(json.dumps(common | {"frames": part}))
    (folder / "transforms.json").unlink()


@pytest.mark.parametrize("test", ["transforms_test.json", "transforms_val.json"])
def test_two_files_with_lenses_are_one_scene(tmp_path: Path, test: str) -> None:
    write_pair(tmp_path, test)
    scene = load(options(tmp_path))
    assert [view.name for view in scene.train] == ["images/0.png", "images/1.png"]
    assert [view.name for view in scene.test] == ["images/2.png"]
    assert (scene.test[0].camera.fx, scene.test[0].camera.cy) == (110, 41)
    assert f"Test views are those of {test}." in scene.notes
    assert scene.provenance["test_file"] == test
    assert len(load(options(tmp_path, split="none")).train) == 3
    assert [view.name for view in load(options(tmp_path, split="every:3")).test] == ["images/0.png"]


def test_of_two_files_that_share_an_image_none_is_read(tmp_path: Path) -> None:
    write_pair(tmp_path)
    (tmp_path / "transforms_test.json").write_text((tmp_path / "transforms_train.json").read_text())
    refused(r"transforms_test\.json' has 'images/0\.png' twice, perhaps to train", load, options(tmp_path))


def test_a_file_to_train_on_alone_is_split(tmp_path: Path) -> None:
    write_pair(tmp_path)
    (tmp_path / "transforms_test.json").write_text('{"frames": []}')
    refused("leaves 1 image to train on", load, options(tmp_path))
    (tmp_path / "transforms_train.json").write_text(json.dumps(COMMON | {"frames": frame_changes()}))
    scene = load(options(tmp_path))
    assert [view.name for view in scene.test] == ["images/0.png"]
    assert any("transforms_train.json lists no train_filenames: the split is every:8" in note for note in scene.notes)


def test_frames_to_test_on_of_scannet(tmp_path: Path) -> None:
    frames = frame_changes()
    write(tmp_path, frames=frames[:2], test_frames=frames[2:])
    scene = load(options(tmp_path))
    assert [view.name for view in scene.train] == ["images/0.png", "images/1.png"]
    assert [view.name for view in scene.test] == ["images/2.png"]
    write(tmp_path, frames=frames, test_frames=frames[2:])
    refused(r"has 'images/2\.png' twice", load, options(tmp_path))


def formats(folder: Path) -> list[str]:
    return [loader.name for loader, _ in readable(folder, plugins()) if loader.name != "photos"]


def test_a_folder_is_read_by_the_loader_that_knows_its_cameras(tmp_path: Path) -> None:
    """No circle: whoever states more than an angle of view is read by scene=transforms, the others by scene=blender."""
    write_pair(tmp_path)
    assert formats(tmp_path) == ["transforms"]
    refused(r"camera_angle_x None, .*: with fl_x use scene=transforms", load_blender, blender_options(tmp_path))
    plain = {"camera_angle_x": 2 * math.atan(60 / 110), "w": 120, "h": 90}
    write_pair(tmp_path, common=plain)
    assert formats(tmp_path) == ["blender"]
    refused("it is a scene=blender folder", load, options(tmp_path))
    for stated in ({"fl_x": 110.0, "fl_y": 110.0, "cx": 60}, {"is_fisheye": False, "k1": 0}):  # the same camera
        write_pair(tmp_path, common=plain | stated)
        assert formats(tmp_path) == ["blender"]
    for stated in ({"cx": 70}, {"k1": 0.1}, {"fl_x": 150}, {"camera_model": "OPENCV_FISHEYE"}):
        write_pair(tmp_path, common=plain | {"fl_x": 110.0, "fl_y": 110.0} | stated)
        assert formats(tmp_path) == ["transforms"]
        assert len(load(options(tmp_path)).train) == 2


def test_without_lists_every_eighth_is_held_out(tmp_path: Path) -> None:
    write(tmp_path)
    scene = load(options(tmp_path))
    assert [view.name for view in scene.test] == ["images/0.png"]
    assert any("every:8" in note for note in scene.notes)


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (["images/0.png", "images/7.png"], ["images/1.png"], r"train_filenames of .* names 'images/7\.png'"),
        (["images/0.png", "images/1.png"], ["images/1.png"], r"'images/1\.png' is in train_filenames and test"),
        (["images/0.png", "images/1.png"], [], "names no image"),
        (["images/0.png"], ["images/1.png"], "at least 2 images"),
    ],
)
def test_unusable_lists_are_refused(tmp_path: Path, train: list[str], test: list[str], message: str) -> None:
    write(tmp_path, train_filenames=train, test_filenames=test)
    refused(message, load, options(tmp_path))


def test_random_points_fill_the_cube_around_the_cameras(tmp_path: Path) -> None:
    write(tmp_path)
    positions = load(options(tmp_path, random_points=3000)).points.positions
    # centres span [-1, 1] x {-4} x [-0.5, 0.5]: the cube has edge 2 around (0, -4, 0)
    torch.testing.assert_close(positions.amin(0), torch.tensor([-1.0, -5, -1]), atol=0.01, rtol=0)
    torch.testing.assert_close(positions.amax(0), torch.tensor([1.0, -3, 1]), atol=0.01, rtol=0)


def test_points_come_from_the_file_it_names(tmp_path: Path) -> None:
    write_ply(tmp_path / "sparse.ply", {axis: np.array([1.0, 2.0]) for axis in "xyz"})
    write(tmp_path, ply_file_path="sparse.ply", applied_transform=[[0, 1, 0, 9], [1, 0, 0, 9], [0, 0, 1, 9]])
    scene = load(options(tmp_path))
    assert scene.points.positions.tolist() == [[1, 1, 1], [2, 2, 2]]
    centre = views(scene)[0].camera.centre
    torch.testing.assert_close(centre, torch.tensor([-1.0, -4, -0.5], dtype=torch.float64))
    assert len(load(options(tmp_path, points="random")).points) == 50


def test_cameras_in_one_place_need_points(tmp_path: Path) -> None:
    write(tmp_path, poses=[POSES[0]] * 3)
    refused(r"scene\.points to a PLY file", load, options(tmp_path))


def test_path_may_be_the_file(tmp_path: Path) -> None:
    write(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "raw.json")
    assert len(views(load(options(tmp_path / "raw.json")))) == 3
    refused(r"transforms\.json' does not exist", load, options(tmp_path))
    (tmp_path / "transforms_train.json").write_text("{}")
    refused("scene=blender", load, options(tmp_path))


def test_masks_of_frames(tmp_path: Path) -> None:
    write(tmp_path, frames=frame_changes(mask_path="elsewhere/1.png"))
    refused(r"elsewhere/1\.png' of .*scene\.masks=none", load, options(tmp_path))
    (tmp_path / "elsewhere").mkdir()
    mask = torch.ones(3, HEIGHT, WIDTH)
    mask[:, :10] = 0
    write_image(tmp_path / "elsewhere" / "1.png", mask)
    scene = load(options(tmp_path))
    assert any("masks of 1 of" in note for note in scene.notes)
    counted = [view.counted() for view in (*scene.train, *scene.test)]
    (known,) = (found for found in counted if found is not None)
    assert torch.equal(known, mask[0] > 0)


def test_provenance_is_json(tmp_path: Path) -> None:
    write(tmp_path, **BENT)
    provenance = json.loads(json.dumps(load(options(tmp_path)).provenance))
    assert provenance["format"] == "transforms"
    assert provenance["undistortion"]


ODD = [None, True, -1, math.nan, 1e300, 10**400, "", "x", "\0", "\ud800", [], [[]], [None], {}, {"a": 1}]
"""Values of other kinds than keys of transforms files have."""
RICH = COMMON | {
    "camera_model": "OPENCV_FISHEYE", "is_fisheye": True, "k1": 0.05, "k4": 0.01, "p1": 0.0, "x_fov": None,
    "camera_angle_x": 1.0, "camera_angle_y": 1.0, "distortion_params": [0.0] * 12, "ply_file_path": None,
    "train_filenames": ["images/0.png", "images/1.png"], "test_filenames": ["images/2.png"], "test_frames": [],
    "rolling_shutter": [0, 0, 0, 0], "applied_transform": POSES[0], "frames": None, "equirectangular": None,
}  # fmt: skip


FRAME = ("file_path", "transform_matrix", "mask_path", "fl_x", "k1", "camera_model", "w")
SHARE = 30
"""Of the values that are tried one in so many, each time others: all of them take half a minute."""


@pytest.mark.parametrize("model", ["OPENCV_FISHEYE", "FISHEYE624", "OPENCV"])
def test_values_of_other_kinds_are_one_sentence(tmp_path: Path, model: str) -> None:
    """No exception of Python's reaches anybody; what loads all the same has finite cameras."""
    write(tmp_path)
    cases = [({key: odd}, {}) for key in RICH for odd in ODD] + [({}, {key: odd}) for key in FRAME for odd in ODD]
    for common, own in cases[len(model) % SHARE :: SHARE]:
        fisheye = {"camera_model": model, "is_fisheye": model != "OPENCV"}
        content = RICH | fisheye | {"frames": frame_changes(**own)} | common
        (tmp_path / "transforms.json").write_text(json.dumps(content))
        outcome(tmp_path)


def outcome(folder: Path) -> None:
    """Load what is there: it is a scene of finite cameras, or refused in one line."""
    try:
        scene = load(options(folder, missing=0.5))
    except InputError as error:
        text = str(error)
        assert text, "no sentence"
        assert "\n" not in text
        text.encode("utf-8", "strict")
    else:
        assert all(math.isfinite(view.camera.fx) for view in (*scene.train, *scene.test))


def test_photos_are_turned_upright_with_their_cameras(tmp_path: Path) -> None:
    picture = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    write(tmp_path, image=picture)
    before = views(load(options(tmp_path)))
    for number, orientation in enumerate((6, 8, 3)):
        write_image(tmp_path / "images" / f"{number}.png", picture, {"Orientation": orientation})
    scene = load(options(tmp_path))
    for view, stored, orientation in zip(views(scene), before, (6, 8, 3), strict=True):
        assert view.camera.draws_as(oriented_camera(stored.camera, orientation))
        assert torch.equal(view.image(), oriented(stored.image(), orientation))
    assert "EXIF turns 3 of 3 photos upright (scene.orientation)." in scene.notes
    kept = views(load(options(tmp_path, orientation="stored")))
    assert all(view.camera.draws_as(stored.camera) for view, stored in zip(kept, before, strict=True))
