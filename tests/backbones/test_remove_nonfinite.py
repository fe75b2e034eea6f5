"""What makes no picture is found, removed with a word and never in the way: every backbone, every parameter."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import torch
from small_scene import small_scene, spread
from test_extremes_of_training import BACKBONES, built
from torch import Tensor

from gsx.backbones.anchors import Anchors
from gsx.backbones.gs3d import GS3D
from gsx.core.data.camera import look_at
from gsx.core.errors import LostModel, TrainingError
from gsx.core.gaussians.splats import Splats
from gsx.core.plugins import Plugins, load_plugins
from gsx.core.rasterizer import RasterSettings, rasterize, touches
from gsx.core.training.backbone import remove_nonfinite
from gsx.core.training.parameter_table import named_parameters, table_tensors
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.run import Run, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import backward, train_step
from gsx.core.training.training_views import TrainingViews
from gsx.experiments.runs.guard import Guard

NEURAL = ("scaffold", "octree_scaffold")
WITH_QUATS = ("gs3d", "mip_splatting", "octree_gs3d", "octree_gs3d, clone_split")


def run_of(name: str, folder: Path) -> Run:
    """A run at step 0 on forty points that every view sees."""
    scene = small_scene(spread(40))
    backbone = built(name, scene)
    return Run(
        config={},
        folder=folder,
        backbone=backbone,
        raster=backbone.raster,
        training=TrainingOptions(
            ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=9, checkpoints_kept=1, test_points=0
        ),
        iterations=30,
        photos=PhotoCache(torch.device("cpu")),
        generator=torch.Generator().manual_seed(0),
        views=TrainingViews(scene=scene),
        sampler=Sampler(4, 0),
    )


def backbone_of(run: Run) -> GS3D | Anchors:
    assert isinstance(run.backbone, GS3D | Anchors)
    return run.backbone


def in_view(run: Run) -> int:
    """A primitive that every camera draws at the next step."""
    backbone, camera = backbone_of(run), run.scene.train[0].camera
    step = run.step + 1
    rows = backbone.visible(camera, step).rows if isinstance(backbone, Anchors) else backbone.draw(camera, step).rows
    return 3 if rows is None else int(rows[3])


@contextmanager
def guarded() -> Iterator[Plugins]:
    plugins = load_plugins([], points=[])
    with plugins.listening([Guard()]):
        yield plugins


def assert_removed(run: Run, plugins: Plugins, caplog: pytest.LogCaptureFixture, what: str) -> None:
    """One primitive goes, with a word, and the run goes on as if it had never been there."""
    before = len(run.backbone.table)
    caplog.clear()
    with caplog.at_level(logging.WARNING, "gsx.core.training.trainer"):
        step = train_step(run, plugins)
    assert "removed 1 primitives" in step.skipped, what
    assert f"step {step.number}: removed 1 primitives with values that are not finite" in caplog.text, what
    assert len(run.backbone.table) == before - 1, what
    after = train_step(run, plugins)
    assert not after.skipped, what
    assert after.dropped == 0, what
    for name, value in table_tensors(run.backbone.table).items():
        assert bool(torch.isfinite(value.float()).all()), f"{what}: {name}"


@pytest.mark.parametrize("name", BACKBONES)
def test_a_primitive_with_any_value_that_is_not_finite_is_removed(
    name: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = run_of(name, tmp_path)
    with guarded() as plugins:
        for parameter in list(backbone_of(run).table.parameters):
            drawn_all_the_same = parameter in ("log_scales", "opacity_logits")  # as very large, as opaque
            for value in (torch.nan,) if drawn_all_the_same else (torch.nan, torch.inf):
                row = in_view(run)
                with torch.no_grad():
                    backbone_of(run).table[parameter][row].view(-1)[0] = value
                assert_removed(run, plugins, caplog, f"{parameter} {value}")


OUT_OF_RANGE = {
    "quats": ("quats", 3e38),  # each is finite, their sum is not
    "means": ("means", 1e38),
    "offsets": ("offsets", 3e38),
    "volume": ("log_scales", 60.0),
}


@pytest.mark.parametrize(("name", "what"), [
    ("gs3d", "quats"), ("octree_gs3d", "quats"), ("octree_gs3d, clone_split", "quats"), ("gs3d", "means"),
    ("scaffold", "offsets"), ("octree_scaffold", "offsets"), ("octree_gs3d", "offsets"),
    ("octree_gs3d, clone_split", "volume"),
])  # fmt: skip
def test_finite_values_that_make_no_splat_are_removed_too(
    name: str, what: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = run_of(name, tmp_path)
    row, (parameter, value) = in_view(run), OUT_OF_RANGE[what]
    with torch.no_grad():
        backbone_of(run).table[parameter][row] = value
        if what == "offsets":  # times a reach of e^2
            backbone_of(run).table["log_scales"][row, :3] = 2.0
        if what == "means":  # just before the first camera and very far aside: 1e38 px
            run.sampler.order = [1, 0]
            backbone_of(run).table["means"][row] = torch.tensor([1e38, -3.0, 0.5])
    with guarded() as plugins:
        assert_removed(run, plugins, caplog, what)


@pytest.mark.parametrize("name", NEURAL)
def test_anchors_are_not_blamed_for_their_networks(name: str, tmp_path: Path) -> None:
    run = run_of(name, tmp_path)
    backbone = backbone_of(run)
    assert isinstance(backbone, Anchors)
    assert backbone.table.networks is not None
    with torch.no_grad():
        backbone.table.networks.modules.get_submodule("opacity.2").get_parameter("bias")[0] = torch.nan
    count = len(backbone.table)
    with guarded() as plugins:
        for _ in range(2):
            assert "removed" not in train_step(run, plugins).skipped
        with pytest.raises(TrainingError, match="3 steps in a row"):
            train_step(run, plugins)
    assert len(backbone.table) == count


@pytest.mark.parametrize("name", BACKBONES)
def test_where_nothing_is_removed_nothing_is_touched(name: str, tmp_path: Path) -> None:
    """Parameters stay the same objects, with their gradients: a step goes on after a call in vain."""
    run = run_of(name, tmp_path)
    backward(run)
    before = {key: (value, value.grad) for key, value in named_parameters(run.backbone.table)}
    assert remove_nonfinite(run.backbone, [view.camera for view in run.scene.train], 1) == 0
    for key, value in named_parameters(run.backbone.table):
        assert value is before[key][0]
        assert value.grad is before[key][1]
    assert any(gradient is not None and gradient.any() for _, gradient in before.values())


@pytest.mark.parametrize("name", BACKBONES)
def test_a_model_that_is_lost_as_a_whole_ends_the_run_and_is_left_as_it_is(name: str, tmp_path: Path) -> None:
    run = run_of(name, tmp_path)
    with torch.no_grad():
        backbone_of(run).table["log_scales"].fill_(torch.nan)
    count = len(backbone_of(run).table)
    with pytest.raises(LostModel, match=f"step 1: {count} of {count} primitives .* learning rates"):
        remove_nonfinite(run.backbone, [run.scene.train[0].camera], 1)
    assert len(backbone_of(run).table) == count


def test_what_cannot_be_projected_is_not_held_back_before_decoding() -> None:
    """A reach of 1e13 just before the camera: the render must hear of it."""
    camera = look_at([0, 0, 0], [0, 1, 0], fov_x=0.9, width=24, height=16)
    means = torch.tensor([[0.0, 0.25, 0.0], [0.0, 4.0, 0.0], [0.0, -4.0, 0.0], [100.0, 4.0, 0.0]])
    scales = torch.tensor([[1e13] * 3, [0.1] * 3, [1e13] * 3, [0.1] * 3])
    quats = torch.tensor([[1.0, 0, 0, 0]] * 4)
    assert touches(means, scales, quats, camera, RasterSettings()).tolist() == [True, True, False, False]


# -- quaternions of zero -----------------------------------------------------------------------------------------------


def turned(quats: Tensor) -> Tensor:
    """The gradient of a picture of one stretched splat in its quaternion."""
    camera = look_at([0, -4, 0], [0, 0, 0], fov_x=0.9, width=24, height=16)
    quats = quats.clone().requires_grad_()
    splats = Splats(
        means=torch.tensor([[0.1, 0, 0.2]]),
        scales=torch.tensor([[0.6, 0.1, 0.3]]),
        quats=quats,
        log_opacities=torch.tensor([-0.5]),
        colours=torch.ones(1, 3),
    )
    weights = torch.rand(3, 16, 24, generator=torch.Generator().manual_seed(0))
    (rasterize(splats, camera, RasterSettings()).image * weights).sum().backward()
    assert quats.grad is not None
    return quats.grad


def test_a_zero_quaternion_has_no_gradient_to_leave_zero_by() -> None:
    assert not turned(torch.zeros(1, 4)).any()
    assert turned(torch.tensor([[1.0, 0, 0, 0]])).any()


@pytest.mark.parametrize("name", WITH_QUATS)
def test_zero_quaternions_become_the_identity_and_turn_again(name: str, tmp_path: Path) -> None:
    run = run_of(name, tmp_path)
    row, table = in_view(run), backbone_of(run).table
    with torch.no_grad():
        table["quats"][row] = 0.0
        table["log_scales"][row] += torch.linspace(-0.5, 0.5, table["log_scales"].shape[1])
    with guarded() as plugins:
        train_step(run, plugins)
        assert table["quats"][row].tolist() == [1.0, 0.0, 0.0, 0.0]
        train_step(run, plugins)
    assert table["quats"][row, 1:].any()
