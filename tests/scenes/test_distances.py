"""The still life from mixed distances: where cameras stand, what they show; even distances stay as they were."""

import math
from dataclasses import replace

import pytest
import torch

from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import Scene, View
from gsx.core.errors import ConfigError
from gsx.experiments.runs.compose import compose
from gsx.scenes.demo import DemoOptions, load
from gsx.scenes.demo.cameras import far_camera, mixed_cameras, near_camera, spiral_camera
from gsx.scenes.demo.still_life import make_still_life
from gsx.scenes.demo.tracing import camera_rays, shade, trace

SMALL = ("scene=demo", "scene.width=64", "scene.height=48", "scene.points=400", "scene.samples=1")
FAR, NEAR = torch.tensor([0.0, 0.05, 0.5]), torch.tensor([0.5, -0.1, 0.55])


@pytest.fixture(scope="module")
def even() -> DemoOptions:
    chosen = compose(list(SMALL), plugins()).scene.options
    assert isinstance(chosen, DemoOptions)
    return chosen


@pytest.fixture(scope="module")
def mixed(even: DemoOptions) -> Scene:
    return load(replace(even, distances="mixed"))


def by_group(views: list[View], group: str) -> list[View]:
    return [view for view in views if view.group == group]


def test_most_cameras_stand_far_a_few_near_and_test_cameras_between_them(mixed: Scene) -> None:
    for views, counts in ((mixed.train, (35, 5)), (mixed.test, (8, 2))):
        assert tuple(len(by_group(views, group)) for group in ("far", "near")) == counts
        for group, target, distance in (("far", FAR, 9.9), ("near", NEAR, 1.9)):
            for view in by_group(views, group):
                assert float((view.camera.centre - target).norm()) == pytest.approx(distance, abs=1e-4)
                pixel, depth = view.camera.project(target[None])
                assert pixel[0].tolist() == pytest.approx([32, 24], abs=1e-3)
                assert float(depth) == pytest.approx(distance, abs=1e-4)
    names = [view.name for view in [*mixed.train, *mixed.test]]
    assert len(set(names)) == 50
    assert {view.camera.size for view in [*mixed.train, *mixed.test]} == {(64, 48)}


def azimuth(view: View, target: torch.Tensor) -> float:
    x, y = (view.camera.centre - target)[:2].tolist()
    return math.degrees(math.atan2(y, x))


def test_test_cameras_stand_half_way_between_neighbours(mixed: Scene) -> None:
    """Neighbours on the spiral are 3 x 360 / 35 degrees apart, on the arc 75 / 5; the first ones by hand."""
    turn = 3 * 360 / 35
    assert azimuth(by_group(mixed.train, "far")[0], FAR) == pytest.approx(-90, abs=1e-3)
    assert azimuth(by_group(mixed.train, "far")[1], FAR) == pytest.approx(-90 + turn, abs=1e-3)
    assert azimuth(by_group(mixed.test, "far")[0], FAR) == pytest.approx(-90 + turn / 2, abs=1e-3)
    near = [azimuth(view, NEAR) for view in by_group(mixed.train, "near")]
    assert near == pytest.approx([-145, -130, -115, -100, -85], abs=1e-3)
    assert [azimuth(view, NEAR) for view in by_group(mixed.test, "near")] == pytest.approx([-137.5, -107.5], abs=1e-3)


def solids_in(camera: Camera) -> set[str]:
    """The solids that at least 3 of 64 x 48 rays hit."""
    life = make_still_life()
    owners = trace(life, camera_rays(camera, 1), camera).owner.flatten()
    return {solid.name for number, solid in enumerate(life.solids) if int((owners == number).sum()) >= 3}


def test_near_photographs_show_the_chart_and_none_the_tree(mixed: Scene) -> None:
    shown = [solids_in(view.camera) for view in by_group([*mixed.train, *mixed.test], "near")]
    assert all({"board", "crate", "beach ball"} <= names for names in shown)
    assert not any({"crown", "pot", "trunk"} & names for names in shown)
    far = set.union(*(solids_in(view.camera) for view in by_group(mixed.train, "far")))
    assert {"crown", "pot", "wall", "board", "crate", "tin", "beach ball", "marble"} <= far


def test_near_photographs_have_the_detail_of_a_far_one_zoomed_in_by_5() -> None:
    far, near = far_camera(0.0, 320, 240), near_camera(0.5, 320, 240)
    densities = [float(camera.fx / camera.project(NEAR[None])[1]) for camera in (far, near)]
    assert densities[1] / densities[0] == pytest.approx(9.9 / 1.9, rel=0.03)  # NEAR is 0.14 nearer than the target


def test_near_cameras_stand_outside_of_things(mixed: Scene) -> None:
    solids = make_still_life().solids
    for view in by_group([*mixed.train, *mixed.test], "near"):
        centre = view.camera.centre.double()[:, None]
        assert min(float(solid.distance(centre)) for solid in solids) > 0.5


def test_each_camera_sees_its_points(mixed: Scene) -> None:
    """400 points of 40 cameras: ten of each, in the order of the training views."""
    positions = mixed.points.positions.double()
    for number, view in enumerate(mixed.train):
        pixels, depth = view.camera.project(positions[10 * number : 10 * number + 10])
        assert bool((depth > 0.2).all())
        assert float(pixels.min()) > -1e-2
        assert bool((pixels < torch.tensor(view.camera.size) + 1e-2).all())


@pytest.mark.parametrize("group", ["far", "near"])
def test_truth_at_x8_is_the_picture_cast_at_that_size(even: DemoOptions, group: str) -> None:
    scene = load(replace(even, distances="mixed", width=16, height=12, points=40))
    view = by_group(scene.test, group)[0]
    place, camera_at = {"far": (0.5 / 35, far_camera), "near": (0.5 / 5, near_camera)}[group]
    camera, life = camera_at(place, 128, 96), make_still_life()
    rays = camera_rays(camera, 1)
    expected = (shade(life, rays, trace(life, rays))[:, 0] * 255 + 0.5).to(torch.uint8)
    zoomed = view.zoom(8)
    assert zoomed is not None
    assert torch.equal(zoomed.picture(), expected)
    assert len(expected.unique()) > 50


def test_even_distances_are_as_before_the_option(even: DemoOptions) -> None:
    """The first camera by hand: 2.65 units away, 8 degrees up, in front; provenance has no new key."""
    scene = load(even)
    eye = (0.0, 0.05 - 2.65 * math.cos(math.radians(8)), 0.5 + 2.65 * math.sin(math.radians(8)))
    by_hand = look_at(eye, tuple(FAR.tolist()), fov_x=math.radians(50), width=64, height=48)
    first = scene.train[0].camera
    assert torch.allclose(first.rotation, by_hand.rotation, atol=1e-6)
    assert torch.allclose(first.translation, by_hand.translation, atol=1e-6)
    assert scene.provenance == {
        "format": "demo", "version": "e26aec382d8f4c08", "size": [64, 48], "samples": 1, "light": "display",
        "split": "40 on a spiral, 10 between them",
    }  # fmt: skip
    assert [view.name for view in scene.train[:2]] == ["train_000", "train_001"]
    assert {view.group for view in [*scene.train, *scene.test]} == {""}
    assert torch.equal(scene.test[0].camera.translation, spiral_camera(0.5 / 40, 64, 48).translation)
    assert scene.notes == []


def test_provenance_states_mixed_distances(mixed: Scene, even: DemoOptions) -> None:
    assert mixed.provenance["split"] == "35 far on a spiral, 5 near on an arc, 8 and 2 between them"
    trained = load(replace(even, distances="mixed", split="none", points=40))
    assert (len(trained.train), len(trained.test)) == (50, 0)
    assert trained.provenance["split"].endswith("between them, all trained on")


def test_somebody_stands_before_near_and_far_cameras(even: DemoOptions) -> None:
    walked = load(replace(even, distances="mixed", passer_by=True, points=40))
    for view in walked.train:
        coat = next(solid for solid in view.source.life.solids if solid.name == "coat")
        ahead = float((coat.centre[:2] - view.camera.centre[:2]).norm())
        assert 0.3 < ahead < 2.4, view.name


def test_bad_options_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"scene\.distances is 'mixd', use one of even, mixed.*Did you mean 'mixed'"):
        compose([*SMALL, "scene.distances=mixd"], plugins())
    with pytest.raises(ConfigError, match=r"mixed needs 8 training views.*scene\.train_views=7: set at least"):
        mixed_cameras(7, 2, (64, 48))
    with pytest.raises(ConfigError, match="distances"):
        compose(["scene=room", "scene.distances=mixed"], plugins())


@pytest.mark.parametrize(("train", "test"), [(8, 1), (8, 8), (15, 15), (16, 16), (40, 40), (41, 7)])
def test_test_cameras_are_distinct_at_any_count(train: int, test: int) -> None:
    cameras = mixed_cameras(train, test, (64, 48))
    for of_role, count in ((cameras.train, train), (cameras.test, test)):
        assert len(of_role["far"]) + len(of_role["near"]) == count
        assert of_role["far"]
    centres = torch.stack(
        [camera.centre for one in (cameras.train, cameras.test) for g in one.values() for camera in g]
    )
    assert float(torch.pdist(centres).min()) > 0.05
