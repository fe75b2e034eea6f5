"""Every extreme that the rasterizer must bear, as a named case: a few splats and a camera.

Lengths are in scene units. The scene is a ball of radius about 1 around the origin unless a case says otherwise.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid, normalize

from gsx.core.data.camera import Camera, look_at
from gsx.core.gaussians.splats import Splats

IMAGE, GRADIENT = 1e-4, 1e-4
"""The usual bounds of float32: on the image, and on the relative error of a field's gradient."""


def scientific(number: float, digits: int = 0) -> str:
    """A number in scientific notation, 2e-3; 0 as it is."""
    return f"{number:.{digits}e}".replace("e-0", "e-") if number else "0"


Make = Callable[[], tuple[Splats, Camera]]


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """One extreme and what is promised of it."""

    name: str
    make: Make
    rules: Mapping[str, object] = field(default_factory=dict)
    """Settings that are not the defaults."""
    image: float = IMAGE
    """Largest float32 image error, colours being in [0, 1]."""
    gradient: float = GRADIENT
    """Largest relative float32 gradient error of a field."""
    why: str = ""
    """The reason for a wider bound."""
    tolerance: float = 1e-5
    """Relative distance to a threshold within which float32 may decide either way."""
    undecided: float = 0.01
    """Largest share of pixels at a threshold, which float32 may pass or not."""
    dropped: int = 0
    """The first so many splats are left out and counted in float32."""
    dropped_in_float64: int = 0
    drawn: bool = True
    """Something is to be seen."""
    refused: str = ""
    """Part of the message with which the case is refused; empty: it is rendered."""

    def dropped_in(self, dtype: torch.dtype) -> int:
        return self.dropped if dtype == torch.float32 else self.dropped_in_float64

    @property
    def happens(self) -> str:
        """What happens, in words."""
        if self.refused:
            return "refused by name"
        if self.dropped:
            return f"{self.dropped} splats dropped and counted, the others exact"
        if not self.drawn:
            return "nothing to draw"
        if self.image == IMAGE and self.gradient == GRADIENT:
            return f"exact; {self.why}" if self.why else "exact"
        return f"bounded by {scientific(self.image)}, gradient {scientific(self.gradient)}: {self.why}"


CASES: list[Case] = []


def case(name: str, **promise: object) -> Callable[[Make], Make]:
    """Register a function as the case `name`."""

    def register(make: Make) -> Make:
        CASES.append(Case(name=name, make=make, **promise))
        return make

    return register


# -- building blocks ---------------------------------------------------------------------------------------------------


def ball(count: int = 24, seed: int = 0, *, size: float = 0.15, opacity: float = 0.7) -> Splats:
    """`count` anisotropic splats, standard deviations around `size`."""
    g = torch.Generator().manual_seed(seed)
    return Splats(
        means=0.5 * torch.randn(count, 3, generator=g).clamp(-2, 2),
        scales=size * torch.exp(0.6 * torch.randn(count, 3, generator=g)),
        quats=torch.randn(count, 4, generator=g),
        log_opacities=(opacity * (0.6 + 0.4 * torch.rand(count, generator=g))).log(),
        colours=torch.rand(count, 3, generator=g),
    )


def view(width: int = 96, height: int = 72) -> Camera:
    """A camera about 4 units from the origin, looking at it."""
    return look_at([0.3, -4, 1], [0, 0, 0], fov_x=0.7, width=width, height=height)


def along_y(width: int = 64, height: int = 64, *, fov_x: float = 0.7) -> Camera:
    """At the origin, looking along +y; x is right and z up. Its axes are exact: depth is y."""
    return look_at([0, 0, 0], [0, 1, 0], fov_x=fov_x, width=width, height=height)


def before(splats: Splats, depth: float = 4.0) -> Splats:
    """The ball moved to `depth` before `along_y`."""
    return replace(splats, means=splats.means + torch.tensor([0.0, depth, 0.0]))


def scaled(splats: Splats, factor: float) -> Splats:
    return replace(splats, scales=splats.scales * factor)


def shrunk(splats: Splats, factor: float) -> Splats:
    return replace(splats, scales=splats.scales * factor, means=splats.means * factor)


def with_opacity(splats: Splats, opacity: float) -> Splats:
    return replace(splats, log_opacities=torch.full((len(splats),), math.log(opacity)))


def with_logits(splats: Splats, logits: Tensor) -> Splats:
    return replace(splats, log_opacities=logsigmoid(logits))


def rows(splats: Splats, chosen: slice | Tensor) -> Splats:
    return Splats(**{name: value[chosen] for name, value in vars(splats).items()})


def unprojected(camera: Camera, pixels: Tensor, depths: Tensor) -> Tensor:
    """World points that project to `pixels` [N 2] at `depths` [N]."""
    slopes = (pixels - torch.tensor([camera.cx, camera.cy])) / torch.tensor([camera.fx, camera.fy])
    points = depths[:, None] * torch.cat([slopes, torch.ones_like(slopes[:, :1])], 1)
    return ((points - camera.translation) @ camera.rotation).float()


def spread_over(splats: Splats, camera: Camera, seed: int = 1) -> Splats:
    """Splats at random places of the raster, 4 to 5 units deep."""
    g = torch.Generator().manual_seed(seed)
    pixels = torch.rand(len(splats), 2, generator=g, dtype=torch.float64) * torch.tensor(camera.size)
    return replace(splats, means=unprojected(camera, pixels, 4 + torch.rand(len(splats), generator=g)))


# -- standard deviations -----------------------------------------------------------------------------------------------

for power in (-8, -4, -2, 0, 2, 4):

    @case(f"scales 1e{power} of the scene")
    def scales(factor: float = 10.0**power) -> tuple[Splats, Camera]:
        return scaled(ball(size=1.0, opacity=0.3), factor), view()


@case("scales from 1e-8 to 1e4 in one picture")
def mixed_scales() -> tuple[Splats, Camera]:
    splats = ball(size=1.0, opacity=0.3)
    return replace(splats, scales=splats.scales * 10.0 ** torch.linspace(-8, 4, len(splats))[:, None]), view()


@case("scales of 0")
def zero_scales() -> tuple[Splats, Camera]:
    return scaled(ball(), 0.0), view()


# -- needles and discs -------------------------------------------------------------------------------------------------


def needles(length: float, thickness: float, count: int = 12) -> Splats:
    return replace(ball(count), scales=torch.tensor([length, thickness, thickness]).repeat(count, 1))


@case("needles 1:1e6 within the picture")
def needles_within() -> tuple[Splats, Camera]:
    return needles(0.3, 0.3e-6), view()


@case("needles 1:1e6 longer than the picture")
def needles_across() -> tuple[Splats, Camera]:
    return needles(20.0, 2e-5), view()


@case("needles 1:1e6 a thousand pictures long")
def needles_long() -> tuple[Splats, Camera]:
    return needles(2000.0, 2e-3), view()


@case("needles 1:1e6 with a thickness of several px")
def needles_thick() -> tuple[Splats, Camera]:
    return with_opacity(needles(5e4, 5e-2), 0.3), view()


@case(
    "needles 1:1e6 from means 20 pictures outside",
    gradient=1e-3,
    why="a float32 rounding of a needle's direction moves its side by 1e-4 px at 1,300 px from its mean",
)
def needles_from_outside() -> tuple[Splats, Camera]:
    camera, turn = along_y(), torch.linspace(0, math.pi, 12)
    direction = torch.stack([turn.cos(), torch.zeros(12), turn.sin()], 1)
    quats = torch.stack([(turn / 2).cos(), torch.zeros(12), -(turn / 2).sin(), torch.zeros(12)], 1)
    splats = needles(60.0, 6e-5)
    return replace(splats, quats=quats, means=before(shrunk(splats, 0.5)).means + 60 * direction), camera


@case(
    "needles 1:1e6 from means 200 pictures outside",
    image=5e-3,
    gradient=2e-2,
    tolerance=1e-3,
    why="a float32 rounding of a needle's direction moves its side by 1e-3 px at 13,000 px from its mean",
)
def needles_from_far_outside() -> tuple[Splats, Camera]:
    splats, camera = needles_from_outside()
    far = before(shrunk(before(splats, -4), 10))
    return far, camera


@case("needles 1:1e6 viewed end on")
def needles_end_on() -> tuple[Splats, Camera]:
    splats = before(needles(1.0, 1e-6))
    half_right_angle = torch.tensor([math.sqrt(0.5), 0, 0, math.sqrt(0.5)])  # turns x to y, about z
    return replace(splats, quats=half_right_angle.repeat(len(splats), 1)), along_y()


@case("discs 1e6:1 viewed edge on")
def discs_edge_on() -> tuple[Splats, Camera]:
    splats = before(ball(12))
    flat, level = torch.tensor([0.5, 0.5, 0.5e-6]), torch.tensor([1.0, 0, 0, 0])
    return replace(splats, scales=flat.repeat(12, 1), quats=level.repeat(12, 1)), along_y()


# -- opacity -----------------------------------------------------------------------------------------------------------


@case("opacity 1e-7", drawn=False)
def opacity_tiny() -> tuple[Splats, Camera]:
    return with_opacity(ball(), 1e-7), view()


@case("opacity 1e-7 where alpha_min is 1e-9", rules={"alpha_min": 1e-9, "unrolled": 1})
def opacity_tiny_drawn() -> tuple[Splats, Camera]:
    return with_opacity(ball(), 1e-7), view()


@case("opacity 1 - 1e-7")
def opacity_full() -> tuple[Splats, Camera]:
    return with_logits(ball(), torch.full((24,), math.log(1e7))), view()


@case("opacity from 1e-7 to 1 - 1e-7")
def opacity_ramp() -> tuple[Splats, Camera]:
    return with_logits(ball(), torch.linspace(-1, 1, 24) * math.log(1e7)), view()


@case("opacity 0")
def opacity_zero() -> tuple[Splats, Camera]:
    splats = ball()
    gone = torch.where(torch.arange(24) % 2 == 0, -math.inf, splats.log_opacities)
    return replace(splats, log_opacities=gone), view()


# -- the near plane and the camera -------------------------------------------------------------------------------------


@case("splats at, before and behind the near plane")
def near_plane() -> tuple[Splats, Camera]:
    splats = ball(size=0.01)
    depths = 0.25 * (1 + torch.tensor([-1e-2, -1e-6, 0.0, 1e-6, 1e-4, 1e-2]).repeat(4))
    means = torch.stack([0.07 * splats.means[:, 0], depths, 0.07 * splats.means[:, 2]], 1)
    return replace(splats, means=means), replace(along_y(), near=0.25)


@case("large splats at the near plane")
def near_plane_large() -> tuple[Splats, Camera]:
    splats, camera = near_plane()
    return with_opacity(scaled(splats, 20), 0.3), camera


@case("splats behind the camera only", drawn=False)
def behind() -> tuple[Splats, Camera]:
    return before(ball(), -4), along_y()


@case("splats all around the camera")
def around() -> tuple[Splats, Camera]:
    splats = ball(64, size=0.3, opacity=0.5)
    return replace(splats, means=normalize(splats.means, dim=1)), along_y(fov_x=1.2)


@case("a camera inside large splats")
def inside() -> tuple[Splats, Camera]:
    return ball(64, size=2.0, opacity=0.2), along_y(fov_x=1.2)


@case("splats far to the side of the camera, just before the near plane")
def beside() -> tuple[Splats, Camera]:
    splats = ball(48, size=1.0, opacity=0.5)
    depths = 0.2 + 0.3 * torch.rand(48, generator=torch.Generator().manual_seed(1))
    means = torch.stack([10 * splats.means[:, 0], depths, 10 * splats.means[:, 2]], 1)
    return replace(splats, means=means), along_y()


@case("depths from 0.2 to 1e30")
def deep() -> tuple[Splats, Camera]:
    camera, splats = along_y(), ball(40)
    depths = torch.logspace(math.log10(0.21), 30, 40)
    placed = spread_over(splats, camera)
    means = placed.means * (depths / placed.means[:, 1])[:, None]
    return replace(splats, means=means, scales=0.02 * depths[:, None] * splats.scales / 0.15), camera


# -- quaternions -------------------------------------------------------------------------------------------------------


@case("zero quaternions")
def zero_quats() -> tuple[Splats, Camera]:
    splats = ball()
    return replace(splats, quats=torch.zeros_like(splats.quats)), view()


@case("quaternions of length 1e-30 to 1e38")
def long_quats() -> tuple[Splats, Camera]:
    splats = ball()
    lengths = torch.tensor([1e-30, 1e-6, 1e6, 1e19, 1e30, 1e38]).repeat(4)
    return replace(splats, quats=normalize(splats.quats, dim=1) * lengths[:, None]), view()


# -- coordinates -------------------------------------------------------------------------------------------------------


@case("coordinates 1e6 from the origin")
def far_away() -> tuple[Splats, Camera]:
    splats, camera = ball(), view()
    shift = torch.tensor([1e6, -1e6, 1e6], dtype=torch.float64)
    means = (splats.means.double() + shift).float()  # on a grid of 1/16 there
    return replace(splats, means=means), replace(camera, translation=camera.translation - camera.rotation @ shift)


for size in ("1e6", "1e-6"):

    @case(f"a scene of size {size}")
    def size_of_scene(factor: float = float(size)) -> tuple[Splats, Camera]:
        camera = view()
        return shrunk(ball(), factor), replace(
            camera, translation=factor * camera.translation, near=factor * camera.near
        )


# -- rasters and lenses ------------------------------------------------------------------------------------------------


@case("an image of 1 x 1 px")
def one_pixel() -> tuple[Splats, Camera]:
    return ball(), view(1, 1)


@case("an image of 300 x 1 px")
def one_row() -> tuple[Splats, Camera]:
    return ball(), view(300, 1)


def view_8k() -> Camera:
    return view(7680, 4320)


@case("a window in the middle of an 8k image")
def middle_of_8k() -> tuple[Splats, Camera]:
    window = view_8k().crop(3800, 2100, 96, 80)
    return spread_over(ball(48, size=0.003), window), window


@case("a window in the far corner of an 8k image")
def corner_of_8k() -> tuple[Splats, Camera]:
    window = view_8k().crop(7680 - 96, 4320 - 80, 96, 80)
    return spread_over(ball(48, size=0.003), window), window


@case(
    "points in the far corner of an 8k image",
    image=4e-4,
    gradient=1e-3,
    tolerance=2e-3,  # at the cut-off ln alpha of an opaque point falls by 6.1 per px
    why="float32 px beyond 4096 lie 4.9e-4 apart, and the flank of a point falls by up to 1.1 per px",
)
def points_in_8k() -> tuple[Splats, Camera]:
    window = view_8k().crop(7680 - 96, 4320 - 80, 96, 80)
    return spread_over(ball(200, size=0.0, opacity=1.0), window), window


@case("focal length 1 px")
def short_lens() -> tuple[Splats, Camera]:
    splats = ball(48, size=0.3, opacity=0.5)
    means = normalize(splats.means, dim=1) + torch.tensor([0, 0.5, 0])
    return replace(splats, means=means), replace(along_y(24, 18), fx=1.0, fy=1.0)


@case("focal length 1e3 px")
def long_lens() -> tuple[Splats, Camera]:
    return shrunk(ball(), 0.1), replace(view(), fx=1e3, fy=1e3)


@case("focal length 1e5 px")
def longest_lens() -> tuple[Splats, Camera]:
    return shrunk(ball(), 1e-3), replace(view(), fx=1e5, fy=1e5)


@case("points through a focal length of 1e5 px")
def points_through_longest_lens() -> tuple[Splats, Camera]:
    return scaled(shrunk(ball(200), 1e-3), 0.0), replace(view(), fx=1e5, fy=1e5)


@case("zoom x64")
def zoomed() -> tuple[Splats, Camera]:
    window = view(96, 72).zoom(64).crop(3000, 2000, 96, 72)
    return spread_over(ball(48, size=0.004), window), window


@case("principal point off centre")
def off_centre() -> tuple[Splats, Camera]:
    return ball(), replace(view(), cx=10.0, cy=65.0)


@case("negative principal point")
def negative_centre() -> tuple[Splats, Camera]:
    splats = ball(48)
    return replace(splats, means=splats.means + torch.tensor([2.0, 0, -1.5])), replace(view(), cx=-40.0, cy=-30.0)


@case("principal point 1e4 px outside")
def far_centre() -> tuple[Splats, Camera]:
    camera = replace(along_y(), cx=-1e4, cy=5e3)
    return spread_over(ball(48, size=0.3), camera), camera


# -- crowds ------------------------------------------------------------------------------------------------------------


@case("no splats", drawn=False)
def none() -> tuple[Splats, Camera]:
    return rows(ball(), slice(0)), view()


@case("one splat")
def single() -> tuple[Splats, Camera]:
    return rows(ball(), slice(1)), view()


@case("1e4 splats on one pixel")
def crowd() -> tuple[Splats, Camera]:
    camera, splats = along_y(9, 9), ball(10_000, opacity=0.01)
    depths = 2 + 4 * torch.rand(10_000, generator=torch.Generator().manual_seed(2))
    pixel = torch.tensor([4.4, 4.7], dtype=torch.float64).expand(10_000, 2)
    return replace(scaled(splats, 0.5), means=unprojected(camera, pixel, depths)), camera


@case("identical depths")
def same_depth() -> tuple[Splats, Camera]:
    splats = ball(64)
    return before(replace(splats, means=splats.means * torch.tensor([1.0, 0, 1]))), along_y()


@case("identical splats")
def same_splat() -> tuple[Splats, Camera]:
    return rows(ball(), torch.zeros(40, dtype=torch.long)), view()


@case(
    "identical opaque splats",
    why="where two alphas of 0.99 leave just the transmittance stop, rounding draws the second or not: by 0.0099",
)
def same_opaque_splat() -> tuple[Splats, Camera]:
    splats = rows(ball(size=0.5), torch.zeros(40, dtype=torch.long))
    return with_logits(splats, torch.full((40,), math.log(1e7))), view()


@case("all tiles saturated")
def saturated() -> tuple[Splats, Camera]:
    return with_opacity(scaled(ball(200), 20), 0.9), view()


@case("all tiles empty", drawn=False)
def empty() -> tuple[Splats, Camera]:
    splats = ball()
    return replace(splats, means=splats.means + torch.tensor([0.0, 0, 40])), view()


# -- what cannot be drawn ----------------------------------------------------------------------------------------------


@case("NaN and infinities", dropped=10, dropped_in_float64=10)
def poisoned() -> tuple[Splats, Camera]:
    splats = ball(34)
    for row, values in enumerate(vars(splats).values()):
        values[2 * row] = math.nan
        values[2 * row + 1] = math.inf
    return splats, view()


@case("opacities above 1", dropped=4, dropped_in_float64=4)
def above_one() -> tuple[Splats, Camera]:
    splats = ball(28)
    splats.log_opacities[:4] = torch.tensor([0.01, 1.0, 100.0, 3e38])
    return splats, view()


@case("projections beyond float32", dropped=8)
def beyond_float32() -> tuple[Splats, Camera]:
    splats = with_opacity(ball(32), 0.3)
    splats = before(splats)
    splats.scales[:4] = torch.tensor([1e16, 1e20, 1e30, 1e38])[:, None]
    splats.means[4:8] = torch.tensor([[1e17, 4, 0], [0, 4, -1e20], [1e30, 1e5, 1e30], [1e38, 1, 0]])
    return splats, along_y()


@case("a focal length of 0", refused="fx=0")
def no_lens() -> tuple[Splats, Camera]:
    return ball(), replace(view(), fx=0.0)


@case("a lens that is not a number", refused="cx=nan")
def lens_nan() -> tuple[Splats, Camera]:
    return ball(), replace(view(), cx=math.nan)


@case("a pose that is not finite", refused="not finite")
def pose_inf() -> tuple[Splats, Camera]:
    camera = view()
    return ball(), replace(camera, translation=camera.translation * math.inf)


@case("more pairs than max_pairs", refused="max_pairs=10", rules={"max_pairs": 10})
def too_many_pairs() -> tuple[Splats, Camera]:
    return ball(), view()
