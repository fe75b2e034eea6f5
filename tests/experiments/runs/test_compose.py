"""Composition: every file composes, typed options, nearest matches."""

import re
from dataclasses import asdict, replace
from functools import cache
from itertools import zip_longest
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from gsx.builtin import plugins
from gsx.core.errors import ConfigError
from gsx.experiments.evaluation.eval_options import EvalOptions
from gsx.experiments.runs.compose import Compositions, compose, compose_raw
from gsx.experiments.runs.saved_settings import read_config, write_config
from gsx.experiments.runs.settings import Settings
from gsx.experiments.runs.typed import typed
from gsx.scenes.options import SceneOptions

CONF = Path(__file__).parents[3] / "conf"
GROUPS = sorted({path.parent.name for path in CONF.glob("*/*.yaml")} - {"variant", "checks"})
"""Variants are in test_variants.py; checks, which regenerators choose, in test_checks.py."""
APART = ("augmenter", "experiment", "protocol", "rasterizer", "tracker")
"""Groups whose files set nothing that those of another of them set, so that one of each is composed at once."""
NEEDS = {
    ("preset", "scaffold"): ("backbone=scaffold", "scene=blender"),
    ("preset", "octree"): ("backbone=octree_scaffold",),
    ("preset", "zoom"): ("backbone=mip_splatting",),
    ("preset", "clone"): ("backbone=octree_gs3d",),
    ("dataset", "own"): ("+dataset.scenes.yard=Yard", "dataset.scene=yard"),
}
"""What the settings of a dataset are for."""


@cache
def composed(*words: str) -> Settings:
    """What several tests look at and none changes."""
    return compose(words, plugins())


def options_of(group: str) -> list[str]:
    """Names of its files."""
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


@pytest.mark.parametrize("group", [group for group in GROUPS if group not in APART])
def test_every_file_composes_and_fits_its_schema(group: str) -> None:
    with Compositions(plugins()) as compositions:
        for option in options_of(group):
            settings = compositions.settings([*NEEDS.get((group, option.split("_")[0]), ()), f"{group}={option}"])
            if group in ("scene", "backbone"):
                assert getattr(settings, group).component.name == option


def test_groups_that_name_others_have_a_choice() -> None:
    """Hydra 1.4 refuses to interpolate the choice of a group that has none."""
    defaults = OmegaConf.to_container(OmegaConf.load(CONF / "config.yaml").defaults, resolve=False)
    choices = {key: value for entry in defaults if isinstance(entry, dict) for key, value in entry.items()}
    named = {name for value in choices.values() for name in re.findall(r"\$\{(\w+)\}", str(value))}
    assert named == {"backbone", "dataset"}
    assert all(choices[name] for name in named)


def test_every_file_of_what_is_chosen_apart_composes_and_fits_its_schema() -> None:
    with Compositions(plugins()) as compositions:
        for row in zip_longest(*([f"{group}={option}" for option in options_of(group)] for group in APART)):
            chosen = [word.replace("experiment=", "+experiment=") for word in row if word]  # which has no default
            settings = compositions.settings(chosen)
            asked = [word.split("=")[0] for word in chosen]
            assert (len(settings.augmenters), len(settings.trackers)) == (
                asked.count("augmenter"),
                asked.count("tracker"),
            )


def test_what_is_asked_of_one_composition_is_composed_once_and_nobody_changes_it(monkeypatch) -> None:
    words, asked = ["backbone=mip_splatting", "iterations=100"], list[tuple[str, ...]]()
    own = compose(words, plugins()).resolved
    place = "gsx.experiments.runs.compose.compose_raw"
    monkeypatch.setattr(place, lambda words, registry: asked.append(words) or compose_raw(words))
    with Compositions(plugins()) as compositions:
        first = compositions.settings(words)
        compositions.node(words, "training")["batch"] = 7
        first.resolved["training"]["batch"] = 7
        assert compositions.value(words, "training.batch") == 1
        assert compositions.settings(words).resolved == own
        assert compositions.value([*words, "training.batch=2"], "training.batch") == 2
    assert asked == [tuple(words), (*words, "training.batch=2")]


def test_presets_win_over_the_scene_and_the_command_line_over_presets() -> None:
    given = ["scene=blender", "backbone=scaffold", "preset=scaffold_nerf_synthetic"]
    settings = compose(given, plugins())
    assert settings.scene.options.random_points == 10000
    assert settings.backbone.options.growth.coarsest == 4
    assert compose([*given, "scene.random_points=7"], plugins()).scene.options.random_points == 7


@pytest.mark.parametrize(
    ("words", "iterations"),
    [
        (["scene=colmap"], 30000),  # 3D-GS
        (["scene=photos", "backbone=mip_splatting"], 30000),
        (["scene=colmap", "backbone=scaffold"], 30000),
        (["scene=colmap", "backbone=octree_scaffold"], 40000),  # Octree-GS
        (["scene=transforms", "backbone=octree_gs3d"], 40000),
        (["dataset=mipnerf360", "dataset.scene=garden", "backbone=octree_scaffold"], 40000),
        (["scene=colmap", "backbone=octree_scaffold", "backbone.published_iterations=50000"], 50000),  # as a preset may
        (["scene=colmap", "backbone=octree_scaffold", "budget=quick"], 2000),  # a twentieth
        (["scene=colmap", "budget=quick"], 1500),
        (["scene=colmap", "backbone=octree_scaffold", "scene.iterations=700"], 700),
        (["scene=colmap", "variant=octree_ub"], 40000),
        (["scene=colmap", "variant=octree_ub", "iterations=5"], 5),
        ([], 900),  # the built-in scene
        (["backbone=octree_scaffold"], 900),
        (["budget=quick"], 45),
        (["dataset=demo", "variant=octree_ub", "budget=quick"], 2000),
    ],
)
def test_a_run_is_as_long_as_its_method_was_published(words: list[str], iterations: int) -> None:
    assert composed(*words).general.iterations == iterations


def test_a_backbone_that_names_no_length_is_run_as_long_as_3d_gs() -> None:
    assert compose_length(["scene=colmap", "~backbone.published_iterations"]) == 30000


def compose_length(words: list[str]) -> int:
    with Compositions(plugins()) as compositions:
        return int(compositions.value(words, "iterations"))


def test_published_values_of_gs3d() -> None:
    options = composed("backbone=gs3d").backbone.options
    assert (options.rates.means_first, options.rates.means_last) == (1.6e-4, 1.6e-6)
    assert options.rates.sh_rest == pytest.approx(options.rates.sh_dc / 20)
    density = options.density
    assert (density.start, density.stop, density.every, density.reset_every) == (500, 15000, 100, 3000)


@pytest.mark.parametrize("backbone", ["gs3d", "mip_splatting"])
def test_the_preset_for_zooming_in_holds_for_both_forms_of_gaussians(backbone: str) -> None:
    plain, zoom = composed(f"backbone={backbone}"), composed(f"backbone={backbone}", "preset=zoom")
    assert (plain.modules["supersampling"].options.factor, plain.backbone.options.rates.shortened) == (1, 0.0)
    assert (zoom.modules["supersampling"].options.factor, zoom.modules["supersampling"].options.start) == (2, 0.8)
    assert (zoom.backbone.options.filter, zoom.backbone.options.rates.shortened) == ("mip", 0.4)
    published = composed(f"backbone={backbone}", "preset=zoom", "iterations=30000").backbone.options
    assert published.rates == replace(plain.backbone.options.rates, shortened=0.4)  # the same where nothing is shorter


def test_plain_gsx_trains_for_zooming_in_and_3d_gs_is_one_word_away() -> None:
    default, spelt, plain = composed(), composed("backbone=gs3d", "preset=zoom"), composed("backbone=gs3d")
    assert default.backbone.component.name == "gs3d_zoom"
    assert replace(default.backbone.options, name="gs3d") == spelt.backbone.options
    assert default.training == spelt.training
    assert (plain.backbone.options.filter, plain.modules["supersampling"].options.factor) == ("none", 1)
    assert plain.backbone.options.rates.shortened == 0


def test_compositions_share_nothing_that_can_be_changed() -> None:
    """What was checked once is not checked again, but each gets its own; a number of another type is another."""
    words = ["backbone=gs3d", "eval.zoom=[1,2]"]
    first, second = compose(words, plugins()), compose(words, plugins())
    assert first.evaluation == second.evaluation
    first.evaluation.zoom.append(8.0)
    assert second.evaluation.zoom == compose(words, plugins()).evaluation.zoom == [1.0, 2.0]
    assert typed(EvalOptions, asdict(second.evaluation) | {"tile_pixels": 4096}, "eval").tile_pixels == 4096
    with pytest.raises(ConfigError, match="tile_pixels"):
        typed(EvalOptions, asdict(second.evaluation) | {"tile_pixels": 4096.0}, "eval")


def test_a_run_folders_configuration_looks_nothing_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Written by somebody else it could ask for a secret of the machine that it is opened on."""
    monkeypatch.setenv("GSX_SECRET", "hush")
    resolved = compose(["tracker=mlflow"], plugins()).resolved
    write_config(tmp_path / "config.yaml", resolved)
    assert read_config(tmp_path / "config.yaml", plugins()).resolved == resolved
    secret = "http://x/${oc.env:GSX_SECRET}"
    for key, more in (
        ("output", {"output": secret}),
        ("tracker.mlflow.uri", {"tracker": {"mlflow": {"uri": secret}}}),
        ("eval.zoom.1", {"eval": {"zoom": [1, secret]}}),
        ("backbone.a.b.0", {"backbone": {"a.b": [secret]}}),
    ):
        (tmp_path / "config.yaml").write_text(OmegaConf.to_yaml(OmegaConf.merge(resolved, more)))
        with pytest.raises(ConfigError, match=rf"{key} is '.*oc.env:GSX_SECRET.*'; .* plain values") as caught:
            read_config(tmp_path / "config.yaml", plugins())
        assert "hush" not in str(caught.value)


def test_common_scene_defaults_agree_with_the_schema() -> None:
    values = OmegaConf.to_container(OmegaConf.load(CONF / "images.yaml"))
    built = SceneOptions(name="x", background=[0, 0, 0], **values)
    assert built == SceneOptions(name="x", background=[0, 0, 0])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["backbone=gs3"], "Unknown backbone 'gs3'. .*Did you mean 'gs3d'"),
        (["scene=colmop"], "Did you mean 'colmap'"),
        (["scene.pth=x"], "Unknown key 'scene.pth'. Did you mean 'scene.path'"),
        (["itterations=5"], "Unknown key 'itterations'. Did you mean 'iterations'"),
        (["+steps=5"], "Unknown key 'steps'"),
        (["trunk_gb=5"], "Unknown key 'trunk_gb'. It has been removed"),
        (["backbone.rates.sh_constant=1"], "It is now called 'backbone.rates.sh_dc'"),
        (["init=trunk"], "choose scratch, warm_start, or a splat file"),
        (["+backbone.rates.mean_first=1"], "'backbone.rates.mean_first'.*Did you mean 'backbone.rates.means_first'"),
        (["iterations=many"], "iterations is 'many'; give a whole"),
        (["backbone.sh_degree=abc"], "backbone.sh_degree is 'abc'; give a whole number from 0 to 3"),
        (["backbone.density.gradient=[1]"], "backbone.density.gradient"),
        (["backbone.name=mine"], "backbone.name is 'mine'"),
        (["rasterizer.cull=loose"], "rasterizer.cull is 'loose'"),
        (["rasterizer.tile_size=5"], "must divide 16"),
        (["eval.zoom=2"], "eval.zoom"),
        (["scene=[demo"], "override cannot be read"),
        (["nonsense"], "override cannot be read"),
        (["eval.ssim=inira"], "eval.ssim is 'inira'; choose from inria"),
        (["eval.zoom=[0]"], "eval.zoom is \\[0.0\\]; give a number from 0.015625 to 64"),
        (["eval.tile_pixels=-4"], "eval.tile_pixels is -4"),
        (["training.log_every=0"], "training.log_every is 0"),
        (["training.checkpoints_kept=0"], "training.checkpoints_kept is 0"),
        (["backbone.sh_degree=4"], "backbone.sh_degree is 4; give a number from 0 to 3"),
        (["backbone.initial_opacity=1"], "backbone.initial_opacity is 1.0; give a number from 1e-06 to 0.999999"),
        (["backbone.rates.means_first=0"], "must be positive"),
        (["backbone.rates.shortened=2"], "backbone.rates.shortened is 2.0; give a number from 0 to 1"),
        (["backbone.rates.opacity_logits=nan"], "backbone.rates.opacity_logits is nan; give a finite number"),
        (["eval.zoom=[1,inf]"], "eval.zoom is inf; give a finite number"),
        (["scene.downscale=-inf"], "scene.downscale"),
        (["training.test_points=-1"], "training.test_points is -1"),
        (["seed=-1"], "seed is -1; give a number from 0"),
        (["seed=9223372036854775808"], "seed"),
        (["warm_start_at=[0]"], "warm_start_at is \\[0\\]; give a number from 1"),
        (["training.supersampling.start=1"], "training.supersampling.start is 1.0; set a share of the steps"),
        (["backbone=scaffold", "preset=zoom"], "Unknown key 'backbone.rates.shortened'"),
        (["rasterizer.dilation=0"], "rasterizer.dilation is 0"),
        (["minutes=ten"], "^minutes is 'ten'; give a number from 0 to 1,000,000, such as minutes=10$"),
        (["iterations=1k"], "^iterations is '1k'; give a whole number from 0 to 1,000,000,000, such as iterations=10$"),
        (["output=[a]"], r"^output is \['a'\]; give text$"),
        (["seed=null"], "^seed is null; give a whole number"),
        (["reuse=maybe"], "^reuse is 'maybe'; give true or false$"),
        (["eval.zoom=0"], r"^eval.zoom is 0; give a list of numbers from 0.015625 to 64, such as 'eval.zoom=\[1,2\]'$"),
        (["eval.zoom=[1,b]"], r"^eval.zoom is \[1, 'b'\]; give a list of numbers"),
        (
            ["regenerator.upscale.x2=a.param", "regenerator/upscale=ncnn"],
            r"upscale\.x2 is a group of settings",
        ),
        (["output=${oc.env:GSX_UNSET_VARIABLE}/x"], "cannot be resolved"),
    ],
)
def test_mistakes_are_named_with_a_remedy(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(overrides, plugins())


def test_a_component_without_a_file_is_named() -> None:
    loaded = plugins()
    loaded.registry.provider = "sharp"
    for kind in ("regenerator", "backbone"):
        loaded.registry.add(kind, "doubled", object, dict)
    for group in ("regenerator/upscale", "backbone"):
        message = (
            f"plugin sharp registers {group.partition('/')[0]} 'doubled', but no {group}/doubled.yaml is installed"
        )
        with pytest.raises(ConfigError, match=message):
            compose([f"{group}=doubled"], loaded)


def test_a_number_for_a_text_is_not_silently_taken() -> None:
    with pytest.raises(ConfigError, match=r"scene\.downscale"):
        typed(SceneOptions, {"name": "x", "background": [0, 0, 0], "downscale": 1.5}, "scene")


def test_a_path_below_the_home_folder_needs_no_quotes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A shell leaves `~` within a word as it is, and Hydra's grammar has none."""
    monkeypatch.setenv("HOME", str(tmp_path))
    assert compose(["scene=colmap", "scene.path=~/photos"], plugins()).scene.options.path == str(tmp_path / "photos")


def test_a_folder_named_by_a_number_is_a_folder() -> None:
    assert compose(["scene=colmap", "scene.path=2024"], plugins()).scene.options.path.endswith("/2024")


def test_settings_that_a_run_is_older_than_can_be_asked_for(tmp_path: Path) -> None:
    config = compose(["backbone=mip_splatting", "augmenter=upscale"], plugins()).resolved
    del config["eval"]["colours"], config["training"]["exposure"], config["backbone"]["mip"]["views"]
    del config["eval"]["poses"], config["training"]["poses"]
    del config["metrics"]["perceptual"], config["metrics"]["perceptual_pixels"]
    del config["scene"]["disturb"], config["augmenter"]["upscale"]["weight_map"]
    write_config(tmp_path / "config.yaml", config)
    words = ["eval.colours=fitted", "training.exposure.when=always", "backbone.mip.views=2", "scene.disturb.pose=2"]
    words += ["augmenter.upscale.weight_map=none", "eval.poses=aligned", "training.poses.when=auto"]
    assert read_config(tmp_path / "config.yaml", plugins(), words).evaluation.perceptual == []
    settings = read_config(tmp_path / "config.yaml", plugins(), [*words, "metrics.perceptual=[niqe]"])
    assert (settings.evaluation.colours, settings.modules["exposure"].options.when) == ("fitted", "always")
    assert (settings.evaluation.poses, settings.modules["poses"].options.when) == ("aligned", "auto")
    assert (settings.evaluation.perceptual, settings.evaluation.perceptual_pixels) == (["niqe"], 131072)
    assert settings.backbone.options.mip.views == 2
    assert settings.resolved["eval"]["colours"] == "fitted"
    with pytest.raises(ConfigError, match=r"Did you mean 'eval.colours'"):
        read_config(tmp_path / "config.yaml", plugins(), ["eval.colors=fitted"])
    with pytest.raises(ConfigError, match=r"Unknown key 'eval.lpips.net'"):
        read_config(tmp_path / "config.yaml", plugins(), ["eval.lpips.net=alex"])
    with pytest.raises(ConfigError, match=r"metrics.perceptual has 'niqee'; choose from st_lpips_alex, "):
        read_config(tmp_path / "config.yaml", plugins(), [*words, "metrics.perceptual=[niqee]"])
    with pytest.raises(ConfigError, match=r"metrics.perceptual is 'niqe'; give a list of texts, such as 'metrics"):
        read_config(tmp_path / "config.yaml", plugins(), [*words, "metrics.perceptual=niqe"])
    (tmp_path / "list.yaml").write_text("- 1\n")
    with pytest.raises(ConfigError):
        read_config(tmp_path / "list.yaml", plugins(), ["eval.colours=fitted"])


def test_runs_of_an_older_gsx_open_and_know_newer_rasterizer_settings(tmp_path: Path) -> None:
    config = compose(["rasterizer.tile_size=16"], plugins()).resolved
    del config["rasterizer"]["tile_cap"], config["rasterizer"]["path"]
    write_config(tmp_path / "config.yaml", config)
    settings = read_config(tmp_path / "config.yaml", plugins(), ["rasterizer.tile_cap=64"])
    assert (settings.raster.tile_size, settings.raster.tile_cap, settings.raster.path) == (16, 64, "eager")
    with pytest.raises(ConfigError, match=r"Did you mean 'rasterizer.tile_cap'"):
        read_config(tmp_path / "config.yaml", plugins(), ["rasterizer.tile_cp=64"])
