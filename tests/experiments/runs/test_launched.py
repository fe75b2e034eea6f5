"""Signals while runs go on in processes of a launcher: all end their jobs, none begins another, and then they count."""

import os
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from multiprocessing import get_context
from pathlib import Path
from subprocess import PIPE

import pytest
from processes import Begin

from gsx.experiments.runs.launched import STOPPED, ended_from_without, waiting_for_all

pytestmark = pytest.mark.usefixtures("signals")


def work(folder: Path, name: str) -> None:
    """A job after the other, as joblib's processes do them; each goes on until it is ended, which takes a while."""
    for number in range(2):
        with suppress(KeyboardInterrupt), ended_from_without(folder):
            (folder / f"{name}_{number}_begun").touch()
            try:
                while True:
                    time.sleep(0.02)
            finally:
                time.sleep(0.2)
                (folder / f"{name}_{number}_ended").touch()


def files(folder: Path, what: str) -> list[str]:
    return sorted(file.name for file in folder.glob(f"*_{what}"))


@pytest.mark.skipif(os.name != "posix", reason="signals to processes are of Unix")
@pytest.mark.parametrize(
    ("number", "raised", "twice"),
    [(signal.SIGINT, KeyboardInterrupt, True), (signal.SIGTERM, SystemExit, False), (signal.SIGHUP, SystemExit, False)],
)
def test_all_jobs_come_to_an_end_before_a_signal_counts(
    number: signal.Signals, raised: type[BaseException], twice: bool, tmp_path: Path
) -> None:
    """`twice`: as a terminal's Ctrl-C, which every process hears."""
    before = {one: signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    context = get_context("spawn")
    both = [context.Process(target=work, args=(tmp_path, name)) for name in ("first", "second")]

    def launched() -> None:
        for one in both:
            one.start()
        deadline = time.monotonic() + 60
        while len(files(tmp_path, "begun")) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        os.kill(os.getpid(), number)
        for pid in [one.pid for one in both] if twice else []:
            os.kill(pid, number)
        for one in both:
            one.join(20)
        assert (tmp_path / STOPPED).exists()

    try:
        with pytest.raises(raised), waiting_for_all(tmp_path):
            launched()
    finally:
        for one in both:
            one.kill()
    assert [one.exitcode for one in both] == [0, 0]
    assert files(tmp_path, "ended") == ["first_0_ended", "second_0_ended"]
    assert files(tmp_path, "begun") == ["first_0_begun", "second_0_begun"]
    assert not (tmp_path / STOPPED).exists()
    assert {one: signal.getsignal(one) for one in before} == before


def test_jobs_of_this_process_are_interrupted_as_ever(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), waiting_for_all(tmp_path), ended_from_without(tmp_path):
        os.kill(os.getpid(), signal.SIGINT)
    assert not (tmp_path / STOPPED).exists()


def test_threads_hear_no_signals(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(lambda: [waiting_for_all(tmp_path).__enter__()]).result() == [None]


def test_there_are_no_more_processes_than_jobs() -> None:
    """They would share the cores, and be idle."""
    pytest.importorskip("joblib", reason="gsx[sweep] is not installed")
    from gsx.experiments.runs.multirun import processes_for  # the processes of the first test would import it

    assert [processes_for(3, 8), processes_for(8, 3), processes_for(1, -1)] == [3, 3, 1]


def test_what_a_launcher_raises_is_told(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="of its own"), waiting_for_all(tmp_path):
        raise ValueError("of its own")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals to processes are of Unix")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_leaves_a_checkpoint_of_every_run_of_a_multirun(
    number: signal.Signals, begin: Begin, tmp_path: Path
) -> None:
    """Three runs in two processes: two have begun."""
    from tiny import LIGHT, OVERRIDES  # the processes of the first test would import it

    from gsx.core.files import read_json

    pytest.importorskip("hydra_plugins.hydra_joblib_launcher", reason="gsx[sweep] is not installed")
    launcher = ["hydra/launcher=processes", "hydra.launcher.n_jobs=2", "rasterizer=eager", "iterations=100000"]
    words = [
        "-m",
        *OVERRIDES,
        *LIGHT,
        *launcher,
        "training.checkpoint_every=100000",
        f"output={tmp_path}",
        "seed=0,1,2",
    ]
    sweep = begin([sys.executable, "-m", "gsx", *words], stderr=PIPE, text=True)
    while len(list(tmp_path.glob("demo/*/*/metrics.jsonl"))) < 2 and sweep.poll() is None:
        time.sleep(0.2)
    (os.killpg if number == signal.SIGINT else os.kill)(sweep.pid, number)
    told = sweep.communicate(timeout=120)[1]
    assert sweep.returncode == 128 + number, told
    states = [read_json(path)["state"] for path in tmp_path.glob("demo/*/*/status.json")]
    assert states == ["interrupted"] * 2
    assert len(list(tmp_path.glob("demo/*/*/checkpoints/*.safetensors"))) == 2
    assert len(list(tmp_path.glob("sweeps/*/report.html"))) == 1
