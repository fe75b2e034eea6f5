"""A second process compiles while the scene is loaded: the rules of the run's own steps, and only where that helps."""

from contextlib import ExitStack, nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny import tiny_settings

from gsx.builtin import plugins
from gsx.core.data.scene import Scene
from gsx.engine.compile_ahead import Step
from gsx.experiments.runs import early_compiling
from gsx.experiments.runs.early_compiling import compiling_before, early_step
from gsx.experiments.runs.logs import set_up_logging
from gsx.experiments.runs.open import start
from gsx.experiments.runs.rasterizer_path import rules_of_step
from gsx.experiments.runs.settings import Settings

COMPILED = ("rasterizer=compiled",)


@pytest.mark.parametrize(
    "given",
    [
        "backbone=gs3d",
        "backbone=gs3d backbone.sh_degree=1",
        "backbone=gs3d backbone.capacity=adaptive",
        "backbone=gs3d_zoom",
        "backbone=gs3d_zoom backbone.filter=magnified",
        "backbone=mip_splatting",
        "backbone=octree_gs3d",
        "backbone=scaffold",
        "backbone=octree_scaffold",
    ],
)
def test_the_placeholder_has_the_rules_of_the_run(
    tmp_path: Path, given: str, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up_logging()
    settings = tiny_settings(tmp_path / "run", *given.split(), *COMPILED)
    torch.manual_seed(5)
    step, drawn = early_step(settings), torch.rand(1)
    assert not capsys.readouterr().err, "a doubt about the placeholder"
    assert step is not None
    torch.manual_seed(5)
    assert torch.equal(torch.rand(1), drawn)  # torch's generator is as before
    run = start(settings, plugins())
    assert step.words == rules_of_step(run.backbone, run.raster).words


@pytest.fixture
def early(monkeypatch: pytest.MonkeyPatch) -> list[Step]:
    """Lists the steps that a second process would compile, where a compiler is present."""
    steps = list[Step]()
    monkeypatch.setattr(early_compiling, "compiling_early", lambda step: steps.append(step) or nullcontext())
    monkeypatch.setattr("shutil.which", lambda name: f"/bin/{name}")
    return steps


@pytest.mark.parametrize(("words", "compiler", "begins"), [
    ("rasterizer=compiled", True, True),
    ("rasterizer=auto iterations=300", True, True),
    ("rasterizer=auto iterations=299", True, False),
    ("rasterizer=eager iterations=300", True, False),
    ("rasterizer=compiled", False, False),
])  # fmt: skip
def test_only_runs_that_compile_begin_early(
    words: str, compiler: bool, begins: bool, early: list[Step], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiler:
        monkeypatch.setattr("shutil.which", lambda _: None)
    with compiling_before(tiny_settings(tmp_path / "run", *words.split())):
        assert [step.settings.path for step in early] == (["compiled"] if begins else [])


def test_a_backbone_that_needs_the_true_scene_compiles_later(
    early: list[Step], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise ValueError("one point is too few")

    settings = tiny_settings(tmp_path / "run", *COMPILED)
    chosen = settings.backbone
    settings = replace(settings, backbone=replace(chosen, component=replace(chosen.component, factory=refuse)))
    with caplog.at_level("INFO"), compiling_before(settings):
        assert early == []
    assert "one point is too few" in caplog.text


def test_the_scene_is_loaded_while_code_is_made(early: list[Step], tmp_path: Path) -> None:
    settings = tiny_settings(tmp_path / "run", *COMPILED)
    load = settings.scene.component.factory

    def counted(options: object) -> Scene:
        assert len(early) == 1
        return load(options)

    component = replace(settings.scene.component, factory=counted)
    settings: Settings = replace(settings, scene=replace(settings.scene, component=component))
    with ExitStack() as claims:
        start(settings, plugins(), claims)
