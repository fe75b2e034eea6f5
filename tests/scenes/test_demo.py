"""The built-in scene against hand-worked hits, a float64 march through signed distances, and its own promises."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from torch.nn import functional as F

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import Scene
from gsx.core.errors import ConfigError
from gsx.scenes.demo import DemoOptions, load, tracing
from gsx.scenes.demo.font import ALPHABET, GLYPHS, Line, typeset
from gsx.scenes.demo.noise import SIDE, angle, make_noise
from gsx.scenes.demo.solids import BOX, CYLINDER, SPHERE, Solid, box, cylinder, normalise, sphere, window
from gsx.scenes.demo.still_life import (
    DOME,
    SKYLIGHT,
    SUN,
    SUNLIGHT,
    StillLife,
    Thing,
    make_still_life,
    openness,
    sunlight,
    thing_colour,
)
from gsx.scenes.demo.textures import cosine, specular
from gsx.scenes.demo.tracing import GROUND, SKY, camera_rays, lattice, rays_through, render, slopes, trace

ORIGIN = (0.0, 0.0, 0.0)
DEFAULTS = Path(__file__).parents[2] / "conf" / "scene" / "demo.yaml"


@pytest.fixture(scope="module")
def life() -> StillLife:
    return make_still_life()


@pytest.fixture(scope="module")
def camera() -> Camera:
    return look_at((0.9, -2.6, 1.5), (0.0, 0.0, 0.5), fov_x=0.87, width=96, height=72)


def options(**changes: object) -> DemoOptions:
    """The defaults with fewer, smaller pictures."""
    small = {"width": 64, "height": 48, "train_views": 8, "test_views": 4, "points": 2000, "samples": 3}
    shipped = OmegaConf.load(DEFAULTS)
    del shipped["defaults"]  # Hydra's own
    made = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(DemoOptions), shipped, small, changes))
    assert isinstance(made, DemoOptions)
    return made


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSX_CACHE", str(tmp_path_factory.mktemp("cache")))
        return load(options())


# --- solids ---------------------------------------------------------------------------------------------------------


def hit(solid: Solid, origin: tuple[float, ...], direction: tuple[float, ...]) -> tuple[float, float]:
    enter, leave = solid.interval(torch.tensor(origin)[:, None], torch.tensor(direction)[:, None])
    return float(enter), float(leave)


@pytest.mark.parametrize(
    ("solid", "origin", "direction", "expected"),
    [
        (sphere("", (1.0, 0.0, 0.0), 2.0), (6.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (3.0, 7.0)),
        (sphere("", (0.0, 0.0, 0.0), 5.0), (3.0, -10.0, 0.0), (0.0, 1.0, 0.0), (6.0, 14.0)),
        (box("", (0.0, 0.0, 0.0), (2.0, 2.0, 2.0), 45.0), (5.0, 0.0, 0.5), (-1.0, 0.0, 0.0), (5 - 2**0.5, 5 + 2**0.5)),
        (box("", (0.0, 0.0, 3.0), (2.0, 4.0, 6.0)), (0.5, 0.5, 10.0), (0.0, 0.0, -2.0), (2.0, 5.0)),
        (cylinder("", (0.0, 0.0, 1.0), 5.0, 2.0), (3.0, -9.0, 1.5), (0.0, 1.0, 0.0), (5.0, 13.0)),
        (cylinder("", (0.0, 0.0, 1.0), 5.0, 2.0), (3.0, 0.0, 4.0), (0.0, 0.0, -1.0), (2.0, 4.0)),
        (cylinder("", (0.0, 0.0, 1.0), 5.0, 2.0), (0.0, 0.0, 4.0), (0.6, 0.0, -0.8), (2.5, 5.0)),
    ],
)
def test_hits_worked_by_hand(solid, origin, direction, expected):
    assert hit(solid, origin, direction) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    "solid", [sphere("", ORIGIN, 1.0), box("", ORIGIN, (2.0, 2.0, 2.0)), cylinder("", ORIGIN, 1.0, 2.0)]
)
def test_a_ray_that_misses_has_no_interval(solid):
    enter, leave = hit(solid, (0.0, -4.0, 1.5), (0.0, 1.0, 0.0))
    assert not enter <= leave


def test_distant_spheres_keep_their_surface():
    """The closest-approach form: 1000 units away the error stays near float32 rounding of the position itself."""
    ball = sphere("", (0.0, 0.0, 0.0), 0.5)
    enter, _ = hit(ball, (1000.0, 0.3, 0.0), (-1.0, 0.0, 0.0))
    assert enter == pytest.approx(1000.0 - 0.4, abs=1e-4)


def reference_distance(solid: Solid, points: np.ndarray) -> np.ndarray:
    """Signed distances [P] of float64 points [P, 3]."""
    c, s = np.cos(solid.yaw), np.sin(solid.yaw)
    world_from_local = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p, half = (points - solid.centre.numpy()) @ world_from_local, solid.half.numpy()
    if solid.shape is SPHERE:
        return np.linalg.norm(p, axis=1) - half[0]
    beyond = (
        np.abs(p) - half
        if solid.shape is BOX
        else np.stack([np.hypot(p[:, 0], p[:, 1]) - half[0], np.abs(p[:, 2]) - half[2]], axis=1)
    )
    return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)


def march(solids: tuple[Solid, ...], origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths and owners along unit rays [P, 3] by sphere tracing; GROUND where the plane z = 0 comes first."""
    depth = np.zeros(len(directions))
    for _ in range(4000):
        points = origin + depth[:, None] * directions
        distances = np.stack([reference_distance(solid, points) for solid in solids] + [points[:, 2]])
        nearest = distances.min(axis=0)
        if np.all((nearest < 1e-9) | (depth > DOME)):
            break
        depth = np.where(depth > DOME, depth, depth + nearest)
    owner = distances.argmin(axis=0)
    return depth, np.where(owner == len(solids), GROUND, owner)


def test_hits_agree_with_a_march_through_distances(life, camera):
    pixels = torch.rand(2, 600, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rays = rays_through(camera, pixels[0] * camera.width, pixels[1] * camera.height)
    hits = trace(life, rays)
    directions = rays.directions.double().T.numpy()
    depth, owner = march(life.solids, rays.origin.numpy(), directions)
    near = depth < 8.0  # beyond, grazing rays along the ground end the march early
    assert near.sum() > 500
    assert len(set(owner[near].tolist())) >= 8
    assert np.mean(hits.owner.numpy()[near] == owner[near]) > 0.995
    assert np.quantile(np.abs(hits.depth.numpy() - depth)[near], 0.995) < 2e-5


@pytest.mark.parametrize("yaw", [0.0, 33.0])
def test_distances_agree_with_the_reference(yaw):
    points = torch.randn(3, 500, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    for solid in (
        sphere("", (0.1, 0.2, 0.3), 0.6), box("", (0.1, 0.2, 0.3), (0.5, 1.0, 1.5), yaw),
        cylinder("", (0.1, 0.2, 0.3), 0.6, 1.4, yaw),
    ):  # fmt: skip
        expected = reference_distance(solid, points.T.numpy())
        np.testing.assert_allclose(solid.distance(points).numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("shape", [SPHERE, BOX, CYLINDER])
def test_normals_point_where_distance_grows_fastest(shape):
    """Central differences of the reference distance at points of the surface, away from edges."""
    solid = Solid(name="", shape=shape, centre=torch.zeros(3).double(), half=torch.tensor([0.4, 0.4, 0.7]).double())
    if shape is SPHERE:
        solid = replace(solid, half=torch.full((3,), 0.5).double())
    origins = torch.randn(3, 400, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 0.1
    directions = normalise(torch.randn(3, 400, generator=torch.Generator().manual_seed(4), dtype=torch.float64))
    points = origins + solid.interval(origins, directions)[1] * directions
    step = 1e-5 * np.eye(3)
    gradient = np.stack([
        (reference_distance(solid, points.T.numpy() + e) - reference_distance(solid, points.T.numpy() - e)) / 2e-5
        for e in step
    ])  # fmt: skip
    smooth = np.abs(np.linalg.norm(gradient, axis=0) - 1) < 1e-6
    assert smooth.sum() > 390
    np.testing.assert_allclose(solid.normal(points).numpy()[:, smooth], gradient[:, smooth], atol=1e-5)


def test_windows_hold_every_hit(life, camera):
    for view in (
        camera,
        camera.crop(30, -20, 50, 60),
        look_at((0.0, -0.9, 0.6), (0, 0, 0.5), fov_x=1.2, width=60, height=40),
    ):
        rays = camera_rays(view, 2)
        everywhere, windowed = trace(life, rays), trace(life, rays, view)
        assert torch.equal(everywhere.owner, windowed.owner)
        assert torch.equal(everywhere.depth, windowed.depth)
    assert window(sphere("", (0.0, -50.0, 0.0), 0.1), camera.crop(0, 0, 10, 10)) is not None  # behind: all of it
    assert window(sphere("", (-60.0, 30.0, 0.5), 0.1), camera) is None


# --- textures -------------------------------------------------------------------------------------------------------


def test_angles_and_cosines():
    turns = torch.linspace(-math.pi + 1e-3, math.pi - 1e-3, 5001)
    assert float((angle(turns.sin(), turns.cos()) - turns).abs().max()) < 2e-5
    assert float((cosine(turns / 2) - (turns / 2).cos()).abs().max()) < 1e-3


def test_noise_is_its_table_on_the_lattice_repeats_and_is_continuous():
    noise = make_noise(torch.Generator().manual_seed(5))
    i, j = torch.arange(-3.0, 3.0), torch.arange(250.0, 256.0)
    assert torch.equal(noise.plane(i, j), noise.at(i, j))
    assert torch.equal(noise.at(i, j), noise.at(i + SIDE, j - SIDE))
    line = torch.linspace(254.0, 258.0, 40001)
    assert float(noise.plane(line, line * 0.7).diff().abs().max()) < 1e-3
    assert float(noise.solid(torch.stack([line, line, line])).diff().abs().max()) < 1e-3


def test_letters():
    """One L of height 6 at the origin: its two bars are ink, its hollow is not."""
    lettering = typeset([Line("L", 6.0, 0.0)])
    u, v = torch.tensor([-2.0, -2.0, 1.9, 0.5, 2.0, -2.6]), torch.tensor([2.9, -2.9, -3.0, 0.0, 2.0, 0.0])
    assert lettering.ink(u, v).tolist() == [True, True, True, False, False, False]


def test_every_letter_is_different_and_nothing_follows_the_last():
    grid = torch.cartesian_prod(torch.linspace(-3.2, 3.2, 33), torch.linspace(-3.6, 3.6, 37)).T
    pictures = {letter: typeset([Line(letter, 6.0, 0.0)]).ink(*grid) for letter in ALPHABET}
    assert len({tuple(picture.tolist()) for picture in pictures.values()}) == len(GLYPHS)
    assert not pictures[" "].any()
    text = typeset([Line("GSX", 6.0, 0.0), Line("LONGER LINE", 6.0, -20.0)])
    row = torch.linspace(-200.0, 200.0, 4001)
    inked = row[text.ink(row, torch.full_like(row, 0.0))]
    assert inked.abs().max() < 3 * 5.9 / 2
    with pytest.raises(KeyError):
        typeset([Line("é", 1.0, 0.0)])


# --- light ----------------------------------------------------------------------------------------------------------


def test_shadow_lies_where_the_sun_is_hidden():
    sun = torch.tensor(SUN) / torch.tensor(SUN).norm()
    ball = sphere("", (0.0, 0.0, 2.0), 0.5)
    middle = torch.tensor([0.0, 0.0, 2.0]) - sun * (2.0 / sun[2])
    across = torch.linalg.cross(sun, torch.tensor([0.0, 0.0, 1.0]))
    across = across / across.norm()
    behind = torch.tensor([0.0, 0.0, 2.0]) + 2.0 * sun
    points = torch.stack([middle, middle + 0.499 * across, middle + 0.501 * across, behind], dim=1)
    light = sunlight(points, (ball,))
    assert light[0] == 0
    assert 0 < light[1] < 1
    assert light[2:].tolist() == [1, 1]


def test_contact_darkens_smoothly_and_only_near_by():
    gap = torch.linspace(0.0, 1.0, 101)
    points = torch.stack([0.5 + gap, torch.zeros(101), torch.zeros(101)])
    light = openness(points, (box("", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)),))
    assert light[0] < 0.7
    assert bool((light.diff() >= 0).all())
    assert bool((light[31:] == 1).all())


def white(p: torch.Tensor, n: torch.Tensor, kit: object) -> torch.Tensor:
    return torch.ones_like(p)


def test_a_white_box_in_the_open(life):
    """Lambert's law on the face that a turn of 30 degrees brings to (1/2, -sqrt(3)/2, 0), and on the top."""
    solid = box("", (0.0, 0.0, 5.0), (2.0, 2.0, 2.0), 30.0)
    sun = np.array(SUN) / np.linalg.norm(SUN)
    normals = np.array([[0.5, -(3**0.5) / 2, 0.0], [0.0, 0.0, 1.0], [-0.5, 3**0.5 / 2, 0.0]])
    points = torch.tensor(normals + solid.centre.numpy()).float().T
    expected = SUNLIGHT * np.maximum(normals @ sun, 0) + SKYLIGHT * (0.8 + 0.2 * normals[:, 2])
    colour = thing_colour(Thing(solid=solid, texture=white), life.kit, points, -points)
    np.testing.assert_allclose(colour, np.tile(expected, (3, 1)), atol=1e-5)


def test_a_highlight_stands_where_the_sun_is_mirrored(life):
    ball, sun = sphere("", (0.0, 0.0, 5.0), 1.0), torch.tensor(SUN) / torch.tensor(SUN).norm()
    points = torch.stack([sun, -sun], dim=1) + torch.tensor([0.0, 0.0, 5.0])[:, None]
    dull, shiny = (
        thing_colour(Thing(solid=ball, texture=white, shine=shine), life.kit, points, -sun[:, None].repeat(1, 2))
        for shine in (0.0, 0.25)
    )
    torch.testing.assert_close((shiny - dull)[0], torch.tensor([0.25, 0.0]), atol=1e-4, rtol=0)


def test_the_highlight_falls_off_with_the_64th_power():
    slant = torch.tensor([0.0, 0.1, 0.3, 2.0])
    halfway = torch.stack([slant.sin(), torch.zeros(4), slant.cos()])
    shine = specular(torch.tensor([[0.0], [0.0], [1.0]]).expand(3, 4), halfway)
    torch.testing.assert_close(shine, slant.cos().clamp(min=0) ** 64, atol=1e-6, rtol=0)


def test_no_solid_that_matters_is_left_out_of_shadows_and_contacts(life, scene):
    """The lists of neighbours of each thing against all other solids, at the scene's own points."""
    points = scene.points.positions.T.contiguous()
    for thing in life.things:
        on = points[:, thing.solid.distance(points).abs() < 1e-4]
        others = tuple(solid for solid in life.solids if solid is not thing.solid)
        assert torch.equal(sunlight(on, thing.shading), sunlight(on, others))
        assert torch.equal(openness(on, thing.near), openness(on, others))
    on_ground = points[:, (points[2].abs() < 1e-4)]
    assert torch.equal(openness(on_ground, life.standing), openness(on_ground, life.solids))


# --- pictures -------------------------------------------------------------------------------------------------------


def test_sample_places_are_even_on_both_axes():
    for count in (1, 5, 8, 13):
        expected = (torch.arange(count) + 0.5) / count
        for axis in lattice(count):
            np.testing.assert_allclose(axis.sort().values, expected)
    assert float(torch.pdist(lattice(8).T).min()) > 0.27  # the closest two of 8: sqrt(5) / 8


@pytest.mark.parametrize(
    "corner", [(0, 0, 96, 72), (13, 7, 31, 29), (95, 71, 1, 1), (-20, -9, 60, 50), (40, 30, 90, 80)]
)
def test_a_crop_is_cut_from_the_picture(life, camera, corner):
    left, top, width, height = corner
    around = render(life, camera.crop(-20, -10, 160, 130), 3)
    expected = around[:, top + 10 : top + 10 + height, left + 20 : left + 20 + width]
    assert torch.equal(render(life, camera.crop(*corner), 3), expected)


def test_a_crop_of_an_odd_camera_is_cut_from_the_picture(life, camera):
    """Principal points with all their bits, another focal length per axis, and a zoom that is no whole number."""
    odd = replace(camera, cx=47.123456789, cy=1e3 / 37, fx=101.1, fy=99.7).zoom(1.37)
    whole = render(life, odd, 2)
    assert torch.equal(render(life, odd.crop(11, 23, 57, 41), 2), whole[:, 23:64, 11:68])


def test_ray_slopes_survive_a_shift():
    """1.5 - cx is a hair above the middle between two float32 numbers; shifted by 1000 px the hair is lost."""
    cx = 0.5 - 2.0**-24 - 2.0**-50
    here, there = (slopes(torch.tensor([1.5 - left]).double(), cx - left, 1.0) for left in (0, 1000))
    assert torch.equal(here, there)
    assert float(here) == pytest.approx(1.0, abs=1e-6)


def test_bands_leave_no_trace(life, camera, monkeypatch):
    whole = render(life, camera, 3)
    monkeypatch.setattr(tracing, "BAND_RAYS", 1000)
    assert torch.equal(render(life, camera, 3), whole)


def test_twice_the_zoom_averages_to_the_picture(life, camera):
    coarse, fine = render(life, camera, 13).double(), render(life, camera.zoom(2), 13).double()
    error = (F.avg_pool2d(fine, 2) - coarse) / 255
    assert -10 * math.log10(float(error.square().mean())) > 38
    assert abs(float(error.mean())) < 1e-3


def high_band(image: torch.Tensor, nyquist: float) -> float:
    """Mean power of the grey picture [3, H, W] at frequencies beyond `nyquist` cycles per pixel on either axis."""
    grey = image.double().mean(0) / 255
    window_ = torch.hann_window(grey.shape[0]).double()[:, None] * torch.hann_window(grey.shape[1]).double()
    power = torch.fft.fft2((grey - grey.mean()) * window_).abs().square()
    rows, columns = (torch.fft.fftfreq(n).abs() for n in grey.shape)
    return float(power[(rows[:, None] > nyquist) | (columns > nyquist)].sum() / grey.numel() ** 2)


def test_zoomed_truth_holds_octaves_that_training_cannot_see(life):
    near = look_at((0.3, -2.4, 1.1), (0.1, 0.0, 0.6), fov_x=0.87, width=80, height=60)
    coarse, fine = render(life, near, 8), render(life, near.zoom(4), 8)
    enlarged = F.interpolate(coarse[None].float(), scale_factor=4, mode="bicubic")[0].clamp(0, 255)
    assert high_band(fine, 1 / 8) > 10 * high_band(enlarged, 1 / 8)
    assert high_band(fine, 1 / 4) > 100 * high_band(enlarged, 1 / 4)


def test_pictures_are_finite_wherever_the_camera_stands(life):
    for eye, target in (
        ((0, 0, 0.0), (1, 0, 0.0)),
        ((-0.95, 0.05, 1.1), (0, 0, 1)),
        ((0, 50.0, 5), (0, 0, 0)),
        ((1, 1, -2.0), (0, 0, 1)),
    ):
        view = look_at(eye, target, fov_x=1.2, width=16, height=12)
        rays = camera_rays(view, 1)
        assert bool(tracing.shade(life, rays, trace(life, rays, view)).isfinite().all())


# --- the scene ------------------------------------------------------------------------------------------------------


def test_options_fill_a_scene(scene):
    assert (len(scene.train), len(scene.test), len(scene.points)) == (8, 4, 2000)
    assert scene.train[0].image().shape == (3, 48, 64)
    assert scene.background.tolist() == pytest.approx([0.80, 0.87, 0.93])
    assert 3 < scene.extent < 6
    assert scene.train[0].source.max_zoom(scene.train[0].camera) == math.inf


def test_cameras_are_distinct_and_see_the_solids_from_outside(life):
    full = load(options(train_views=40, test_views=10, points=40))
    views = [*full.train, *full.test]
    centres = torch.stack([view.camera.centre for view in views])
    assert float(torch.pdist(centres).min()) > 0.05
    clearance = [reference_distance(solid, centres.numpy()).min() for solid in life.solids]
    assert min(clearance) > 0.5
    for view in views:
        owner = trace(life, camera_rays(view.camera, 1), view.camera).owner
        assert 0.1 < float((owner >= 0).float().mean()) < 0.9
        assert len(owner[owner >= 0].unique()) >= 4


def surface_gap(life: StillLife, points: np.ndarray) -> np.ndarray:
    """Distance [P] to the nearest of all surfaces: solids, ground and sky."""
    gaps = [np.abs(reference_distance(solid, points)) for solid in life.solids]
    return np.min([*gaps, np.abs(points[:, 2]), np.abs(np.linalg.norm(points, axis=1) - DOME)], axis=0)


def test_points_lie_on_surfaces(life, scene):
    positions = scene.points.positions.double().numpy()
    assert scene.points.positions.dtype == torch.float32
    assert surface_gap(life, positions).max() < 2e-5
    assert 0.01 < np.mean(np.linalg.norm(positions, axis=1) > DOME - 0.01) < 0.2


def test_each_camera_sees_its_points(scene):
    """2000 points of 8 cameras: the first 250 were cast by the first camera, and fill its picture."""
    camera = scene.train[0].camera
    pixels, depth = camera.project(scene.points.positions[:250].double())
    assert bool((depth > 0.2).all())
    assert float(pixels.min()) > -1e-3
    assert (pixels < torch.tensor(camera.size) + 1e-3).all()
    assert (pixels.max(0).values > 0.95 * torch.tensor(camera.size)).all()


def test_points_have_the_colours_of_the_pictures(life, scene):
    """Those in view of one camera and nearest along their ray, against its picture at four times the resolution."""
    view = scene.train[3].camera.zoom(4)
    picture = render(life, view, 8).double()
    pixels, depth = view.project(scene.points.positions.double())
    inside = (depth > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor(view.size)).all(1)
    pixels, points = pixels[inside], scene.points.positions[inside]
    seen = trace(life, rays_through(view, pixels[:, 0], pixels[:, 1])).depth
    visible = ((points.double() - view.centre).norm(dim=1) - seen).abs() < 1e-3
    column, row = pixels[visible].long().T
    difference = (picture[:, row, column].T - scene.points.colours[inside][visible].double()).abs().mean(1)
    assert int(visible.sum()) > 300
    assert float(difference.median()) < 4
    assert float(difference.quantile(0.9)) < 25


def test_same_options_give_the_same_bytes(scene, cache):
    again = load(options())
    assert torch.equal(again.points.positions, scene.points.positions)
    assert torch.equal(again.points.colours, scene.points.colours)
    assert torch.equal(again.test[1].image(), scene.test[1].image())
    assert not torch.equal(load(options(seed=1)).points.positions, scene.points.positions)


def test_downscaled_training_zooms_back_to_the_native_picture():
    native, halved = load(options(points=8)), load(options(points=8, downscale=2))
    assert halved.train[2].camera.size == (32, 24)
    zoomed = halved.train[2].zoom(2)
    assert zoomed is not None
    assert torch.equal(zoomed.image(), native.train[2].image())


def test_whole_views_are_kept_on_disk_and_crops_are_not(cache):
    first = load(options(points=8)).train[0]
    picture = first.source.image(first.camera)
    first.source.image(first.camera.crop(3, 4, 20, 10))
    assert len(list(cache.rglob("*.png"))) == 1
    first.source.image(first.camera.zoom(2))
    assert len(list(cache.rglob("*.png"))) == 2
    for path in cache.rglob("*.png"):
        path.write_bytes(b"damaged")
    again = load(options(points=8)).train[0]
    assert torch.equal(again.source.image(again.camera), picture)


def test_kept_pictures_are_used(cache, monkeypatch):
    first = load(options(points=8)).train[0]
    picture = first.source.image(first.camera)
    monkeypatch.setattr("gsx.scenes.demo.views.render", lambda *_: pytest.fail("rendered again"))
    again = load(options(points=8)).train[0]
    assert torch.equal(again.source.image(again.camera), picture)


def test_other_samples_are_other_pictures(cache):
    pictures = [load(options(points=8, samples=samples)).train[0].image() for samples in (1, 5)]
    assert not torch.equal(*pictures)


def test_a_cache_that_cannot_be_written_only_costs_time(tmp_path, monkeypatch, caplog):
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("GSX_CACHE", str(tmp_path / "file"))
    view = load(options(points=8)).train[0]
    assert view.image().shape == (3, 48, 64)
    assert "computed again next time" in caplog.text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"test_views": 9}, r"scene\.test_views=9"),
        ({"background": [0.5, 0.0]}, r"scene\.background"),
        *(({"split": f"every:{word}"}, r"scene\.split is 'every:") for word in ("0", "-1", "nan", "8" * 5000)),
        ({"split": "evry:8"}, r"scene\.split is 'evry:8', use one of .*Did you mean 'every:K'"),
    ],
)
def test_options_that_make_no_scene_are_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        load(options(**changes))


def test_sky_and_ground_are_where_they_belong(life):
    level = look_at((0.0, -3.0, 1.0), (0.0, 0.0, 1.0), fov_x=0.8, width=40, height=40)
    owner = trace(life, camera_rays(level, 1), level).owner[0]
    assert bool((owner[0] == SKY).all())
    assert bool((owner[-1] == GROUND).any())
    assert not bool((owner[:15] == GROUND).any())


# --- somebody who passes by -----------------------------------------------------------------------------------------


def test_somebody_stands_before_training_cameras_alone(scene: Scene) -> None:
    """Where the arrangement has the coat, the photograph is red; nobody in test pictures; the points are the same."""
    walked = load(options(passer_by=True))
    shares, seen = [], 0
    for view, empty in zip(walked.train, scene.train, strict=True):
        assert view.camera.draws_as(empty.camera)
        picture, without = view.image(), empty.image()
        shares.append(float(((picture - without).abs().amax(0) > 0.03).float().mean()))
        coat = next(solid for solid in view.source.life.solids if solid.name == "coat")
        pixel, depth = view.camera.project(coat.centre[None].float())
        x, y = pixel[0].long().tolist()
        inside = float(depth) > 0 and 0 <= x < 64 and 0 <= y < 48
        if inside and trace(view.source.life, rays_through(view.camera, *pixel.double().T)).depth > 0.8 * depth:
            red, green, blue = picture[:, y, x].tolist()
            assert red > 2 * max(green, blue)
            seen += 1
    assert seen > 3
    assert 0.05 < sum(shares) / len(shares) < 0.4
    assert len({tuple(view.source.life.solids[-1].centre.tolist()) for view in walked.train}) == len(walked.train)
    for view, empty in zip(walked.test, scene.test, strict=True):
        assert torch.equal(view.image(), empty.image())
    assert torch.equal(walked.points.positions, scene.points.positions)
    assert walked.provenance["passer_by"]
    assert "passer_by" not in scene.provenance
