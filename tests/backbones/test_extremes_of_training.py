"""Every backbone in scenes that leave little to learn from: each trains on, finite, and draws finite pictures."""

from dataclasses import replace

import pytest
import torch
from small_scene import small_scene, spread

from gsx.cli import plugins
from gsx.core.backbone import Backbone, Beginning
from gsx.core.camera import look_at
from gsx.core.config import compose
from gsx.core.losses import photometric
from gsx.core.rasterizer import rasterize
from gsx.core.scene import Scene, View
from gsx.core.session import in_units, measured, warned_of_units

BACKBONES = {
    "gs3d": (),
    "mip_splatting": (),
    "scaffold": (),
    "octree_scaffold": (),
    "octree_gs3d": (),
    "octree_gs3d, clone_split": ("backbone.densification=clone_split",),
}
STEPS = 30
"""Of a run that grows and prunes several times in them."""


def built(name: str, scene: Scene) -> Backbone:
    settings = compose([f"backbone={name.split(',')[0]}", *BACKBONES[name]], plugins())
    beginning = Beginning(
        scene=scene,
        iterations=STEPS,
        device=torch.device("cpu"),
        raster=settings.raster,
        generator=torch.Generator().manual_seed(0),
    )
    return settings.backbone.component.factory(settings.backbone.options, beginning)


def trained(backbone: Backbone, scene: Scene) -> list[float]:
    """Losses of a run's steps, in the order of the trainer."""
    losses = []
    for step in range(1, STEPS + 1):
        view = scene.train[step % len(scene.train)]
        backbone.begin(step)
        rendering = rasterize(
            backbone.splats(view.camera),
            view.camera,
            backbone.raster,
            background=scene.background,
            absolute_gradient=backbone.absolute_gradient,
        )
        loss = photometric(rendering.image, view.image(), 0.2)
        extra = backbone.regulariser()
        loss = loss if extra is None else loss + extra
        loss.backward()
        backbone.record(backbone.observe(rendering, step))
        backbone.adapt(step)
        backbone.update()
        losses.append(float(loss.detach()))
    return losses


def one_camera() -> Scene:
    scene = small_scene(spread(50), extent=0.0)
    return measured(replace(scene, train=scene.train[:1]))


def camera_inside() -> Scene:
    scene = small_scene(spread(200))
    inside = look_at([0.0, 0.0, 0.0], [1.0, 0.2, 0.1], fov_x=0.9, width=24, height=16)
    return replace(scene, train=[View("inside", inside, scene.train[0].source), *scene.train])


def empty_views() -> Scene:
    scene = small_scene(spread(50))
    away = look_at([0.0, -4.0, 1.0], [0.0, -8.0, 1.0], fov_x=0.9, width=24, height=16)
    return replace(scene, train=[View("away", away, scene.train[0].source), *scene.train])


SCENES = {
    "one point": lambda: small_scene(torch.tensor([[0.1, 0.2, 0.3]])),
    "all points coincident": lambda: small_scene(torch.ones(20, 3) / 3),
    "a camera inside the cloud": camera_inside,
    "one camera": one_camera,
    "a view that sees nothing": empty_views,
    "points at a camera": lambda: small_scene(torch.cat([spread(50), torch.tensor([[0.0, -4.0, 1.0]])])),
}


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("name", BACKBONES)
def test_training_stays_finite(name: str, scene: str) -> None:
    given = SCENES[scene]()
    backbone = built(name, given)
    losses = trained(backbone, given)
    assert all(torch.isfinite(torch.tensor(losses)))
    assert backbone.size()[0] >= 1
    for tensor in backbone.tensors().values():
        assert bool(torch.isfinite(tensor.float()).all())


def measured_in(scene: Scene, unit: float) -> Scene:
    """The same scene with lengths in other units, as a careless reconstruction gives them."""
    return in_units(scene, unit)


@pytest.mark.parametrize("unit", [2.0**-10, 2.0**13])  # powers of two: nothing is rounded on the way
@pytest.mark.parametrize("name", BACKBONES)
def test_units_make_no_difference_once_they_are_named(name: str, unit: float) -> None:
    scene = small_scene(spread(40), extent=2.0)
    other = in_units(measured_in(scene, unit), 1 / unit)
    pictures = []
    for given in (scene, other):
        backbone = built(name, given)
        trained(backbone, given)
        camera = given.train[0].camera
        with torch.no_grad():
            pictures.append(rasterize(backbone.splats(camera), camera, backbone.raster).image)
    assert torch.equal(pictures[1], pictures[0])


def test_odd_units_are_noticed() -> None:
    scene = small_scene(spread(200), extent=2.0)
    assert not warned_of_units(scene).notes
    (small,) = warned_of_units(replace(measured_in(scene, 1e-3), notes=[])).notes
    assert "near planes hide 100% of the points" in small
    assert "try scene.unit=1000" in small
    (large,) = warned_of_units(replace(measured_in(scene, 1e4), notes=[])).notes
    assert "the extent is 2e+04 scene units" in large
    assert "try scene.unit=0.0001" in large


def test_one_camera_takes_its_extent_from_the_points() -> None:
    scene = one_camera()
    distance = (scene.points.positions - scene.train[0].camera.centre.float()).norm(dim=1)
    assert scene.extent == pytest.approx(1.1 * float(distance.median()))
    assert "all training cameras stand at one place" in scene.notes[-1]
