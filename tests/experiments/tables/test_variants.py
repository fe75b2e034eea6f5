"""Named methods against the paper's text (supplementary), all at the published length."""

from typing import Any

import pytest
from regenerating import noisy
from tiny import tiny_settings

from gsx.augmenters.pseudo_options import PseudoOptions
from gsx.builtin import plugins
from gsx.core.training.augmenter import KnownStart
from gsx.core.training.run import Run
from gsx.experiments.run_folder.run_key import composition_key
from gsx.experiments.runs.compose import Compositions, listed
from gsx.experiments.runs.open import start
from gsx.experiments.runs.settings import Settings

UP = "augmenter.upscale."
BOOT = "augmenter.bootstrap."
TURBO = "sdxl_turbo"
OCTREE_UB = {
    "iterations": 40000,
    "backbone.name": "octree_scaffold",
    "backbone.growth.stop": 25000,
    f"{UP}timing": {
        "published_iterations": 40000, "start": 22000, "stop": 38000, "every": 2000, "span": 1000,
        "stop_inclusive": True,
    },
    f"{UP}scales": [2], f"{UP}variants": 2, f"{UP}base": True, f"{UP}narrow": 0.5, f"{UP}weights": [0.10, 0.05],
    f"{UP}rotation_noise": 0.2, f"{UP}translation_noise": 0.0, f"{UP}seed": 22, f"{UP}loss": "l1", f"{UP}mode": "auto",
    f"{BOOT}timing": {
        "published_iterations": 40000, "start": 20000, "stop": 38000, "every": 2000, "span": 750,
        "stop_inclusive": True,
    },
    f"{BOOT}variants": 2, f"{BOOT}narrow": 0.4, f"{BOOT}weights": [0.15, 0.10], f"{BOOT}strength": [0.06, 0.01],
    f"{BOOT}rotation_noise": 0.2, f"{BOOT}translation_noise": 0.1, f"{BOOT}freeze_shared": "none",
    "regenerator.upscale.name": "sd_x2_latent", "regenerator.upscale.steps": 15, "regenerator.upscale.guidance": 1.0,
    "regenerator.restore.name": TURBO, "regenerator.restore.steps": 0, "regenerator.restore.tuning.steps": 1000,
}  # fmt: skip
DELTAS: dict[str, dict[str, Any]] = {
    "octree_ub": {},
    "octree_ub_raw": {"regenerator.restore.tuning.steps": 0},
    "octree_ub_prompt_1": {
        "regenerator.restore.tuning.steps": 0, f"{BOOT}prompt": "professional graph with fine-grained details",
    },
    "octree_ub_prompt_2": {
        "regenerator.restore.tuning.steps": 0,
        f"{BOOT}prompt": "{scene}, sharp, denoise, original content, natural, detailed, 8k",
    },
    "octree_ub_infer_1": {},
    "octree_ub_infer_n": {"regenerator.restore.steps": 100},
    "octree_ub_var_1": {f"{BOOT}variants": 1},
    "octree_ub_var_3": {f"{BOOT}variants": 3},
    "octree_ub_uncropped": {f"{BOOT}narrow": 1.0},
    "octree_ub_start_15k": {f"{BOOT}timing": OCTREE_UB[f"{BOOT}timing"] | {"start": 15000}},
    "octree_ub_start_10k": {f"{BOOT}timing": OCTREE_UB[f"{BOOT}timing"] | {"start": 10000}},
    "octree_ub_loss_plus": {f"{BOOT}weights": [0.25, 0.20]},
    "octree_ub_de_mlp": {
        f"{BOOT}timing": OCTREE_UB[f"{BOOT}timing"] | {"start": 10000}, f"{BOOT}freeze_shared": "active",
    },
}  # fmt: skip
"""Differences from Octree-UB (table 5)."""
OTHERS: dict[str, dict[str, Any]] = {
    "3d_gs": {"iterations": 40000, "backbone.name": "gs3d", "augmenter": {}},
    "mip_splatting": {"iterations": 40000, "backbone.filter": "mip", "augmenter": {}},
    "scaffold_gs": {"iterations": 40000, "backbone.name": "scaffold", "augmenter": {}},
    "octree_gs": {"iterations": 40000, "backbone.name": "octree_scaffold", "augmenter": {}},
    "octree_gs_7": {"iterations": 70000, "backbone.growth.stop": 25000, "backbone.published_iterations": 70000,
                    "backbone.decay_until": 40000, "augmenter": {}},
    "octree_3d_gs": {"iterations": 40000, "backbone.name": "octree_gs3d", "backbone.densification": "anchors",
                     "backbone.growth.observe_from": 1500, "backbone.growth.stop": 25000, "augmenter": {}},
    "octree_up": {f"{UP}scales": [2], f"{UP}first_cameras": 0, "regenerator.upscale.name": "sd_x2_latent"},
    "octree_upx2": {f"{UP}scales": [2], f"{UP}first_cameras": 100, "regenerator.upscale.name": "sd_x2_latent"},
    "octree_upx4": {f"{UP}scales": [2, 4], f"{UP}first_cameras": 100, "regenerator.upscale.name": "sd_by_scale"},
    "octree_upx2_l_plus": {f"{UP}mode": "direct", f"{UP}direct_weight": 1.0, f"{UP}scales": [2]},
    "octree_upx4_l_plus": {f"{UP}mode": "direct", f"{UP}direct_weight": 1.0, f"{UP}scales": [2, 4]},
    "octree_upx2_var_1": {f"{UP}variants": 1}, "octree_upx4_var_1": {f"{UP}variants": 1},
    "octree_upx2_var_3": {f"{UP}variants": 3}, "octree_upx4_var_3": {f"{UP}variants": 3},
    "octree_upx2_uncropped": {f"{UP}narrow": 1.0}, "octree_upx4_uncropped": {f"{UP}narrow": 1.0},
    "up_3dgs": {"iterations": 30000, "backbone.name": "gs3d", f"{UP}scales": [4, 8], f"{UP}mode": "direct",
                "backbone.density.start": 1500, "regenerator.upscale.name": "sd_by_scale"},
    "up_mip": {"iterations": 30000, "backbone.name": "mip_splatting", f"{UP}scales": [4, 8], f"{UP}mode": "direct"},
    "3d_gs_up": {"iterations": 40000, "backbone.name": "gs3d", f"{UP}scales": [2], f"{UP}mode": "direct"},
    "3d_gs_b": {"iterations": 30000, f"{BOOT}narrow": 0.4, f"{BOOT}timing.start": 6000, f"{BOOT}timing.every": 3000},
    "3d_gs_ub": {"iterations": 40000, f"{UP}mode": "direct", f"{BOOT}timing.start": 20000, "backbone.name": "gs3d"},
    "oct_3dgs_up": {"backbone.name": "octree_gs3d", f"{UP}mode": "direct"},
    "oct_3dgs_ub": {"backbone.name": "octree_gs3d", f"{UP}mode": "direct", f"{BOOT}narrow": 0.4},
    "bootstrap_gs": {"iterations": 30000, "backbone.name": "gs3d", "augmenter.bootstrap_original.narrow": 1.0,
                     "augmenter.bootstrap_original.gain": 3.0, "regenerator.restore.guidance": 2.0},
    "mipmap_gs": {"backbone.name": "gs3d", "augmenter.mipmap.base_source": "render",
                  "augmenter.mipmap.coarser": [2, 4]},
}  # fmt: skip


@pytest.fixture(scope="module")
def composed() -> dict[str, Settings]:
    """Every variant on one scene of its own."""
    with Compositions(plugins()) as compositions:
        return {name: compositions.settings([f"variant={name}"]) for name in listed("variant")}


def at(config: dict[str, Any], key: str) -> Any:
    """A value by its dotted key."""
    for part in key.split("."):
        config = config[part]
    return config


@pytest.mark.parametrize("name", DELTAS)
def test_ablations_differ_from_octree_ub_as_the_paper_says(name: str, composed: dict[str, Settings]) -> None:
    config = composed[name].resolved
    for key, value in (OCTREE_UB | DELTAS[name]).items():
        assert at(config, key) == value, key


@pytest.mark.parametrize("name", OTHERS)
def test_other_methods_are_composed_as_the_paper_says(name: str, composed: dict[str, Settings]) -> None:
    for key, value in OTHERS[name].items():
        assert at({"augmenter": {}} | composed[name].resolved, key) == value, key


def test_every_variant_is_looked_at_and_says_its_name(composed: dict[str, Settings]) -> None:
    long = {f"octree_gs_{k}" for k in (5, 6, 7, 8)}
    assert set(composed) == set(DELTAS) | set(OTHERS) | long
    for name, settings in composed.items():
        assert settings.general.variant == name
        assert settings.backbone.options.max_primitives == 0  # published runs have no cap
    assert [composed[name].general.iterations for name in sorted(long)] == [50000, 60000, 70000, 80000]


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run whose windows are wide enough for x8."""
    words = ("scene.width=112", "scene.height=84", "rasterizer=eager")
    return start(tiny_settings(tmp_path_factory.mktemp("runs") / "wide", *words), plugins())


def test_what_an_autoencoder_does_to_pictures_goes_through_every_variant(
    composed: dict[str, Settings], wide: Run
) -> None:
    """The paper's models see their input through one that reconstructs to 23.4 +- 3.8 dB (kl-f8): here 20 dB."""
    tried: list[PseudoOptions] = []
    for settings in composed.values():
        for name, chosen in settings.augmenters.items():
            checks = chosen.options.checks
            assert {check.action for check in (checks.colour, checks.agreement, checks.displacement)} == {"warn"}
            if chosen.options in tried:
                continue
            tried.append(chosen.options)
            augmenter = noisy(chosen.options, name, wide)
            wide.step = augmenter.event = augmenter.events[0]
            _, facts = augmenter.made(wide, augmenter.event, {0})
            assert sum(facts["asked"].values()) > 0
            assert facts["dropped"] == {}
    assert len(tried) > 10


def test_where_pseudo_views_begin_is_foretold(composed: dict[str, Settings]) -> None:
    def begins(name: str) -> int:
        settings = composed[name]
        options = [chosen.options for chosen in settings.augmenters.values()]
        assert all(isinstance(option, KnownStart) for option in options)
        return min(option.begins(settings.general.iterations) for option in options)

    expected = {"octree_up": 22000, "octree_ub": 20000, "octree_ub_start_15k": 15000, "octree_ub_de_mlp": 10000,
                "up_3dgs": 16500, "3d_gs_b": 6000}  # fmt: skip
    assert {name: begins(name) for name in expected} == expected


def test_the_same_training_has_the_same_key_and_no_other(composed: dict[str, Settings]) -> None:
    keys: dict[str, list[str]] = {}
    for name, settings in composed.items():
        keys.setdefault(composition_key(settings.resolved, "", settings.idle), []).append(name)
    assert [names for names in keys.values() if len(names) > 1] == [["octree_ub", "octree_ub_infer_1"]]


def test_datasets_bring_the_numbers_of_their_scripts_and_budgets_shorten() -> None:
    with Compositions(plugins()) as compositions:
        deep = compositions.settings(["dataset=deep_blending", "variant=octree_ub", "dataset.scene=playroom"]).resolved
        scaffold = compositions.settings(["dataset=tanks_and_temples", "variant=scaffold_gs"]).resolved
        quick = compositions.settings(["dataset=demo", "variant=octree_gs_5", "budget=quick"]).resolved
        more = compositions.settings(["dataset=demo", "variant=octree_gs_5", "budget=quick", "iterations=7"]).resolved
    assert deep["backbone"]["levels"]["base_layer"] == 12
    assert deep["scene"]["path"].endswith("data/db/playroom")
    assert scaffold["backbone"]["voxel"] == 0.01
    assert quick["iterations"] == 2500  # a twentieth of 50,000
    assert quick["regenerator"]["restore"]["name"] == "scene_restorer"
    assert more["iterations"] == 7
