"""Pictures of a viewer: a model from anywhere, by the rasterizer that trained it, alone or next to something else."""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.gaussians.splats import Gaussians, Splats, splats_of
from gsx.core.quality.metrics import bicubic
from gsx.core.rasterizer import RasterSettings, rasterize_tiled
from gsx.core.shapes import Bool, Float
from gsx.core.training.render import render, splats_for
from gsx.core.training.run import Run
from gsx.experiments.viewer.camera_path import posed
from gsx.formats.origin import NO_ORIGIN, Origin

COMPARED_WITH = ("nothing", "photograph", "error", "x1, enlarged")
"""Right part of the picture: the photo of the view that the user jumped to, the error of the render, or the same
camera at the resolution of the photos, enlarged."""
FILTERS = ("as trained", "plain 3D-GS", "compensated")
"""Screen filters: the model's own, dilation by 0.3 px^2 without and with compensated opacities."""
ERROR_GAIN = 4.0
"""Factor on errors."""


@dataclass(frozen=True)
class Pose:
    """Camera and canvas size of a browser."""

    position: tuple[float, float, float]
    wxyz: tuple[float, float, float, float]
    """Camera to world; x right, y down, z ahead."""
    fov: float
    """Vertical field of view, radians."""
    width: int
    height: int


@dataclass(frozen=True)
class Look:
    """Settings of the picture in a panel."""

    zoom: float = 1.0
    compared_with: str = "nothing"
    split: float = 0.5
    """Share of the width at which the right picture begins."""
    filter: str = "as trained"
    finer_levels: float = 0.0
    """Levels of detail of a camera that is 2^this times as fine."""
    box: float = 1.0
    """Half edge of the cube about the scene's middle outside of which nothing is drawn, of its extent; 1: no cube."""
    view: str = ""
    """Name of the view that the user jumped to and has not left."""


def camera_of(pose: Pose, width: int, zoom: float = 1.0) -> Camera:
    """Returns the pinhole camera of a pose on a raster of that width, its field of view narrowed by `zoom`."""
    height = max(1, round(width * pose.height / pose.width))
    return posed(pose.position, pose.wxyz, 2 * math.atan(math.tan(pose.fov / 2) / zoom), width, height)


@dataclass(eq=False)
class RunModel:
    """The model of a run, as it is now."""

    run: Run

    @property
    def origin(self) -> Origin:
        """Return what is added to positions for the coordinates of the scene's files."""
        return self.run.scene.origin

    def drawn(self, camera: Camera, look: Look) -> Float[Tensor, "3 H W"]:
        """Renders the model alone."""
        splats = splats_for(self.run, camera.zoom(2.0**look.finer_levels))
        rendered = inside(splats, self.middle(), look.box * self.run.scene.extent) if look.box < 1 else splats
        return render(replace(self.run, raster=filtered(self.run.raster, look.filter)), camera, splats=rendered).image

    def middle(self) -> Float[Tensor, "3"]:
        """Returns the median of the initial points, or of the cameras."""
        points = self.run.scene.points.positions
        centres = torch.stack([view.camera.centre for view in self.run.scene.train]).float()
        return (points if len(points) else centres).median(0).values

    @property
    def focal(self) -> float:
        """Returns the focal length of the photos, px per px of their height."""
        camera = self.run.scene.train[0].camera
        return camera.fy / camera.height

    @property
    def height(self) -> int:
        """Returns the height of the photos, px."""
        return self.run.scene.train[0].camera.height

    def views(self) -> dict[str, View]:
        """Returns training and test views by name."""
        return {view.name: view for view in (*self.run.scene.test, *self.run.train_views)}


@dataclass(eq=False)
class FileModel:
    """The splats of a file."""

    gaussians: Gaussians
    raster: RasterSettings
    origin: Origin = NO_ORIGIN
    """Added to positions for the coordinates of the file."""
    height: int = 480
    """Assumed height of photos, px."""
    focal: float = 0.5
    """Assumed focal length, px per px of height."""

    @torch.no_grad()
    def drawn(self, camera: Camera, look: Look) -> Float[Tensor, "3 H W"]:
        """Renders the model alone, over black."""
        splats = splats_of(self.gaussians, camera.centre)
        rendered = inside(splats, self.middle(), look.box * self.reach()) if look.box < 1 else splats
        raster = filtered(self.raster, look.filter)
        return rasterize_tiled(rendered, camera, raster, background=torch.zeros(3)).image.clamp_(0, 1)

    def reach(self) -> float:
        """Returns the 0.9 quantile of distances from the middle."""
        far = (self.gaussians.means - self.middle()).norm(dim=1)
        return float(far.kthvalue(max(1, round(0.9 * len(far)))).values)

    def middle(self) -> Float[Tensor, "3"]:
        """Returns the median of the splats."""
        return self.gaussians.means.median(0).values

    def views(self) -> dict[str, View]:
        """Returns no views."""
        return {}


Model = RunModel | FileModel


def filtered(raster: RasterSettings, name: str) -> RasterSettings:
    """Returns rules of the rasterizer with another screen filter; eager, since compiling would delay one picture."""
    if name == "as trained":
        return raster
    return replace(raster, dilation=0.3, compensate=name == "compensated", zoomed="plain", pixel="sample", path="eager")


def inside(splats: Splats, middle: Float[Tensor, "3"], reach: float) -> Splats:
    """Selects the splats in a cube."""
    kept = ((splats.means - middle.to(splats.means)).abs() <= reach).all(1)
    return Splats(**{name: value[kept] for name, value in vars(splats).items()})


def picture(model: Model, pose: Pose, look: Look, width: int) -> Float[Tensor, "3 H W"]:
    """Renders the picture for a browser."""
    camera = camera_of(pose, width, look.zoom)
    rendered = model.drawn(camera, look)
    if look.compared_with == "x1, enlarged":
        return split(rendered, enlarged(model, pose, look, rendered), look.split)
    view = model.views().get(look.view) if look.compared_with != "nothing" else None
    if view is None:
        return rendered
    photo, covered = placed(view.image().to(rendered), view.camera, camera)
    other = photo if look.compared_with == "photograph" else (ERROR_GAIN * (photo - rendered).abs()).clamp_(0, 1)
    return split(rendered, torch.where(covered, other, rendered), look.split)


def split(left: Float[Tensor, "3 H W"], right: Float[Tensor, "3 H W"], at: float) -> Float[Tensor, "3 H W"]:
    """Joins two pictures at a share of the width, with a white line between."""
    column = round(at * left.shape[2])
    joined = torch.cat([left[..., :column], right[..., column:]], 2)
    joined[..., max(0, column - 1) : column] = 1
    return joined


def enlarged(model: Model, pose: Pose, look: Look, like: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Renders the same camera at the resolution of the photos, and enlarges it by Keys bicubic."""
    per_pixel = 2 * math.tan(pose.fov / 2) * model.focal
    height = max(2, round(model.height * per_pixel / look.zoom))
    small = camera_of(pose, max(2, round(height * pose.width / pose.height)), look.zoom)
    return bicubic(model.drawn(small, look), like.shape[2], like.shape[1])


def placed(
    photo: Float[Tensor, "3 h w"], taken_by: Camera, camera: Camera
) -> tuple[Float[Tensor, "3 H W"], Bool[Tensor, "H W"]]:
    """Resamples a photo to a camera at the same place; returns (picture, pixels that it covers)."""
    scale = camera.fy / taken_by.fy
    columns = (torch.arange(camera.width).to(photo) + 0.5 - camera.cx) * (taken_by.fx / camera.fx) + taken_by.cx
    rows = (torch.arange(camera.height).to(photo) + 0.5 - camera.cy) / scale + taken_by.cy
    places = torch.stack(torch.meshgrid(columns, rows, indexing="xy"), -1)
    if taken_by.lens is not None:
        places = through_lens(places, taken_by)
    grid = 2 * (places / places.new_tensor(taken_by.size)) - 1
    smaller = photo[None]
    if scale < 1:  # averaged first, so that it does not alias
        size = [max(1, round(side * scale)) for side in photo.shape[1:]]
        smaller = interpolate(smaller, size, mode="bicubic", antialias=True).clamp(0, 1)
    sampled = grid_sample(smaller, grid[None], padding_mode="border", align_corners=False)
    return sampled[0], (grid.abs() <= 1).all(-1)


def through_lens(places: Float[Tensor, "H W 2"], camera: Camera) -> Float[Tensor, "H W 2"]:
    """Moves places of a pinhole's picture, px, to where the camera's lens shows them; far outside: it does not."""
    assert camera.lens is not None
    focal, centre = places.new_tensor([camera.fx, camera.fy]), places.new_tensor([camera.cx, camera.cy])
    rays = torch.nn.functional.pad((places - centre) / focal, (0, 1), value=1.0)
    return (camera.lens.bend(rays.flatten(0, 1)).view_as(places) * focal + centre).nan_to_num(-1e9)
