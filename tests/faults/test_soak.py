"""A table of twenty runs by two processes, of which one is killed every few seconds, for half an hour."""

import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from faults.record import record, shorter
from faults.verbs import orphans

pytestmark = pytest.mark.faults

MINUTES = 30
SHORTEST, LONGEST = 5, 60
"""Seconds between kills."""
CACHE_GB = 0.05
TABLE = ["+experiment=table_frameworks", "dataset=demo", "budget=smoke", "experiment.only=[3D-GS,3D-GS-UP]",
         "experiment.seeds=[0,1,2,3,4,5,6,7,8,9]", "iterations=40", "training.checkpoint_every=5", "scene.width=48",
         "scene.height=36", "scene.train_views=6", "scene.test_views=2", "scene.points=300", "scene.samples=1",
         "training.test_points=0", "device=cpu", "rasterizer=eager", "regenerator/upscale=lanczos",
         f"disk_cache_gb={CACHE_GB}", "hydra/launcher=processes", "hydra.launcher.n_jobs=2"]  # fmt: skip


@dataclass(frozen=True)
class Round:
    """What a table left."""

    digests: dict[tuple[str, int], str]
    """Of the last checkpoint, by variant and seed."""
    files: frozenset[str]
    """Names below run folders, without what is named by the hour."""
    megabytes: float
    """Peak memory of the process that gathers."""
    kills: int


def digests(place: Path) -> dict[tuple[str, int], str]:
    """Of the last checkpoint of each run."""
    found = {}
    for config in place.glob("outputs/demo/gs3d/*/config.yaml"):
        lines = config.read_text().splitlines()
        values = dict(line.split(": ", 1) for line in lines if line.startswith(("variant: ", "seed: ")))
        last = sorted((config.parent / "checkpoints").glob("*.safetensors"))[-1]
        assert last.stem == "step_0000040", last
        found[values["variant"], int(values["seed"])] = hashlib.sha256(last.read_bytes()).hexdigest()
    return found


def names(place: Path) -> frozenset[str]:
    """Files of all runs, by what they are to a run; what a branch and a run from scratch differ in left out."""
    runs = place.glob("outputs/demo/gs3d/*")
    paths = (str(path.relative_to(run)) for run in runs for path in run.rglob("*") if path.is_file())
    return frozenset(name for name in paths if name != "branch.json")


def victim(parent: int, choice: random.Random) -> int:
    """The command's own process, or one of its children."""
    listed = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
    return choice.choice([parent, *map(int, listed)])


def carried_out(place: Path, choice: random.Random | None, until: float) -> tuple[int, float, int]:
    """The table's command once; one of its processes is killed every few seconds. (exit code, peak MB, kills)."""
    environment = os.environ | {"GSX_CACHE": str(place / "cache"), "OMP_NUM_THREADS": "1"}
    with (place / "said.txt").open("w") as said:
        begun = subprocess.Popen(
            [sys.executable, "-m", "gsx", *TABLE], cwd=place, env=environment, stdout=said, stderr=said
        )
        kills, due = 0, time.monotonic() + choice.uniform(SHORTEST, LONGEST) if choice else float("inf")
        while True:
            ended, status, usage = os.wait4(begun.pid, os.WNOHANG)
            if ended:
                begun.returncode = os.waitstatus_to_exitcode(status)
                return begun.returncode, usage.ru_maxrss / 1000, kills
            if choice and time.monotonic() > due and time.monotonic() < until:
                with suppress(ProcessLookupError, FileNotFoundError):  # it has ended by itself
                    os.kill(victim(begun.pid, choice), signal.SIGKILL)
                    kills += 1
                due = time.monotonic() + choice.uniform(SHORTEST, LONGEST)
            time.sleep(0.1)


def table(place: Path, choice: random.Random | None = None, until: float = 0.0) -> Round:
    """The table, its command given again until it is whole."""
    shutil.rmtree(place / "outputs", ignore_errors=True)
    kills, megabytes = 0, 0.0
    for _ in range(200):
        code, peak, killed = carried_out(place, choice, until)
        kills, megabytes = kills + killed, max(megabytes, peak)
        if code == 0:
            return Round(digests=digests(place), files=names(place), megabytes=megabytes, kills=kills)
        assert killed or kills, (place / "said.txt").read_text()
    raise AssertionError((place / "said.txt").read_text())


def test_half_an_hour_of_kills(tmp_path: Path) -> None:
    choice = random.Random(0)
    for name in ("quiet", "place"):
        (tmp_path / name).mkdir()
    expected = table(tmp_path / "quiet")
    assert len(expected.digests) == 20
    place, until = tmp_path / "place", time.monotonic() + shorter(MINUTES * 60)
    rounds = kills = 0
    with record("kills of a table of 20 runs by two processes", seed=0) as counts:
        while time.monotonic() < until or not rounds:
            left = table(place, choice, until)
            assert left.digests == expected.digests
            assert left.files == expected.files
            assert orphans(place / "outputs") == []
            assert left.megabytes < 1.3 * expected.megabytes
            cached = sum(path.stat().st_size for path in (place / "cache").rglob("*") if path.is_file())
            assert cached < 1.5e9 * CACHE_GB
            rounds, kills = rounds + 1, kills + left.kills
        assert kills or shorter(1) < 1
        counts.cases = kills
        print(json.dumps({"rounds": rounds, "kills": kills, "megabytes": left.megabytes, "cached": cached}))
