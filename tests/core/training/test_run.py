"""The order of training views: all before any comes again, known ahead, the same for the same seed. What counts as time
of training."""

from pathlib import Path

import pytest
from tiny import tiny_settings

from gsx.builtin import plugins
from gsx.core.training import trainer
from gsx.core.training.run import Run
from gsx.core.training.sampler import Sampler
from gsx.engine.compile_cache import training_clock, waiting
from gsx.experiments.runs.open import start


def test_every_view_once_before_any_comes_again() -> None:
    sampler = Sampler(7, 3)
    drawn = [sampler.next() for _ in range(28)]
    orders = [tuple(drawn[first : first + 7]) for first in range(0, 28, 7)]
    assert all(sorted(order) == list(range(7)) for order in orders)
    assert len(set(orders)) == 4


def test_views_to_come_are_known_without_drawing_them() -> None:
    """Across the end of an order too."""
    sampler, other = Sampler(5, 0), Sampler(5, 0)
    for _ in range(3):
        assert sampler.next() == other.next()
    assert sampler.coming(4) == {other.next() for _ in range(4)}
    again = Sampler(5, 0)
    assert [sampler.next() for _ in range(9)] == [again.next() for _ in range(12)][3:]
    assert sampler.coming(0) == set()


def test_seeds_give_other_orders() -> None:
    orders = [[sampler.next() for _ in range(20)] for sampler in (Sampler(20, 1), Sampler(20, 1), Sampler(20, 2))]
    assert orders[0] == orders[1] != orders[2]


def test_waiting_for_code_is_no_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, now = start(tiny_settings(tmp_path / "run", "iterations=3"), plugins()), [0.0]

    def step(run: Run, _: object) -> None:
        run.step += 1
        now[0] += 2
        with waiting():
            now[0] += 10 if run.step == 2 else 0

    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    monkeypatch.setattr(trainer, "train_step", step)
    trainer.train(run, plugins(), training_clock)
    assert (run.step, run.progress.seconds) == (3, 6.0)
