"""A search of the whole input space for what must never happen (hypothesis; the same examples on every run)."""

import contextlib
import math
from dataclasses import replace

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import any_path
from reference_rasterizer import render_reference
from torch import Tensor

from extremes.cases import ball, scaled, view
from extremes.comparison import gradients_of, leaves, paths, undecided
from gsx.core.data.camera import Camera
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Splats
from gsx.core.rasterizer import RasterSettings, Rendering, rasterize

LARGEST = float(torch.finfo(torch.float32).max)
EDGES = [0.0, -0.0, 1e-45, -1e-39, 1e-20, 1e-12, 1e-6, 1e4, 1e6, 1e12, -1e15, -1e19, 1e20, 1e30, -1e38, LARGEST]
WILD = st.one_of(st.sampled_from(EDGES), st.floats(-LARGEST, LARGEST, width=32), st.floats(-4, 4, width=32))
POISON = st.sampled_from([math.nan, math.inf, -math.inf])
SEARCH = settings(max_examples=60, deadline=None)
VIEW = view()
GEOMETRY = ("means", "scales", "quats", "log_opacities")


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """10 to the power of a number between `low` and `high`."""
    return st.floats(low, high).map(lambda power: 10.0**power)


@st.composite
def splats_with(draw: st.DrawFn, values: st.SearchStrategy[float], sizes: st.SearchStrategy[float]) -> Splats:
    """Up to eight ordinary splats, their scales times one of `sizes`, some of their numbers replaced by `values`."""
    splats = scaled(ball(draw(st.integers(0, 8)), draw(st.integers(0, 1000))), draw(sizes))
    for name in draw(st.lists(st.sampled_from(GEOMETRY), max_size=8 if len(splats) else 0)):
        flat = getattr(splats, name).view(-1)
        flat[draw(st.integers(0, len(flat) - 1))] = draw(values)
    return splats


@st.composite
def cameras_with(
    draw: st.DrawFn, focal: st.SearchStrategy[float], centre: st.SearchStrategy[float], shift: st.SearchStrategy[float]
) -> Camera:
    """A window of up to 20 x 20 px of an ordinary camera, its lens and its place (in scene units) changed."""
    width, height = draw(st.integers(1, 20)), draw(st.integers(1, 20))
    camera = VIEW.resize(width + 20, height + 20).crop(
        draw(st.integers(0, 20)), draw(st.integers(0, 20)), width, height
    )
    moved = torch.tensor(draw(st.tuples(shift, shift, shift)), dtype=torch.float64)
    return replace(
        camera,
        translation=camera.translation + moved,
        fx=camera.fx * draw(focal),
        fy=camera.fy * draw(focal),
        cx=camera.cx + draw(centre),
        cy=camera.cy + draw(centre),
        near=draw(st.sampled_from([0.0, 1e-30, 1e-6, 0.2, 2.0])),
    )


def rules(alpha_min: st.SearchStrategy[float], dilation: st.SearchStrategy[float]) -> st.SearchStrategy[RasterSettings]:
    """Rules of every path; `alpha_min` of the eager one only, since compiled code holds it as a constant."""
    cull = st.sampled_from(["published", "tight"])
    builds = [
        st.builds(any_path, cull=cull, dilation=dilation, path=st.just(path), unrolled=st.just(2)) for path in paths()
    ]
    return st.one_of(st.builds(any_path, cull=cull, dilation=dilation, alpha_min=alpha_min), *builds)


RULES = rules(st.sampled_from([1 / 255, 1e-9]), st.sampled_from([0.3, 1e-6, 1e3]))
WILD_SPLATS = splats_with(WILD, powers(-8, 4))
CALM = st.floats(-0.5, 0.5)
WILD_CAMERAS = cameras_with(
    st.one_of(st.just(1.0), powers(-4, 5)), st.one_of(CALM, st.floats(-1e6, 1e6)), st.one_of(CALM, st.floats(-1e8, 1e8))
)


def check(rendering: Rendering, gradients: dict[str, Tensor]) -> None:
    """The picture is finite, coverage is a share, gradients are finite."""
    image, alpha = rendering.image.detach(), rendering.alpha.detach()
    assert torch.isfinite(image).all()
    assert 0 <= float(alpha.min()) <= float(alpha.max()) <= 1
    assert float(image.abs().max()) <= 1  # a weighted mean of colours in [0, 1]
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), name


def render(splats: Splats, camera: Camera, rules: RasterSettings) -> tuple[Rendering, dict[str, Tensor]]:
    live = leaves(splats, splats.means.dtype)
    rendering = rasterize(live, camera, rules)
    return rendering, gradients_of(live, rendering.image, rendering.alpha, torch.ones(()))


@given(WILD_SPLATS, WILD_CAMERAS, RULES)
@SEARCH
def test_whatever_the_finite_numbers_the_picture_and_its_gradients_are_finite(
    splats: Splats, camera: Camera, rules: RasterSettings
) -> None:
    check(*render(splats, camera, rules))


@given(WILD_SPLATS, WILD_CAMERAS, RULES, st.data())
@SEARCH
def test_splats_that_are_not_finite_leave_no_trace(
    splats: Splats, camera: Camera, rules: RasterSettings, data: st.DataObject
) -> None:
    values = data.draw(st.lists(POISON, max_size=len(splats)))
    fields = {name: value.clone() for name, value in vars(splats).items()}
    for row, value in enumerate(values):
        name = data.draw(st.sampled_from([*fields] if value != -math.inf else ["means", "scales", "quats", "colours"]))
        flat = fields[name][row].view(-1)
        flat[data.draw(st.integers(0, len(flat) - 1))] = value
    rendering, gradients = render(Splats(**fields), camera, rules)
    check(rendering, gradients)
    rest = Splats(**{name: value[len(values) :] for name, value in fields.items()})
    clean, expected = render(rest, camera, rules)
    assert torch.equal(rendering.image, clean.image)
    assert rendering.dropped == clean.dropped + len(values)
    for name, gradient in gradients.items():
        assert not gradient[: len(values)].any()
        assert torch.equal(gradient[len(values) :], expected[name])


@given(WILD_SPLATS, WILD_CAMERAS, RULES, st.sampled_from(["fx", "fy", "cx", "cy", "near"]), st.one_of(WILD, POISON))
@SEARCH
def test_any_camera_is_rendered_or_refused_by_name(
    splats: Splats, camera: Camera, rules: RasterSettings, name: str, value: float
) -> None:
    with contextlib.suppress(InputError):
        check(*render(splats, replace(camera, **{name: value}), rules))


TAME_SPLATS = splats_with(st.floats(-2, 0), powers(-8, 2))
TAME_CAMERAS = cameras_with(powers(-2, 2), st.floats(-10, 10), st.floats(-2, 2))


def compare(
    splats: Splats, camera: Camera, rules: RasterSettings, dtype: torch.dtype, tolerance: float
) -> tuple[float, float]:
    """Largest error of picture and depth, and largest relative gradient error, over the pixels that no threshold
    touches."""
    fast, slow = leaves(splats, dtype), leaves(splats, torch.float64)
    rendering = rasterize(fast, camera, rules, depth=True)
    image, alpha, depth = render_reference(slow, camera, rules)
    decided = (~undecided(slow, camera, rules, tolerance)).double()
    found = gradients_of(fast, rendering.image, rendering.alpha, decided)
    expected = gradients_of(slow, image, alpha, decided)
    errors = [(found[name] - truth).norm() / (1e-3 + truth.norm()) for name, truth in expected.items()]
    off = torch.cat([rendering.image - image, (rendering.depth - depth)[None] / (1 + depth)]).abs()
    return float((off * decided).detach().max()), float(max(errors))


@given(TAME_SPLATS, TAME_CAMERAS, RULES)
@SEARCH
def test_float64_agrees_with_the_reference(splats: Splats, camera: Camera, rules: RasterSettings) -> None:
    image, gradient = compare(splats, camera, rules, torch.float64, 1e-9)
    assert image <= 1e-9
    assert gradient <= 1e-7


@given(TAME_SPLATS, TAME_CAMERAS, rules(st.just(1 / 255), st.just(0.3)))
@SEARCH
def test_float32_agrees_with_the_reference(splats: Splats, camera: Camera, rules: RasterSettings) -> None:
    image, gradient = compare(splats, camera, rules, torch.float32, 1e-4)
    assert image <= 1e-4
    assert gradient <= 1e-3
