"""Every backbone in scenes that leave little to learn from: each trains on, finite, and draws finite pictures."""

from dataclasses import replace
from functools import cache

import pytest
import torch
from small_scene import small_scene, spread
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import look_at
from gsx.core.data.scene import Scene, View
from gsx.core.errors import InputError
from gsx.core.quality.losses import photometric
from gsx.core.rasterizer import rasterize
from gsx.core.training.backbone import Backbone, BackboneContext
from gsx.core.training.parameter_table import table_tensors
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import in_units, measured, warned_of_units
from gsx.experiments.runs.settings import Settings

BACKBONES = {
    "gs3d": ("backbone.density.reset_passes=2",),
    "mip_splatting": ("backbone.density.reset_passes=2",),
    "scaffold": (),
    "octree_scaffold": (),
    "octree_gs3d": (),
    "octree_gs3d, clone_split": ("backbone.densification=clone_split",),
}
STEPS = 14
"""Of a run that grows and resets opacities in them: there is an event whenever its two or three views were seen."""


@cache
def composed(name: str) -> Settings:
    """With the rasterizer's loop in fewer turns: many splats lie in each tile."""
    return compose([f"backbone={name.split(',')[0]}", *BACKBONES[name], "rasterizer.chunk=64"], plugins())


def built(name: str, scene: Scene, iterations: int = 30) -> Backbone:
    settings = composed(name)
    context = BackboneContext(
        scene=scene,
        iterations=iterations,
        device=torch.device("cpu"),
        raster=settings.raster,
        generator=torch.Generator().manual_seed(0),
        views=TrainingViews(scene=scene),
    )
    return settings.backbone.component.factory(settings.backbone.options, context)


def trained(backbone: Backbone, scene: Scene) -> list[float]:
    """Losses of a run's steps, in the order of the trainer."""
    losses = []
    for step in range(1, STEPS + 1):
        view = scene.train[step % len(scene.train)]
        drawn = backbone.draw(view.camera, step)
        rendering = rasterize(
            drawn.splats,
            view.camera,
            backbone.raster,
            background=scene.background,
            absolute_gradient=backbone.absolute_gradient,
        )
        loss = photometric(rendering.image, view.image(), 0.2)
        extra = backbone.regulariser(drawn)
        loss = loss if extra is None else loss + extra
        loss.backward()
        backbone.accumulate(backbone.observe(drawn, rendering, step))
        backbone.densify_and_prune(step)
        backbone.update(step)
        losses.append(float(loss.detach()))
    return losses


def one_camera() -> Scene:
    return measured(small_scene(spread(50), extent=0.0, views=1))


def camera_inside() -> Scene:
    scene = small_scene(spread(200), views=2)
    inside = look_at([0.0, 0.0, 0.0], [1.0, 0.2, 0.1], fov_x=0.9, width=24, height=16)
    return replace(scene, train=[View("inside", inside, scene.train[0].source), *scene.train])


def empty_views() -> Scene:
    scene = small_scene(spread(50), views=2)
    away = look_at([0.0, -4.0, 1.0], [0.0, -8.0, 1.0], fov_x=0.9, width=24, height=16)
    return replace(scene, train=[View("away", away, scene.train[0].source), *scene.train])


SCENES = {
    "one point": lambda: small_scene(torch.tensor([[0.1, 0.2, 0.3]]), views=2),
    "all points coincident": lambda: small_scene(torch.ones(20, 3) / 3, views=2),
    "a camera inside the cloud": camera_inside,
    "one camera": one_camera,
    "a view that sees nothing": empty_views,
    "points at a camera": lambda: small_scene(torch.cat([spread(50), torch.tensor([[0.0, -4.0, 1.0]])]), views=2),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", BACKBONES)
def test_training_stays_finite(name: str, scene: str) -> None:
    given = SCENES[scene]()
    backbone = built(name, given, STEPS)
    losses = trained(backbone, given)
    assert all(torch.isfinite(torch.tensor(losses)))
    assert len(backbone.table) >= 1
    for tensor in table_tensors(backbone.table).values():
        assert bool(torch.isfinite(tensor.float()).all())


def careless(count: int, unit: float) -> Scene:
    """The scene of `small_scene` as a reconstruction in other units gives it: every length times `unit`, but near."""
    scene = small_scene(unit * spread(count), extent=2.0 * unit, views=3)
    eyes = [[0.1 * i * unit, -4.0 * unit, unit] for i in range(len(scene.train))]
    cameras = [look_at(eye, [0, 0, 0], fov_x=0.9, width=24, height=16) for eye in eyes]
    views = [replace(view, camera=camera) for view, camera in zip(scene.train, cameras, strict=True)]
    return replace(scene, train=views[1:], test=views[:1])


def picture_after_training(name: str, scene: Scene) -> Tensor:
    """Of a training view."""
    backbone, camera = built(name, scene, STEPS), scene.train[0].camera
    trained(backbone, scene)
    with torch.no_grad():
        return rasterize(backbone.draw(camera, STEPS).splats, camera, backbone.raster).image


@pytest.mark.parametrize("name", BACKBONES)
def test_units_make_no_difference_once_they_are_named(name: str) -> None:
    picture = picture_after_training(name, careless(40, 1.0))
    assert picture.std() > 0.01, "the test needs something to see"
    for unit in (2.0**-10, 2.0**13):  # powers of two: nothing is rounded on the way
        assert torch.equal(picture_after_training(name, in_units(careless(40, unit), 1 / unit)), picture)


def test_units_that_are_not_named_make_a_difference() -> None:
    """The near plane is behind the scene."""
    picture = picture_after_training("gs3d", careless(40, 2.0**-10))
    assert not torch.allclose(picture, picture_after_training("gs3d", careless(40, 1.0)), atol=0.01)


def test_a_unit_multiplies_every_length() -> None:
    scene = in_units(careless(3, 1.0), 3.0)
    assert torch.equal(scene.points.positions, 3 * spread(3))
    assert scene.extent == 6.0
    assert scene.notes == ["positions are multiplied by scene.unit=3"]
    for i, view in enumerate([*scene.test, *scene.train]):
        torch.testing.assert_close(view.camera.centre, torch.tensor([0.3 * i, -12.0, 3.0], dtype=torch.float64))
        assert view.camera.near == 0.2


def test_odd_units_are_noticed() -> None:
    assert not warned_of_units(careless(200, 1.0)).notes
    (small,) = warned_of_units(careless(200, 1e-3)).notes
    assert "near planes hide 100% of the points" in small
    assert "try scene.unit=1000" in small
    (large,) = warned_of_units(careless(200, 1e4)).notes
    assert "the extent is 2e+04 scene units" in large
    assert "try scene.unit=0.0001" in large


def test_one_camera_takes_its_extent_from_the_points() -> None:
    scene = one_camera()
    distance = (scene.points.positions - scene.train[0].camera.centre.float()).norm(dim=1)
    assert scene.extent == pytest.approx(1.1 * float(distance.median()))
    assert "all training cameras stand at one place" in scene.notes[-1]


@pytest.mark.parametrize("name", BACKBONES)
def test_a_scene_without_points_is_refused_with_the_remedy(name: str) -> None:
    with pytest.raises(InputError, match=r"scene 'small' has no points to start from: .*scene\.points=random"):
        built(name, small_scene(torch.zeros(0, 3)))
