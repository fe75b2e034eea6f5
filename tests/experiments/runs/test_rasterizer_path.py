"""Which path a run takes; pictures are drawn by the compiled path when its code is there, and only then."""

from threading import Event

import pytest
import torch
from raster_scenes import any_path

from gsx.engine.compile_ahead import WARM_SPLATS
from gsx.experiments.runs import rasterizer_path
from gsx.experiments.runs.rasterizer_path import compile_in_background, decide

CPU = torch.device("cpu")


@pytest.fixture
def compiler(monkeypatch):
    """Returns a function that sets what a working compiler makes of the small picture."""
    monkeypatch.setattr(rasterizer_path, "available", lambda _: True)

    def set_to(draw):
        monkeypatch.setattr(rasterizer_path, "rasterize_tiled", draw)

    return set_to


def test_compiled_settings_come_when_the_picture_is_drawn(compiler):
    let, taken, drawn = Event(), [], []
    compiler(
        lambda splats, camera, settings, background: (drawn.append((len(splats.means), settings.path)), let.wait(30))
    )
    thread = compile_in_background(any_path(dilation=0.1, path="auto"), CPU, taken.append)
    assert taken == []
    let.set()
    thread.join(30)
    assert taken == [any_path(dilation=0.1, path="compiled")]
    assert drawn == [(WARM_SPLATS, "compiled")]


def test_a_compiler_that_fails_changes_nothing(compiler, caplog):
    def fail(*_, **__):
        raise RuntimeError("no such instruction")

    compiler(fail)
    taken = []
    with caplog.at_level("INFO"):
        compile_in_background(any_path(path="auto"), CPU, taken.append).join(30)
    assert taken == []
    assert "eager path (no such instruction)" in caplog.text


def test_who_asks_for_the_eager_path_keeps_it(compiler):
    compiler(lambda *_, **__: pytest.fail("compiled"))
    assert not compile_in_background(any_path(path="eager"), CPU, pytest.fail).is_alive()


@pytest.mark.parametrize(
    ("path", "steps", "works", "decided"),
    [
        ("auto", 300, True, "compiled"),
        ("auto", 299, True, "eager"),
        ("auto", 300, False, "eager"),
        ("compiled", 1, False, "compiled"),
        ("eager", 300, True, "eager"),
    ],
)
def test_auto_decides_by_steps_and_compiler(
    path: str, steps: int, works: bool, decided: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rasterizer_path, "available", lambda _: works)
    assert decide(any_path(path=path, auto_steps=300), steps, CPU).path == decided
