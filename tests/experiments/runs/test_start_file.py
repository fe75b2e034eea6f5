"""Runs that begin with a splat file: judged as it is, or trained on."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from reference_rasterizer import render_reference
from tiny import OVERRIDES, final_tensors, tiny_run, tiny_settings

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.resize import to_uint8
from gsx.core.errors import ConfigError, InputError
from gsx.core.gaussians.splats import splats_of
from gsx.core.rasterizer import RasterSettings
from gsx.experiments.run_folder.files import read_run, state_of
from gsx.experiments.run_folder.run_key import composition_key, scene_stamp
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.open import open_run, start
from gsx.experiments.runs.start_file import composition_of
from gsx.formats.splat_files import read_gaussians, write_gaussians

SCENE = [word for word in OVERRIDES if not word.startswith("backbone")]


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of some steps, whose splat file is somebody's."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    tiny_run(folder, ["iterations=12", "rasterizer=eager", "eval.zoom=[1,2]"])
    return folder


def figures(folder: Path) -> dict[str, object]:
    content = json.loads((folder / "evaluation.json").read_text())
    return {key: content[key] for key in ("psnr", "ssim", "primitives")} | {
        zoom: value["psnr"] for zoom, value in content["zoom"].items()
    }


def test_a_file_is_judged_by_the_figures_of_the_run_that_wrote_it(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    file = trained / "point_cloud.ply"
    words = ["scene=demo", *SCENE, "rasterizer=eager", "eval.zoom=[1,2]", f"folder={tmp_path / 'judged'}"]
    assert main(["eval", str(file), *words]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "judged" / "report.html")
    files = read_run(tmp_path / "judged")
    assert state_of(files)[0] == "ok"
    assert files.step == 0
    assert figures(tmp_path / "judged") == figures(trained)
    written, given = (vars(read_gaussians(path)) for path in (tmp_path / "judged" / "point_cloud.ply", file))
    assert all(torch.allclose(written[name], value, atol=1e-6) for name, value in given.items())


def test_its_figures_are_those_of_a_direct_computation(trained: Path, tmp_path: Path) -> None:
    """Every splat at every pixel in float64, PSNR by hand on 8 bits."""
    file = trained / "point_cloud.ply"
    run = tiny_run(tmp_path / "judged", [f"init={file}", "iterations=0", "rasterizer=eager"])
    gaussians, found = read_gaussians(file), []
    for view in run.scene.test:
        splats = splats_of(gaussians, view.camera.centre)
        picture, _, _ = render_reference(splats, view.camera, RasterSettings(), background=run.background)
        shown = to_uint8(picture.clamp(0, 1).float()).numpy().astype(float)
        truth = to_uint8(view.image()).numpy().astype(float)
        found.append(10 * math.log10(255**2 / np.mean((shown - truth) ** 2)))
    assert figures(tmp_path / "judged")["psnr"] == pytest.approx(np.mean(found), abs=0.05)


def test_training_goes_on_from_the_file_with_all_bands(trained: Path, tmp_path: Path) -> None:
    file = trained / "point_cloud.ply"
    settings = tiny_settings(tmp_path / "on", f"init={file}", "iterations=3", "rasterizer=eager")
    run, expected = start(settings, plugins()), read_gaussians(file)
    view = run.scene.test[0]
    drawn = run.backbone.draw(view.camera, 1).splats
    for name, value in vars(splats_of(expected, view.camera.centre)).items():
        assert torch.allclose(getattr(drawn, name), value, atol=1e-6), name
    before = run.backbone.table["means"].detach().clone()
    execute(run, settings, plugins())
    assert run.complete
    assert not torch.equal(before, run.backbone.table["means"])


def test_what_the_3d_filter_adds_is_taken_off_first(trained: Path, tmp_path: Path) -> None:
    """Splats wider than the filter are drawn as the file has them; narrower ones as wide as the filter."""
    file = trained / "point_cloud.ply"
    settings = tiny_settings(tmp_path / "mip", f"init={file}", "iterations=3", "backbone=mip_splatting")
    run = start(settings, plugins())
    sizes, wanted = run.backbone.table["filter"], read_gaussians(file)
    drawn = run.backbone.draw(run.scene.test[0].camera, 1).splats
    scales = wanted.log_scales.exp()
    wide = (scales > 1.01 * sizes[:, None]).all(1)
    assert 10 < int(wide.sum()) <= len(scales)
    assert torch.allclose(drawn.scales[wide], scales[wide], rtol=1e-4)
    assert torch.allclose(drawn.log_opacities[wide].exp(), wanted.opacity_logits[wide].sigmoid(), atol=1e-4)
    assert bool((drawn.scales >= 0.999 * sizes[:, None]).all())


def test_a_run_opens_and_goes_on_without_the_file(trained: Path, tmp_path: Path) -> None:
    file = tmp_path / "somebody.ply"
    file.write_bytes((trained / "point_cloud.ply").read_bytes())
    more = [f"init={file}", "iterations=4", "rasterizer=eager"]
    tiny_run(tmp_path / "whole", more)
    tiny_run(tmp_path / "cut", more, stop_after=2)
    file.unlink()
    run, settings = open_run(tmp_path / "cut", plugins(), training=True)
    assert run.step == 2
    execute(run, settings, plugins())
    ends = [final_tensors(tmp_path / name) for name in ("whole", "cut")]
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())
    assert run.backbone.draw(run.scene.test[0].camera, 1).splats.colours.shape == (len(run.backbone.table), 3)


def test_the_content_of_the_file_counts_for_what_is_trained(trained: Path, tmp_path: Path) -> None:
    files = [tmp_path / name for name in ("a.ply", "b.ply")]
    for file in files:
        file.write_bytes((trained / "point_cloud.ply").read_bytes())
    files[1].write_bytes(files[1].read_bytes() + b" ")

    def key(*more: str) -> str:
        config = tiny_settings(tmp_path / "run", *more).resolved
        return composition_key(config, scene_stamp(config), ())

    assert len({key(), key(f"init={files[0]}"), key(f"init={files[1]}")}) == 3
    assert key() == key("init=warm_start")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["backbone=scaffold", "iterations=2"], "backbone=scaffold cannot start from a splat file"),
        (["backbone=octree_gs3d", "backbone.densification=clone_split", "iterations=2"], "a splat file has no levels"),
        (["backbone.sh_degree=1", "iterations=2"], "degree 3, backbone.sh_degree is 1"),
    ],
)
def test_models_that_cannot_begin_with_it_are_refused_before_a_folder(
    trained: Path, tmp_path: Path, words: list[str], told: str
) -> None:
    with pytest.raises((ConfigError, InputError), match=told):
        start(tiny_settings(tmp_path / "run", f"init={trained / 'point_cloud.ply'}", *words), plugins())
    assert not (tmp_path / "run").exists()


def test_wrong_values_of_init(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="init is 'warmstart'; choose scratch, warm_start, or a splat file"):
        compose(["init=warmstart"], plugins())
    with pytest.raises(ConfigError, match="iterations is 0; give 1 or more steps, or init=FILE"):
        compose(["iterations=0"], plugins())
    with pytest.raises(InputError, match="does not exist"):
        start(tiny_settings(tmp_path / "run", f"init={tmp_path / 'none.ply'}"), plugins())
    empty = read_gaussians_of_nothing()
    write_gaussians(tmp_path / "empty.ply", empty)
    with pytest.raises(InputError, match="holds no splats"):
        start(tiny_settings(tmp_path / "run", f"init={tmp_path / 'empty.ply'}"), plugins())


def read_gaussians_of_nothing():
    from gsx.core.gaussians.splats import Gaussians

    return Gaussians(
        means=torch.zeros(0, 3), log_scales=torch.zeros(0, 3), quats=torch.zeros(0, 4), opacity_logits=torch.zeros(0),
        sh_dc=torch.zeros(0, 3), sh_rest=torch.zeros(0, 0, 3),
    )  # fmt: skip


def test_words_for_a_file_that_says_it_is_compensated(trained: Path, tmp_path: Path) -> None:
    gaussians = read_gaussians(trained / "point_cloud.ply")
    write_gaussians(tmp_path / "mip.ply", gaussians, ["SplatRenderMode: mip"])
    words = composition_of(tmp_path / "mip.ply", ["scene=demo"])
    settings = compose(words, plugins())
    assert (settings.raster.dilation, settings.raster.compensate) == (0.1, True)
    assert settings.general.iterations == 0
    own = composition_of(tmp_path / "mip.ply", ["scene=demo", "rasterizer.dilation=0.2"])
    assert compose(own, plugins()).raster.compensate is False
    for word in ("backbone=scaffold", "backbone.filter=mip", "iterations=5", "+experiment=x", "init=scratch"):
        with pytest.raises(ConfigError, match="renders the file as it is"):
            composition_of(tmp_path / "mip.ply", ["scene=demo", word])
    with pytest.raises(ConfigError, match="needs photos"):
        composition_of(tmp_path / "mip.ply", ["eval.zoom=[1]"])
