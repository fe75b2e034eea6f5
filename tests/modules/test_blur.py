"""Cameras that moved in runs: found where they did, absent where they did not, applied, kept and resumed."""

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from module_contexts import build_module
from small_scene import Grey, small_scene, spread
from tiny import same_ending, tiny_run
from torch import Tensor

from gsx.builtin import plugins
from gsx.core.data.camera import Camera
from gsx.core.data.scene import View
from gsx.core.quality.sharpness import fineness
from gsx.core.training.run import Run
from gsx.core.training.trainer import view_loss
from gsx.experiments.runs.degraded import pair_of
from gsx.experiments.runs.execute import execute
from gsx.experiments.runs.halves import render_halves
from gsx.experiments.runs.open import open_run
from gsx.modules.blur import Blur, BlurOptions
from gsx.modules.motion_blur import Movement, motion_blurred

LONG, SHORT, IDLE = Movement(3.0, 4.0, 0.2), Movement(0.5, 0.5, 0.2), Movement(3.0, 4.0, 0.001)


def blur(when: str = "auto", **more: float) -> Blur:
    return build_module(Blur, BlurOptions(when=when, start=0.1, until=0.4, times=3, **more))


def blurred(module: Blur, image: Tensor, view: View) -> Tensor:
    """A render as its photo would show it."""
    return module.transform_render(image, view, None, None, learning=False)


def views(count: int = 4) -> list[View]:
    """Of 24 x 16 px."""
    return list(small_scene(spread(5), views=count).train)


def test_it_is_asked_once_and_again_only_where_cameras_moved() -> None:
    own = blur()
    assert [number for number in range(1, 1001) if own.due(number)] == [101]
    own.move({views()[1]: SHORT}, 101)
    assert not any(own.due(number) for number in range(1, 1001))
    own.move({views()[1]: LONG}, 101)
    assert [number for number in range(1, 1001) if own.due(number)] == [201, 401]
    assert not any(blur("never").due(number) for number in range(1, 1001))


def test_short_movements_and_such_that_explain_nothing_do_not_count() -> None:
    own = blur()
    assert own.move(dict(zip(views(), (SHORT, LONG, IDLE), strict=False)), 101) == [5.0]
    assert own.movements == {"view1": (3 / 24, 4 / 16)}


class Noise(Grey):
    """Fine and coarse contrast; swept along rows where it is blurred."""

    def __init__(self, blurred: bool) -> None:
        self.blurred = blurred

    def image(self, camera: Camera) -> Tensor:
        image = 255 * torch.rand(3, camera.height, camera.width, generator=torch.Generator().manual_seed(0))
        return (motion_blurred(image, 5.0, 0.0) if self.blurred else image).byte()


def noisy(blurred: int) -> list[View]:
    """Seven photographs of 96 x 80 px, one of them blurred."""
    camera = small_scene(spread(5)).train[0].camera.resize(96, 80)
    return [View(f"view{number}", camera, Noise(number == blurred)) for number in range(7)]


def test_suspects_are_less_sharp_than_their_neighbours_and_then_all() -> None:
    photographs, own = noisy(blurred=3), blur()
    assert [view.name for view in own.candidates(photographs)] == ["view3"]
    assert [view.name for view in own.candidates(photographs * 4)] == ["view3"]
    assert blur(sharpness=0.0).candidates(photographs) == []
    assert blur("always").candidates(photographs) == photographs
    own.move({photographs[3]: LONG}, 101)
    assert own.candidates(photographs) == photographs


def test_renders_move_by_as_much_as_their_photographs_at_any_size() -> None:
    own, [view, other] = blur(), views(2)
    own.move({view: LONG}, 101)
    image = torch.rand(3, 16, 24, generator=torch.Generator().manual_seed(0))
    assert torch.equal(blurred(own, image, view), motion_blurred(image, 3.0, 4.0))
    assert blurred(own, image, other) is image
    finer, smaller = (replace(view, camera=view.camera.resize(*size)) for size in ((48, 32), (12, 8)))
    assert torch.equal(blurred(own, image, finer), motion_blurred(image, 6.0, 8.0))
    assert torch.equal(blurred(own, image, smaller), motion_blurred(image, 1.5, 2.0))
    part = replace(finer, camera=finer.camera.crop(0, 0, 24, 16))
    assert torch.equal(blurred(own, image, part), motion_blurred(image, 6.0, 8.0))


def test_they_go_on_from_what_was_kept() -> None:
    own, again = blur(), blur()
    own.move(dict.fromkeys([views()[1], replace(views()[0], name="of a b")], LONG), 201)
    again.load_state_dict(own.state_dict())
    assert (again.movements, again.last_estimate) == (own.movements, 201)
    again.load_state_dict({})
    assert (again.movements, again.last_estimate) == ({}, 0)


@pytest.mark.parametrize(("key", "value"), [("when", "maybe"), ("start", 0.0), ("until", 0.05)])
def test_options_that_say_nothing_are_refused(key: str, value: object) -> None:
    with pytest.raises(ValueError, match=r"training\.blur"):
        BlurOptions(**{"start": 0.1, key: value})


# -- runs ------------------------------------------------------------------------------------------------------------

SIZE = ("scene.width=80", "scene.height=64", "eval.zoom=[1]")
MOVED = (
    *(*SIZE, "scene.disturb.blur=8", "training.blur.when=always", "training.blur.start=0.5", "training.blur.times=3"),
    *("iterations=40", "backbone.rates.shortened=0.4", "scene.points=3000", "backbone.max_primitives=10000"),
)
SHORTER = (*MOVED, "iterations=12", "scene.points=300")
"""Movements are asked for before steps 7, 9 and 11."""


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path]:
    """(a finished run whose cameras moved, its folder)."""
    folder = tmp_path_factory.mktemp("moved") / "run"
    return tiny_run(folder, MOVED), folder


def test_a_run_finds_how_its_cameras_moved(moved: tuple[Run, Path]) -> None:
    run, _ = moved
    told = [line for line in run.progress.curves if "blur_seconds" in line]
    assert [line["step"] for line in told] == run.modules["blur"].milestones()
    module = run.modules["blur"]
    remarks = " ".join(module.remarks(module.summary(run.progress.curves)))
    assert f"moved in {len(module.movements)} training photos" in remarks
    size, far = torch.tensor([80.0, 64.0], dtype=torch.float64), 0
    for view in run.scene.train:
        made = torch.tensor(pair_of("blur", view.name, 8.0), dtype=torch.float64)
        found = size * torch.tensor(run.modules["blur"].movements.get(view.name, (0.0, 0.0)), dtype=torch.float64)
        far += min(float((found - sign * made).norm()) for sign in (1, -1)) > 0.25 * float(made.norm()) + 1
    assert far <= 1


def test_a_run_resumes_as_if_never_stopped_and_learns_by_what_was_found(tmp_path: Path) -> None:
    whole = tiny_run(tmp_path / "whole", SHORTER, evaluated=False)
    assert [line["step"] for line in whole.progress.curves if "blur_seconds" in line] == [7, 9, 11]
    tiny_run(tmp_path / "stopped", SHORTER, stop_after=8)
    run, settings = open_run(tmp_path / "stopped", plugins(), training=True)
    assert run.modules["blur"].movements
    execute(run, settings, plugins())
    a = same_ending(tmp_path / "whole", tmp_path / "stopped")
    assert any(name.startswith("blur.of ") for name in a)


def test_renders_are_blurred_before_they_are_compared(moved: tuple[Run, Path]) -> None:
    """A sharp model is nearer to blurred photographs so."""
    run, _ = open_run(moved[1], plugins())
    found = dict(run.modules["blur"].movements)
    view = max(run.train_views, key=lambda view: math.hypot(*found.get(view.name, (0.0, 0.0))))
    losses = []
    for movements in (found, {}):
        run.modules["blur"].movements = movements
        losses.append(float(view_loss(run, run.step, view, [], run.scene.background).loss))
    assert losses[0] < 0.8 * losses[1]


def test_halves_take_the_movements_that_were_found(moved: tuple[Run, Path]) -> None:
    """Models of half of the photographs learn from them as the run does, and their renders are blurred alike."""
    pictures = []
    for known in (True, False):
        run, _ = open_run(moved[1], plugins())
        name = next(iter(run.modules["blur"].movements))
        run.modules["blur"].movements = run.modules["blur"].movements if known else {}
        shown = render_halves(run, lambda own=run.backbone, **changes: own, 1, 0)
        pictures.append(next(shown[n] for n, view in enumerate(run.train_views) if view.name == name))
    assert fineness(pictures[0]).min() < 0.9 * fineness(pictures[1]).min()


def test_without_need_training_is_bit_for_bit_that_without_the_question(tmp_path: Path) -> None:
    plain = tiny_run(tmp_path / "plain", [*SIZE, "iterations=6"], evaluated=False)
    words = ["training.blur.when=auto", "training.blur.sharpness=10", "training.blur.explained=0.5"]
    judged = tiny_run(tmp_path / "judged", [*SIZE, "iterations=6", *words], evaluated=False)
    assert not plain.modules["blur"].active
    assert [line["blurred"] for line in judged.progress.curves if "blur_seconds" in line] == [0]
    assert [line["blur_suspects"] for line in judged.progress.curves if "blur_seconds" in line] == [6]
    same_ending(tmp_path / "plain", tmp_path / "judged")
