"""Signs that a splat file does not belong to a scene, in scenes made here."""

import json
import logging
import math
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.scene import PointCloud
from gsx.core.errors import InputError
from gsx.core.gaussians.splats import Gaussians
from gsx.experiments.evaluation.remarks import remarks_of
from gsx.experiments.runs.open import start
from gsx.experiments.runs.render_views import file_pictures
from gsx.experiments.runs.start_file import distance_doubts, in_view_doubts, refuse_nothing_in_view
from gsx.formats.splat_files import read_gaussians, write_gaussians
from gsx.formats.standard_ply import activated_words


def ball(count: int = 200, log_scale: float = -4.0) -> Gaussians:
    """Splats in a ball of radius 1 around the origin."""
    generator = torch.Generator().manual_seed(0)
    places = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
    return Gaussians(
        means=places * torch.rand(count, 1, generator=generator) ** (1 / 3),
        log_scales=torch.full((count, 3), log_scale) + 0.3 * torch.randn(count, 3, generator=generator),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        opacity_logits=2 * torch.randn(count, generator=generator),
        sh_dc=torch.zeros(count, 3),
        sh_rest=torch.zeros(count, 0, 3),
    )


def around() -> list[Camera]:
    """Cameras that look at the origin from 4 units away."""
    eyes = [(4.0, 0.0, 0.0), (0.0, 4.0, 0.5), (-4.0, 0.0, 0.5)]
    return [look_at(eye, (0.0, 0.0, 0.0), fov_x=0.8, width=40, height=40) for eye in eyes]


def outward() -> list[Camera]:
    """Cameras at the same places that look away."""
    half = torch.diag(torch.tensor([-1.0, 1, -1])).double()
    return [replace(camera, rotation=half @ camera.rotation.double(), translation=half @ camera.translation.double())
            for camera in around()]  # fmt: skip


def test_splats_that_are_in_view_are_accepted() -> None:
    refuse_nothing_in_view(ball(), around(), "test view", Path("a.ply"))
    assert not list(in_view_doubts(ball(), around(), "test view"))


def test_no_splat_in_view_is_refused() -> None:
    moved = replace(ball(), means=ball().means + torch.tensor([500_000.0, 5_400_000, 300]))
    words = (
        r"a.ply: no splat is in view of any test view \(3\). Splats lie around \(499999.*, 5400000, 300.*\), cameras"
    )
    for splats, cameras in ((moved, around()), (ball(), outward())):
        with pytest.raises(InputError, match=words if splats is moved else "no splat is in view of any test view"):
            refuse_nothing_in_view(splats, cameras, "test view", Path("a.ply"))


def test_a_wide_splat_beside_the_picture_is_in_view() -> None:
    """A sky may be nothing but a few of them: a camera 4 units away sees 1.7 units to each side."""
    beside = replace(ball(1), means=torch.tensor([[0.0, 0, 6.0]]), log_scales=torch.full((1, 3), math.log(1.5)))
    refuse_nothing_in_view(beside, around()[:1], "test view", Path("a.ply"))
    thin = replace(beside, log_scales=torch.full((1, 3), math.log(0.5)))
    with pytest.raises(InputError, match="no splat is in view"):
        refuse_nothing_in_view(thin, around()[:1], "test view", Path("a.ply"))


def test_hardly_any_splat_in_view_is_doubted() -> None:
    means = ball().means.clone()
    means[4:] += 1000
    (doubt,) = in_view_doubts(replace(ball(), means=means), around(), "test view")
    assert doubt.startswith("only 2.00% of the splats are in view of any test view")


def test_points_far_from_all_splats_are_doubted() -> None:
    cloud = PointCloud(ball(150).means, torch.arange(450, dtype=torch.int64).view(150, 3).to(torch.uint8))
    assert not list(distance_doubts(ball(), cloud))
    (doubt,) = distance_doubts(replace(ball(), means=10 * ball().means), cloud)
    assert "the file holds a part of the scene, or is in other coordinates" in doubt
    few = PointCloud(cloud.positions[:9], cloud.colours[:9])
    assert not list(distance_doubts(replace(ball(), means=10 * ball().means), few))
    grey = PointCloud(cloud.positions, torch.full((150, 3), 127, dtype=torch.uint8))  # random ones: no evidence
    assert not list(distance_doubts(replace(ball(), means=10 * ball().means), grey))


def raw(count: int, scales: str, opacities: str) -> Gaussians:
    gaussians = ball(count)
    change = {"log_scales": gaussians.log_scales.exp()} if scales == "activated" else {}
    if scales == "large":  # splats of 1 to 50 units
        change["log_scales"] = torch.linspace(0.1, 4, 3 * count).view(count, 3)
    if opacities == "activated":
        change["opacity_logits"] = gaussians.opacity_logits.sigmoid()
    if opacities == "equal":  # 3DGS-MCMC begins with opacities of 0.5
        change["opacity_logits"] = torch.zeros(count)
    return replace(gaussians, **change)


@pytest.mark.parametrize(
    ("count", "scales", "opacities", "words"),
    [
        (200, "raw", "raw", ""),
        (200, "activated", "activated", "all scales .* and all opacities"),
        (3, "activated", "activated", "all scales .* and all opacities"),
        (3, "activated", "equal", "all scales .* and all opacities"),
        (200, "activated", "raw", "all scales are above 0 .median 0.01"),
        (200, "raw", "activated", "all opacities are within"),
        (3, "activated", "raw", ""),
        (3, "raw", "activated", ""),
        (200, "large", "raw", ""),
        (200, "raw", "equal", ""),
        (0, "raw", "raw", ""),
    ],
)
def test_activated_values(count: int, scales: str, opacities: str, words: str) -> None:
    found = list(activated_words(raw(count, scales, opacities)))
    assert len(found) == bool(words)
    if words:
        assert "these look like activated values: " in found[0]
        assert re.search(words, found[0])


def test_reading_a_file_of_activated_values_warns(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_gaussians(tmp_path / "a.ply", written := raw(200, "activated", "activated"))
    assert torch.equal(read_gaussians(tmp_path / "a.ply").log_scales, written.log_scales)  # never read otherwise
    assert "a.ply: these look like activated values" in caplog.text


def test_coordinates_in_words_count_from_zero() -> None:
    """The scene's own origin is subtracted where files are read."""
    moved = replace(ball(), means=ball().means + torch.tensor([0.0, 0, 1e6]))
    with pytest.raises(
        InputError, match=r"Splats lie around \([-\d.]+, 199.*, 1000000.*\), cameras around \([-\d.]+, 200"
    ):
        refuse_nothing_in_view(moved, around(), "test view", Path("a.ply"), (0.0, 200.0, 0.0))


def test_a_path_on_which_no_splat_is_in_view_is_refused(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", ball())
    assert float(file_pictures(tmp_path / "a.ply", around())(around()[0]).max()) > 0
    with pytest.raises(InputError, match=r"no splat is in view of any camera of the path \(3\)"):
        file_pictures(tmp_path / "a.ply", outward())


# -- through a run -----------------------------------------------------------------------------------------------------


def test_a_file_in_other_coordinates_is_refused_and_leaves_no_folder(tmp_path: Path) -> None:
    write_gaussians(tmp_path / "a.ply", replace(ball(), means=ball().means + 1e6))
    for iterations, views in ((0, "any test view"), (3, "any training or test view")):
        settings = tiny_settings(tmp_path / "run", f"init={tmp_path / 'a.ply'}", f"iterations={iterations}")
        with pytest.raises(InputError, match=f"no splat is in view of {views}"):
            start(settings, plugins())
    assert not (tmp_path / "run").exists()


def test_doubts_are_in_log_evaluation_and_report(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    write_gaussians(tmp_path / "a.ply", raw(10, "activated", "activated"))
    tiny_run(tmp_path / "run", [f"init={tmp_path / 'a.ply'}", "iterations=0", "rasterizer=eager"])
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert any("a.ply: these look like activated values" in remark for remark in remarks_of(evaluation))
    assert "these look like activated values" in (tmp_path / "run" / "report.html").read_text()
    assert "these look like activated values" in caplog.text
