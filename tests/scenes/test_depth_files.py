"""Depth maps of photographs: files of each kind, their units and shapes, and their fit to points, by hand and exact."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest
import torch
from refusals import refused
from synthetic_colmap import colmap_options, synthesize, write_scene
from test_transforms import frame_changes, options, write
from torch import Tensor

from gsx.core.data.camera import Camera
from gsx.core.data.scene import Scene, View
from gsx.scenes.colmap import ColmapOptions, depths_of, load
from gsx.scenes.colmap_model import read_model
from gsx.scenes.depth_files import FEWEST, fitted, robust_line, straightened, with_depth_maps
from gsx.scenes.orientation import Turned
from gsx.scenes.transforms import load as load_transforms
from gsx.scenes.undistort import StoredUndistortion, pinhole_of


def views_of(scene: Scene, options: Any) -> list[View]:
    """All views by name, each with its map if there is a file."""
    scene = with_depth_maps(scene, options)
    return sorted(scene.train, key=lambda view: view.name)


def opened(folder: Path, **changes: Any) -> list[View]:
    """Views of the COLMAP scene under options."""
    chosen: ColmapOptions = colmap_options(folder, split="none", **changes)
    return views_of(load(chosen), chosen)


def map_of(view: View) -> Tensor | None:
    assert view.depth_map is not None
    return view.depth_map()


def sparse_map(view: View) -> np.ndarray:
    """z at the pixels of observed points, the nearer one where two share a pixel; 0 elsewhere."""
    out = np.zeros((view.camera.height, view.camera.width))
    assert view.sparse is not None
    order = view.sparse.z.argsort(descending=True)
    column, row = view.sparse.pixels[order].long().T.numpy()
    out[row, column] = view.sparse.z[order].double().numpy()
    return out


def store(file: Path, values: np.ndarray) -> None:
    """Write numbers in a file's own format."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if file.suffix == ".npy":
        np.save(file, values)
        return
    buffer = oiio.ImageBuf(np.ascontiguousarray(values))
    assert buffer.write(str(file)), buffer.geterror()


@pytest.fixture(scope="module")
def synthetic(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A COLMAP scene of 50 points on a sphere, which all five photos observe."""
    folder = tmp_path_factory.mktemp("scene")
    write_scene(synthesize(), folder)
    return folder


@pytest.fixture
def folder(synthetic: Path) -> Any:
    """The scene, without the maps of other tests."""
    yield synthetic
    for file in (synthetic / "depths").glob("*"):
        file.unlink()


def test_views_have_the_depths_of_the_points_that_they_observe(folder: Path) -> None:
    """Against pycolmap's own lists. Errors are set to 1, 3 and unknown in turn: their mean is 2."""
    model = pycolmap.Reconstruction(folder / "sparse/0")
    for view in opened(folder):
        image = next(one for one in model.images.values() if one.name == view.name)
        observed = [point for point in image.points2D if point.has_point3D()]
        z = [(image.cam_from_world() * model.point3D(point.point3D_id).xyz)[2] for point in observed]
        assert view.sparse is not None
        torch.testing.assert_close(view.sparse.z.double(), torch.tensor(z, dtype=torch.float64), rtol=1e-6, atol=0)
        keypoints = torch.tensor(np.array([point.xy for point in observed]))
        torch.testing.assert_close(view.sparse.pixels.double(), keypoints, rtol=0, atol=0.01)


def test_observed_points_count_by_their_errors(tmp_path: Path) -> None:
    """Errors 1 and 3 in turn: exp(-(1 / 2)^2) and exp(-(3 / 2)^2), but for the mean of those in view; unknown: 1."""
    model = synthesize()
    for number, point in model.points3D.items():
        point.error = (1.0, 3.0)[number % 2]
    write_scene(model, tmp_path)
    first = opened(tmp_path)[0]
    image = next(one for one in model.images.values() if one.name == first.name)
    errors = torch.tensor([model.point3D(p.point3D_id).error for p in image.points2D if p.has_point3D()])
    assert first.sparse is not None
    torch.testing.assert_close(first.sparse.weights, (-((errors / errors.mean()) ** 2)).exp().float())
    for point in model.points3D.values():
        point.error = -1.0
    write_scene(model, tmp_path / "unknown")
    unknown = opened(tmp_path / "unknown")[0].sparse
    assert unknown is not None
    assert set(unknown.weights.tolist()) == {1.0}


def test_maps_are_fitted_to_all_points_in_front_where_observations_are_unknown(folder: Path) -> None:
    """Against the sphere: the map of its front is found, though half of the points lie on its back."""
    chosen = colmap_options(folder, split="none")
    view = opened(folder)[0]
    image = next(one for one in read_model(folder / "sparse/0").images if one.name == view.name)
    none = replace(image, observed=image.observed[:0], errors=image.errors[:0], keypoints=image.keypoints[:0])
    assert depths_of(view, none) is None
    front = sphere(view.camera)
    store(folder / "depths" / f"{view.name}.npy", torch.where(front > 0, 0.5 * front + 0.1, 0.0).numpy())
    scene = load(chosen)
    found = map_of(views_of(replace(scene, train=[replace(one, sparse=None) for one in scene.train]), chosen)[0])
    torch.testing.assert_close(found, front.float(), rtol=0.02, atol=0)


def sphere(camera: Camera) -> Tensor:
    """z of the front of the unit sphere at the pixels of a camera: the smaller root of |c + z d| = 1; 0 outside."""
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    rays = torch.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, torch.ones_like(x)], -1).double()
    square, along = rays.square().sum(-1), rays @ camera.rotation.double() @ camera.centre.double()
    root = along.square() - square * (float(camera.centre.double().square().sum()) - 1)
    return torch.where(root > 0, (-along - root.clamp_min(0).sqrt()) / square, 0.0)


@pytest.mark.parametrize("name", ["{}.npy", "{stem}.exr", "{stem}.png", "{}.png"])
def test_files_of_each_kind_are_found_and_read_in_their_units(folder: Path, name: str) -> None:
    view = opened(folder)[1]
    values = sparse_map(view)
    file = folder / "depths" / name.format(view.name, stem=Path(view.name).stem)
    whole = file.suffix == ".png"
    store(file, (1000 * values + 0.5).astype(np.uint16) if whole else values.astype(np.float32))
    torch.testing.assert_close(
        map_of(opened(folder, depth_fit="none")[1]), torch.tensor(values).float(), rtol=0, atol=6e-4
    )
    assert opened(folder)[0].depth_map is None
    ten_times = opened(folder, depth_unit=0.01 if whole else 10.0, depth_fit="none")[1]
    assert map_of(ten_times) is None, "ten times as far as the points"
    torch.testing.assert_close(
        map_of(opened(folder, depth_unit=5.0)[1]), torch.tensor(values).float(), rtol=2e-3, atol=0
    )


@pytest.mark.parametrize("values", ["depth", "disparity"])
@pytest.mark.parametrize(("fit", "slope", "shift"), [("affine", 0.3, 0.05), ("scale", 7.0, 0.0), ("none", 1.0, 0.0)])
def test_a_map_on_its_own_scale_is_found_again(folder: Path, values: str, fit: str, slope: float, shift: float) -> None:
    view = opened(folder)[0]
    true = sparse_map(view)
    known = true > 0
    aim = np.divide(1, true, where=known, out=np.zeros_like(true)) if values == "disparity" else true
    store(folder / "depths" / f"{view.name}.npy", np.where(known, slope * aim + shift, 0))
    found = map_of(opened(folder, depth_values=values, depth_fit=fit)[0])
    torch.testing.assert_close(found, torch.tensor(true).float(), rtol=1e-3, atol=0)
    wrong = "depth" if values == "disparity" else "disparity"
    assert map_of(opened(folder, depth_values=wrong, depth_fit="affine")[0]) is None, "it falls where points rise"


def test_a_map_half_as_fine_gives_its_nearest_values(folder: Path) -> None:
    small = np.arange(1, 32 * 24 + 1, dtype=np.float32).reshape(24, 32)
    view = opened(folder)[0]
    store(folder / "depths" / f"{view.name}.npy", small)
    transparent = {"depth_fit": "none", "max_reprojection_px": 9}
    for downscale, expected in ((1, small.repeat(2, 0).repeat(2, 1)), (2, small)):
        chosen = colmap_options(folder, split="none", downscale=downscale, **transparent)
        scene = load(chosen)
        unseen = [View(one.name, one.camera, one.source) for one in scene.train]
        maps = with_depth_maps(Scene(**{**vars(scene), "train": unseen}), chosen).train
        found = map_of(next(one for one in maps if one.name == view.name))
        assert found is not None
        assert torch.equal(found[found > 0], torch.tensor(expected)[found > 0])
        assert float((found > 0).float().mean()) > 0.99  # all but those nearer than the near plane


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros((48, 64), np.float32), "holds no number above 0"),
        (np.full((48, 64), np.nan, np.float32), "holds no number above 0"),
        (np.ones((64, 48), np.float32), "is 48 x 64, but .* is 64 x 48: give it the photo's shape"),
        (np.random.default_rng(0).random((48, 64, 3), np.float32), r"shape \[48, 64, 3\] .*one number per pixel"),
    ],
)
def test_odd_maps_are_refused(folder: Path, values: np.ndarray, words: str) -> None:
    view = opened(folder)[0]
    file = folder / "depths" / f"{Path(view.name).stem}.npy"
    store(file, values)
    view = opened(folder)[0]
    refused(words, map_of, view)
    file.write_bytes(b"nothing")
    refused("cannot be read", map_of, view)


def test_nerfstudio_names_its_maps(tmp_path: Path) -> None:
    write(tmp_path, frames=frame_changes(depth_file_path="sensor/b.png"))
    store(tmp_path / "sensor" / "b.png", np.full((90, 120), 2500, np.uint16))
    chosen = options(tmp_path, depth_fit="none")
    scene = load_transforms(chosen)
    named = next(view for view in with_depth_maps(scene, chosen).train if view.depth_map is not None)
    torch.testing.assert_close(map_of(named), torch.full((90, 120), 2.5))
    (tmp_path / "sensor" / "b.png").unlink()
    refused("'.*b.png' does not exist: restore it, or set training.depth.when=never", map_of, named)


def test_maps_are_turned_and_undistorted_as_photos_are() -> None:
    """EXIF 6 is a turn to the right; a bent lens against pycolmap's projections, pixel by pixel."""
    values = torch.arange(1.0, 49.0).reshape(6, 8)
    turned = straightened(values, Turned((6,), None, 1))
    assert np.array_equal(turned.numpy(), np.rot90(values.numpy(), -1))
    bent = [500, 505, 322, 238, 0.12, -0.05, 0.004, -0.006]
    lens = pycolmap.Camera(model="OPENCV", width=640, height=480, params=bent)
    pinhole = pinhole_of(lens)
    columns = (torch.arange(320.0) + 1).expand(240, 320)
    found = straightened(columns, StoredUndistortion(Path("a"), lens, pinhole, (1, 1)))
    for x, y in ((3, 5), (100, 77), (280, 200)):
        scale = pinhole.width / found.shape[1]
        ray = pinhole.cam_from_img(np.array([(x + 0.5) * scale, (y + 0.5) * scale]))
        place = lens.img_from_cam(np.array([*ray, 1.0]))
        assert float(found[y, x]) == np.floor(place[0] / 2) + 1


# -- the fit -----------------------------------------------------------------------------------------------------------


def test_a_line_through_seven_of_ten_points_is_found() -> None:
    """y = 3 x + 2 by hand; the three others lie far off. Least squares alone misses."""
    x = torch.arange(1.0, 11.0)
    y = 3 * x + 2
    wrong = y.clone()
    wrong[[1, 5, 8]] = torch.tensor([90.0, 1.0, 2.0])
    assert robust_line(x, wrong) == pytest.approx((3, 2), abs=1e-3)
    assert robust_line(x, 3 * x, shift=False) == (pytest.approx(3), 0.0)
    many = torch.linspace(1, 50, 20_000)  # all pairs of them would not fit into memory
    assert robust_line(many, 3 * many + 2) == pytest.approx((3, 2), abs=1e-3)
    columns = torch.stack([x, torch.ones(10)], 1)
    assert abs(float(torch.linalg.lstsq(columns, wrong).solution[0]) - 3) > 1


def test_the_error_of_far_points_counts_relatively() -> None:
    """Two groups of points that no line fits: the slope through 0 is that of the larger one."""
    slope, _ = robust_line(torch.tensor([1.0, 1.0, 100.0]), torch.tensor([2.0, 2.0, 100.0]), shift=False)
    assert slope == pytest.approx(2, abs=1e-3)


def test_few_points_or_noise_fit_nothing_and_metric_maps_need_no_points(folder: Path) -> None:
    z = torch.linspace(1, 3, 40)
    noise = z * 10 ** torch.rand(40, generator=torch.Generator().manual_seed(0))
    scale, metric = colmap_options(folder, depth_fit="scale"), colmap_options(folder, depth_fit="none")
    assert fitted(noise, z, scale, observed=True) is None
    few = z[: FEWEST - 1]
    assert fitted(few, few, scale, observed=True) is None
    assert fitted(z / 2, z, scale, observed=False) == (pytest.approx(2), 0.0)
    assert fitted(9 * z, z, metric, observed=True) is None
    assert fitted(9 * z, z, metric, observed=False) == (1.0, 0.0)
    assert fitted(9 * few, few, metric, observed=True) == (1.0, 0.0)
    assert math.isclose((fitted(z, z, metric, observed=True) or (0.0,))[0], 1)
