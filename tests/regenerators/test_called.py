"""A function as a regenerator."""

import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import StopAfter, tiny_run, tiny_settings
from torch import Tensor

from gsx.builtin import plugins
from gsx.cli.dispatch import main
from gsx.core.data.camera import Camera, look_at
from gsx.core.data.reduction import as_blocks
from gsx.core.data.scene import View
from gsx.core.errors import ConfigError, TrainingError
from gsx.experiments.runs.job import train
from gsx.regenerators.classical import Called, CalledOptions

PROMPTS: list[str] = []
SMALL = ["iterations=12", "scene.points=100", "eval.zoom=[1]"]


def blocks(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float, level: float = 0) -> Tensor:
    """Every pixel as a block."""
    PROMPTS.append(prompt)
    return as_blocks(image, scale) + level


def test_a_function_redraws_the_views_of_a_run(tmp_path: Path) -> None:
    """It receives the prompt, with the name of the scene; an empty one in the trial before training."""
    PROMPTS.clear()
    words = [*SMALL, "augmenter=upscale", "augmenter.upscale.prompt='{scene}, sharp'"]
    words += ["regenerator/upscale=callable", "regenerator.upscale.function=test_called:blocks"]
    tiny_run(tmp_path / "run", words)
    assert set(PROMPTS) == {"", "demo, sharp"}
    assert PROMPTS[:2] == ["", ""]
    made = json.loads((tmp_path / "run" / "pseudo" / "index.json").read_text())["views"]
    assert made
    assert all(view["consistent"] == 1 for view in made if view["scale"] == 2)


def stray(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float) -> Tensor:
    """An upscaler that invents too much: its box average is far from its input."""
    noise = torch.rand(3, *(scale * side for side in image.shape[1:]), generator=torch.Generator().manual_seed(seed))
    return as_blocks(image, scale) + 0.4 * (noise - 0.5)


def test_projection_saves_pictures_of_an_upscaler_that_strays(tmp_path: Path) -> None:
    """Of photographs and of renders; without it the run ends, and says what to set."""
    words = [*SMALL, "augmenter=upscale_paper", "regenerator/upscale=callable"]
    words += ["regenerator.upscale.function=test_called:stray"]
    words += [f"augmenter.upscale.checks.agreement.{word}" for word in ("action=drop", "limit=30")]
    with pytest.raises(TrainingError, match=r"dB from its input.*augmenter.upscale.project=exact"):
        tiny_run(tmp_path / "strays", words)
    tiny_run(tmp_path / "projected", [*words, "augmenter.upscale.project=exact"])
    made = json.loads((tmp_path / "projected" / "pseudo" / "index.json").read_text())["views"]
    assert {view["source"] for view in made} == {"photo", "render"}
    assert all(view["consistent"] == 1 for view in made if view["source"] == "photo")


def test_a_finished_run_is_looked_at_without_its_regenerator(tmp_path: Path) -> None:
    """It may have been trained elsewhere; going on with it is refused."""
    words = [*SMALL, "augmenter=upscale", "regenerator/upscale=callable"]
    run = tiny_run(tmp_path / "run", [*words, "regenerator.upscale.function=test_called:blocks"])
    config = run.folder / "config.yaml"
    config.write_text(config.read_text().replace("test_called:blocks", "no_longer:there"))
    assert main(["eval", str(run.folder)]) == 0
    assert main(["resume", str(run.folder), "iterations=14"]) == 2


def test_code_that_a_folder_names_runs_only_where_it_is_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command that an interrupted run ends with says so; a word on the command line is trust enough."""
    (tmp_path / "theirs.py").write_text(
        "from pathlib import Path\nPath('was_here').touch()\nfrom test_called import blocks\n"
    )
    monkeypatch.chdir(tmp_path)
    words_ = [*SMALL, "augmenter=upscale", "regenerator/upscale=callable"]
    named = "regenerator.upscale.function=theirs:blocks"
    loaded, settings = plugins(), tiny_settings(tmp_path / "run", *words_, named)
    with loaded.listening([StopAfter(3)]):
        train(settings, loaded, [])
    assert f"gsx resume {tmp_path / 'run'} --trust" in capsys.readouterr().err
    for name in ("once", "twice"):
        shutil.copytree(tmp_path / "run", tmp_path / name)
    sys.modules.pop("theirs")
    (tmp_path / "was_here").unlink()
    assert main(["resume", str(tmp_path / "run")]) == 2
    assert "runs code with your permissions, regenerator.upscale: 'theirs:blocks'" in capsys.readouterr().err
    assert main(["resume", str(tmp_path / "run"), "regenerator.upscale.arguments={a: 'theirs:blocks2'}"]) == 2
    assert "runs code" in capsys.readouterr().err
    assert not (tmp_path / "was_here").exists()
    assert main(["resume", str(tmp_path / "once"), "--trust"]) == 0
    assert main(["resume", str(tmp_path / "twice"), "regenerator.upscale.function='theirs:blocks'"]) == 0
    assert (tmp_path / "was_here").exists()


def test_no_module_of_the_working_directory_takes_the_place_of_an_installed_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """colorsys is of the standard library, and imported by nobody here."""
    (tmp_path / "colorsys.py").write_text("raise AssertionError('run')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry])
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    before = list(sys.path)
    options = CalledOptions(name="callable", function="colorsys:rgb_to_hsv", arguments={})
    assert callable(Called(options).function())
    assert sys.path == before


@pytest.mark.parametrize("function", ["", "os", "os:no_such", "no_such_module:f", "os:name"])
def test_what_is_no_function_is_refused(function: str) -> None:
    """Before training."""
    with pytest.raises(ConfigError, match=f"function(=| is ').*{function}"):
        Called(CalledOptions(name="callable", function=function, arguments={})).check([], [2], False)


SHAPES: list[tuple[int, ...]] = []


def doubled(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float) -> Tensor:
    """A network that only doubles."""
    SHAPES.append((scale, *image.shape[1:]))
    return as_blocks(image, 2)


def failing(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float) -> Tensor:
    raise RuntimeError("scale 1 has no weights\nin this folder")


def infinite(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float) -> Tensor:
    image[0, 0, :3] = torch.inf
    return as_blocks(image, scale)


def bytes_of(image: Tensor, *, scale: int, prompt: str, seed: int, strength: float) -> Tensor:
    return (as_blocks(image, scale) * 255).to(torch.uint8)


def nothing(image: Tensor, **_: object) -> None:
    torch.rand(1)


@dataclass(frozen=True)
class Grey:
    """A photograph of one grey."""

    def image(self, camera: Camera) -> Tensor:
        return torch.full((3, camera.height, camera.width), 100, dtype=torch.uint8)

    def max_zoom(self, camera: Camera) -> float:
        return 1.0


def view(width: int, height: int) -> View:
    camera = look_at((0.0, -3.0, 1.0), (0.0, 0.0, 0.0), fov_x=0.9, width=width, height=height)
    return View("first", camera, Grey())


def called(function: str) -> Called:
    return Called(CalledOptions(name="callable", function=f"test_called:{function}", arguments={}))


LEAVE_OUT = r"augmenter\.NAME\.scales=\[2\] leaves out 1, or return the image itself for scale=1$"


@pytest.mark.parametrize(("function", "scales", "words"), [
    ("doubled", [1, 2], r"scale=1 returned a tensor \[3, 128, 96\], not \[3, 64, 48\]: " + LEAVE_OUT),
    ("doubled", [2, 4], r"scale=4 .*\[3, 256, 192\].*scales=\[2\] leaves out 4, or correct .* scale=4$"),
    ("failing", [1, 2], r"scale=1 raised RuntimeError: scale 1 has no weights: " + LEAVE_OUT),
    ("infinite", [1], r"scale=1 returned 3 values that are not finite: return the image itself for scale=1$"),
    ("bytes_of", [2], r"scale=2 returned uint8, not display values in \[0, 1\]: correct the function for scale=2$"),
    ("nothing", [1, 2], r"scale=1 returned NoneType, not a tensor \[3, 64, 48\]: " + LEAVE_OUT),
])  # fmt: skip
def test_a_function_that_fails_at_a_scale_is_refused_before_training(
    function: str, scales: list[int], words: str
) -> None:
    with pytest.raises(ConfigError, match=f"test_called:{function} tried with {words}"):
        called(function).check([view(48, 90)], scales, False)


def test_a_function_is_tried_on_a_part_of_the_first_view_without_a_trace() -> None:
    """64 px wide and high at most, smaller views whole; numbers and pictures of training stay as they are."""
    SHAPES.clear()
    first = view(100, 70)
    for one in (first, view(40, 30)):
        called("doubled").check([one, view(8, 8)], [2], False)
    assert SHAPES == [(2, 64, 64), (2, 30, 40)]
    state = torch.get_rng_state()
    for function in ("nothing", "infinite"):
        with pytest.raises(ConfigError):
            called(function).check([first], [1], False)
    assert torch.equal(torch.get_rng_state(), state)
    assert bool((first.image() == 100 / 255).all())


def test_a_run_with_a_function_that_only_doubles_ends_before_its_first_step(tmp_path: Path) -> None:
    words = [*SMALL, "augmenter=upscale", "regenerator/upscale=callable"]
    words += ["regenerator.upscale.function=test_called:doubled"]
    with pytest.raises(ConfigError, match="scale=1 returned a tensor"):
        tiny_run(tmp_path / "both", words)
    assert not (tmp_path / "both" / "metrics.jsonl").exists()
    run = tiny_run(tmp_path / "doubled", [*words, "augmenter.upscale.scales=[2]"])
    assert run.step == 12


def test_a_function_beside_the_user_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the working directory, which an installed command does not look into by itself."""
    (tmp_path / "beside_me.py").write_text("def same(image, **more):\n    return image\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [entry for entry in sys.path if entry])
    called = Called(CalledOptions(name="callable", function="beside_me:same", arguments={}))
    assert called.function()(3) == 3
    assert str(tmp_path) not in sys.path


def test_arguments_are_passed_on(tmp_path: Path) -> None:
    """As they stand in the configuration."""
    words = ["augmenter=upscale", "regenerator/upscale=callable", "regenerator.upscale.function=test_called:blocks"]
    options: Any = tiny_settings(tmp_path, *words, "+regenerator.upscale.arguments.level=0.5")
    assert options.regenerators["upscale"].options.arguments == {"level": 0.5}
    with pytest.raises(ConfigError, match=r"one by one: '\+regenerator.upscale.arguments.NAME=VALUE'"):
        tiny_settings(tmp_path, *words, "regenerator.upscale.arguments={level: 0.5}")
