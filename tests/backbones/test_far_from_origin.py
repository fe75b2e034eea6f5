"""A scene 1e6 from the origin is the scene at the origin: levels, colours, networks and pictures, against float64.

Positions are multiples of 1/16, which float32 holds there too; cameras stand anywhere.
"""

from dataclasses import replace

import pytest
import torch
from small_scene import small_scene
from test_extremes_of_training import built
from torch import Tensor

from gsx.backbones.anchors import Anchors
from gsx.backbones.clone_split import VisibleByLevel
from gsx.backbones.gs3d import GS3D
from gsx.backbones.levels import distance_range, drawn, drawn_fraction, viewpoints_of
from gsx.backbones.mip import filter_sizes
from gsx.core.data.camera import Camera, offsets_from
from gsx.core.data.scene import Scene
from gsx.core.gaussians.sh import colours_of
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import rasterize

FAR = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
STEP = 30
"""All harmonics take part, and all levels."""
BACKBONES = ("gs3d", "mip_splatting", "scaffold", "octree_scaffold", "octree_gs3d", "octree_gs3d, clone_split")


def near_scene() -> Scene:
    """Points in a cube of edge 2 and three cameras around 4 units away."""
    points = (torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * 32).round() / 16 - 1
    return small_scene(points, extent=2.0)


def moved(camera: Camera) -> Camera:
    return replace(camera, translation=camera.translation - camera.rotation @ FAR)


def pair(name: str) -> tuple[GS3D | Anchors, GS3D | Anchors, Camera]:
    """(backbone, the same with every position moved far away, a camera of the first), stirred so that views differ."""
    near, far, generator = built(name, near_scene()), built(name, near_scene()), torch.Generator().manual_seed(3)
    assert isinstance(near, GS3D | Anchors)
    assert isinstance(far, GS3D | Anchors)
    place = "means" if isinstance(near, GS3D) else "anchors"
    with torch.no_grad():
        near.table[place].copy_((near.table[place] * 16).round() / 16)  # anchors are nodes of a grid of their own
        for key, parameter in near.table.parameters.items():
            if key in ("features", "sh_rest", "sh_dc"):
                parameter.normal_(generator=generator)
        for key, parameter in far.table.parameters.items():
            parameter.copy_(near.table[key])
        far.table[place].copy_((near.table[place].double() + FAR).float())
    assert torch.equal(far.table[place].double() - FAR, near.table[place].double())
    return near, far, cameras_of(near_scene())[1]


def cameras_of(scene: Scene) -> list[Camera]:
    return [view.camera for view in scene.train]


def splats_of_both(name: str) -> tuple[Splats, Splats, GS3D | Anchors, Camera]:
    near, far, camera = pair(name)
    with torch.no_grad():
        return near.draw(camera, STEP).splats, far.draw(moved(camera), STEP).splats, near, camera


@pytest.mark.parametrize("name", BACKBONES)
def test_everything_but_the_place_stays(name: str) -> None:
    """The same Gaussians of the same levels, with the same colours, sizes and opacities; the same picture."""
    near, far, backbone, camera = splats_of_both(name)
    assert len(near) > 20
    for field in ("scales", "quats", "log_opacities", "colours"):
        torch.testing.assert_close(getattr(far, field), getattr(near, field), rtol=1e-5, atol=1e-6, msg=field)
    if isinstance(backbone, Anchors):  # offsets of anchors are rounded to the grain of places there
        near = replace(near, means=(far.means.double() - FAR).float())
    pictures = [rasterize(s, c, backbone.raster).image.detach() for s, c in ((near, camera), (far, moved(camera)))]
    torch.testing.assert_close(pictures[1], pictures[0], rtol=0, atol=2e-5)
    assert float(pictures[0].std()) > 0.01


def double_colours(backbone: GS3D, means: Tensor, camera: Camera) -> Tensor:
    """Colours worked out in float64 throughout."""
    constant, rest = (backbone.table[name].detach().double() for name in ("sh_dc", "sh_rest"))
    return colours_of(constant, rest, means - camera.centre, backbone.active_degree(STEP))


def test_harmonics_and_their_gradients_are_those_of_float64() -> None:
    _, far, camera = pair("gs3d")
    assert isinstance(far, GS3D)
    assert far.active_degree(STEP) == 3
    colours = far.draw(moved(camera), STEP).splats.colours
    weights = torch.rand(60, 3, generator=torch.Generator().manual_seed(1))
    (gradient,) = torch.autograd.grad((colours * weights).sum(), far.table["means"])
    means = (far.table["means"].detach().double() - FAR).requires_grad_()
    truth = double_colours(far, means, camera)
    (wanted,) = torch.autograd.grad((truth * weights).sum(), means)
    torch.testing.assert_close(colours.detach().double(), truth.detach(), rtol=0, atol=2e-6)
    torch.testing.assert_close(gradient.double(), wanted, rtol=1e-4, atol=1e-5)


def test_networks_see_the_direction_of_float64() -> None:
    near, far, camera = pair("scaffold")
    assert isinstance(near, Anchors)
    assert near.table.networks is not None
    anchors = far.table["anchors"].double() - FAR
    with torch.no_grad():
        shown = near.visible(camera, STEP).rows
        heads = near.table.networks.modules.double()
        truth = heads(near.table["features"].double()[shown], (anchors - camera.centre)[shown], anchors[shown, :1], -1)
        colours = far.draw(moved(camera), STEP).splats.colours
    chosen = truth[0].flatten() > 0
    torch.testing.assert_close(colours.double(), truth[2].reshape(-1, 3)[chosen], rtol=0, atol=2e-6)


def test_levels_and_filters_have_the_distances_of_float64() -> None:
    """Primitives stand just within and just beyond the distance at which their level begins."""
    near = built("octree_gs3d, clone_split", near_scene())
    assert isinstance(near, GS3D)
    assert isinstance(near.visibility, VisibleByLevel)
    means = near.table["means"].detach()
    means = (means * 16).round() / 16
    away = (means.double() + FAR).float()
    far_cameras = [moved(camera) for camera in cameras_of(near_scene())]
    views, far_views = viewpoints_of(cameras_of(near_scene())), viewpoints_of(far_cameras)
    assert distance_range(away, far_views, 0.9) == pytest.approx(distance_range(means, views, 0.9), rel=1e-6)
    camera, of = cameras_of(near_scene())[2], near.table["level"]
    levels = replace(near.visibility.levels, mode="floor", half_cell=False, views=views)
    ideal = (levels.farthest / (means.double() - camera.centre).norm(dim=1)).log2()
    within = torch.arange(len(means)) % 2 == 0
    bias = (1 - ideal + torch.where(within, 1e-4, -1e-4)).float()  # level 1 begins 1e-4 of a level away
    ones = torch.ones_like(of)
    for places, mapped_to, at in ((means, camera, views), (away, moved(camera), far_views)):
        shown, _ = drawn(replace(levels, views=at), places, ones, bias, mapped_to, levels.count - 1)
        assert torch.equal(shown, within)
    shares = [drawn_fraction(replace(levels, views=v), p, of) for v, p in ((views, means), (far_views, away))]
    assert torch.equal(shares[1], shares[0])
    torch.testing.assert_close(
        filter_sizes(away, far_cameras, near.options.mip),
        filter_sizes(means, cameras_of(near_scene()), near.options.mip),
    )


def test_offsets_are_rounded_once() -> None:
    points = torch.tensor([[1e6, 0.0, -1e6], [16777216.0, 1.0, 0.1]])
    centre = torch.tensor([1e6 - 1e-3, 0.25, -1e6 + 0.0625], dtype=torch.float64)
    wanted = [[1e-3, -0.25, -0.0625], [15777216.001, 0.75, 1e6 - 0.0625 + float(points[1, 2])]]
    torch.testing.assert_close(offsets_from(points, centre), torch.tensor(wanted), rtol=1e-6, atol=0)
