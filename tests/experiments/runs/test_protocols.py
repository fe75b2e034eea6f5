"""Named protocols against what the sources of papers and programs state."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.resize import training_size
from gsx.core.errors import ConfigError
from gsx.experiments.run_folder.run_key import evaluated_alike, evaluation_settings
from gsx.experiments.runs.compose import Compositions
from gsx.experiments.runs.saved_settings import read_config
from gsx.experiments.runs.settings import Settings

FOLDER = Path(__file__).parents[3] / "conf" / "protocol"
OLD = Path(__file__).parents[2] / "old_run"
INRIA = ("inria", True, "nearest", False, "excluded", "vgg", "unit")
NERFBASELINES = ("valid", True, "down", False, "black", "alex", "signed")
MEASURING = {
    "inria": INRIA,
    "nerfbaselines": NERFBASELINES,
    "nerfstudio": ("valid", False, "nearest", True, "excluded", "alex", "signed"),
    "gsplat": ("torchmetrics", False, "nearest", True, "excluded", "alex", "signed"),
}
"""SSIM, 8 bits, rounding, clamp, masks, network and range of LPIPS."""
PHOTOS, WHITE = {"split": "every:8"}, {"background": [1.0, 1.0, 1.0], "split": "json"}
PAPERS: dict[str, tuple[tuple[Any, ...], str, dict[str, Any], list[float]]] = {
    "inria_outdoors": (INRIA, "colmap", PHOTOS | {"images": "images_4", "downscale": 1}, [1]),
    "inria_indoors": (INRIA, "colmap", PHOTOS | {"images": "images_2", "downscale": 1}, [1]),
    "inria_blender": (INRIA, "blender", WHITE | {"downscale": 1}, [1]),
    "mip_splatting_outdoors": (INRIA, "colmap", PHOTOS | {"images": "images", "downscale": 4}, [1]),
    "mip_splatting_indoors": (INRIA, "colmap", PHOTOS | {"images": "images", "downscale": 2}, [1]),
    "multiscale_train": (INRIA, "blender", WHITE | {"scales": [1, 1, 2, 4, 8], "test_scales": [1, 2, 4, 8]}, [1]),
    "multiscale_train_release": (INRIA, "blender", WHITE | {"test_scales": [1, 2, 4, 8]}, [1]),
    "singlescale_train": (INRIA, "blender", WHITE | {"scales": [1], "test_scales": [1, 2, 4, 8]}, [1]),
    "zoom_in": (INRIA, "colmap", PHOTOS | {"downscale": 8}, [1, 2, 4, 8]),
    "nerfbaselines_outdoors": (NERFBASELINES, "colmap", PHOTOS | {"images": "images_4", "max_width": 0}, [1]),
    "nerfbaselines_indoors": (NERFBASELINES, "colmap", PHOTOS | {"images": "images_2", "max_width": 0}, [1]),
    "nerfbaselines_blender": (NERFBASELINES, "blender", WHITE | {"downscale": 1}, [1]),
    "nerfbaselines_tanks_and_temples": (NERFBASELINES, "colmap", PHOTOS | {"images": "images_2", "max_width": 0}, [1]),
    "scaffold": (INRIA, "colmap", PHOTOS | {"images": "images", "max_width": 1600}, [1]),
    "octree": (INRIA, "colmap", PHOTOS | {"images": "images", "max_width": 1600}, [1]),
    "srgs_mipnerf360": (INRIA, "colmap", PHOTOS | {"images": "images", "downscale": 8}, [1, 4]),
    "srgs_tanks_and_temples": (INRIA, "colmap", PHOTOS | {"images": "images", "downscale": 4}, [1, 4]),
    "srgs_blender": (INRIA, "blender", WHITE | {"downscale": 4}, [1, 4]),
}
"""Measures, scene, its values, zooms."""


def measures(settings: Settings) -> tuple[Any, ...]:
    """What MEASURING lists."""
    e = settings.evaluation
    return e.ssim, e.quantise, e.rounding, e.clamp, e.masks, e.lpips.net, e.lpips.input_range


def test_every_protocol_is_in_these_tables() -> None:
    assert {path.stem for path in FOLDER.glob("*.yaml")} == {*MEASURING, *PAPERS}


def test_protocols_that_measure_fit_any_scene() -> None:
    scenes = [["scene=demo"], ["scene=room"], ["scene=colmap", "scene.path=x"], ["scene=blender", "scene.path=x"]]
    with Compositions(plugins()) as compositions:
        for name, expected in MEASURING.items():
            for scene in scenes:
                assert measures(compositions.settings([*scene, f"protocol={name}"])) == expected, (name, scene)
            assert compositions.protocol(name).preparing == {}


def test_protocols_of_papers_have_the_values_of_their_sources() -> None:
    with Compositions(plugins()) as compositions:
        for name, (measured, scene, values, zooms) in PAPERS.items():
            settings = compositions.settings([f"protocol={name}", "scene.path=x"])
            options = OmegaConf.to_container(OmegaConf.structured(settings.scene.options))
            assert settings.scene.component.name == scene, name
            assert {key: options[key] for key in values} == values, name
            assert (options["resize_filter"], options["resize_light"]) == ("bicubic", "display"), name
            assert measures(settings) == measured, name
            assert list(settings.evaluation.zoom) == zooms, name


def test_they_compose_with_datasets_and_other_scenes_of_photos() -> None:
    with Compositions(plugins()) as compositions:
        settings = compositions.settings(["dataset=mipnerf360", "dataset.scene=counter", "protocol=srgs_mipnerf360"])
        assert settings.scene.options.path.endswith("mipnerf360/counter")
        for scene in ("photos", "transforms", "bungee"):
            settings = compositions.settings([f"scene={scene}", "scene.path=x", "protocol=srgs_mipnerf360"])
            assert (settings.scene.component.name, settings.scene.options.downscale) == (scene, 8)


@pytest.mark.parametrize(
    ("scene", "name", "needed"),
    [
        ("demo", "zoom_in", "colmap"),
        ("blender", "scaffold", "colmap"),
        ("transforms", "inria_outdoors", "colmap"),
        ("colmap", "srgs_blender", "blender"),
        ("room", "multiscale_train_release", "blender"),
    ],
)
def test_a_protocol_for_other_scenes_is_refused_with_the_remedy(scene: str, name: str, needed: str) -> None:
    message = f"protocol={name} is for scene={needed}, not for scene={scene}: choose a protocol that only measures"
    with Compositions(plugins()) as compositions, pytest.raises(ConfigError, match=message):
        compositions.settings([f"scene={scene}", f"protocol={name}"])


@pytest.mark.parametrize(
    ("photo", "small", "large"), [((3115, 2076), (389, 260), (1556, 1040)), ((4946, 3286), (618, 411), (2472, 1644))]
)
def test_sizes_of_srgs(photo: tuple[int, int], small: tuple[int, int], large: tuple[int, int]) -> None:
    """Its log of `counter` states 1040 x 1556; half of the photo would be 1558 x 1038."""
    assert training_size(*photo, downscale=8, max_width=1600) == small
    pose, (width, height) = {"rotation": torch.eye(3), "translation": torch.zeros(3)}, small
    camera = Camera(**pose, fx=5e2, fy=5e2, cx=2e2, cy=1e2, width=width, height=height)
    assert camera.zoom(4).size == large


def test_a_run_is_measured_by_a_protocol() -> None:
    loaded, path = plugins(), OLD / "config.yaml"
    assert measures(read_config(path, loaded, ["protocol=nerfbaselines"])) == NERFBASELINES
    both = read_config(path, loaded, ["eval.ssim=torchmetrics", "eval.zoom=[1,2]", "protocol=inria"])
    assert (both.evaluation.ssim, list(both.evaluation.zoom)) == ("torchmetrics", [1, 2])
    with pytest.raises(ConfigError, match="Unknown protocol 'inrea'"):
        read_config(path, loaded, ["protocol=inrea"])


def test_a_run_that_was_prepared_otherwise_is_refused() -> None:
    loaded, path = plugins(), OLD / "config.yaml"
    scene = OmegaConf.load(path).scene.name
    with pytest.raises(ConfigError, match=f"protocol=srgs_blender is for scene=blender, not for scene={scene}"):
        read_config(path, loaded, ["protocol=srgs_blender"])
    with Compositions(loaded) as compositions:
        config = compositions.composed(["scene=colmap", "scene.path=x", "scene.downscale=4"])
        protocol = compositions.protocol("srgs_mipnerf360")
        with pytest.raises(ConfigError, match=r"sets scene.downscale=8, but runs/a was trained with 4: train anew"):
            protocol.refuse_run(config, "runs/a")
        protocol.refuse_run(compositions.composed(["scene=colmap", "scene.downscale=8"]), "runs/a")


def test_an_evaluation_by_other_rules_is_made_again() -> None:
    """Evaluations from before a rule had a key are by its neutral value."""
    with Compositions(plugins()) as compositions:
        plain, other = (
            evaluation_settings(compositions.settings(words).resolved)
            for words in ([], ["eval.rounding=down", "eval.masks=black"])
        )
    before = json.loads(json.dumps(plain))
    del before["eval"]["rounding"], before["eval"]["masks"]
    assert evaluated_alike(before, plain)
    assert not evaluated_alike(before, other)
    assert not evaluated_alike(before, plain | {"eval": plain["eval"] | {"masks": "black"}})
