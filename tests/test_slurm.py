"""Tables on a real Slurm cluster, started here; among them a job that is stopped, queued again and goes on."""

import hashlib
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from slurm_cluster import absent, jobs, slurm

pytestmark = [pytest.mark.slow, pytest.mark.skipif(bool(absent()), reason=absent())]

TABLE = [
    "+experiment=table_frameworks", "experiment.only=[3D-GS,3D-GS-UP]", "dataset=demo", "budget=smoke",
    "iterations=120",
    "scene.train_views=6", "scene.test_views=2", "scene.samples=1", "scene.points=300", "scene.max_width=64",
    "training.checkpoint_every=10", "training.test_points=0", "rasterizer=eager",
]  # fmt: skip
SLURM = [
    "hydra/launcher=slurm", "hydra.launcher.partition=test", "hydra.launcher.gpus_per_node=null",
    "hydra.launcher.cpus_per_task=1", "hydra.launcher.mem_gb=null",
]  # fmt: skip


def gsx(words: list[str], folder: Path, environment: dict[str, str]) -> subprocess.Popen[str]:
    """A command of gsx in a folder, with one thread."""
    own = {"OMP_NUM_THREADS": "1", "GSX_CACHE": str(folder / "cache")}
    command = [sys.executable, "-m", "gsx", *words]
    return subprocess.Popen(
        command, cwd=folder, env=environment | own, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def until(condition: object, process: subprocess.Popen[str], seconds: float = 180) -> None:
    """Wait until a function says yes, or fail with what the process has said."""
    end = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        if process.poll() is not None or time.monotonic() > end:
            process.kill()
            pytest.fail(f"this did not come about:\n{process.communicate()[0]}")
        time.sleep(0.1)


def last_states(folder: Path) -> dict[str, str]:
    """Digest of the last checkpoint by run."""
    found = sorted(folder.glob("outputs/demo/gs3d/*/checkpoints/step_0000120.safetensors"))
    return {path.parts[-3]: hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def test_a_requeued_job_goes_on_and_the_table_is_that_of_one_process(tmp_path: Path) -> None:
    with slurm(tmp_path / "slurm") as environment:
        (tmp_path / "cluster").mkdir()
        table = gsx([*TABLE, *SLURM], tmp_path / "cluster", environment)
        checkpoints = tmp_path / "cluster" / "outputs"
        until(lambda: list(checkpoints.glob("demo/gs3d/*/checkpoints/step_*.json")), table)
        running = [number for number, state in jobs(environment).items() if state == "RUNNING"]
        subprocess.run(["scontrol", "requeue", *running], env=environment, check=True)
        said, _ = table.communicate(timeout=300)
        logs = "".join(p.read_text() for p in checkpoints.glob("experiments/*/launched/*/.submitit/**/*_log.err"))
    assert table.returncode == 0, said + logs
    assert "stopped at step" in logs
    assert "continuing" in logs
    (tmp_path / "alone").mkdir()
    alone = gsx(TABLE, tmp_path / "alone", dict(os.environ))
    told, _ = alone.communicate(timeout=300)
    assert alone.returncode == 0, told
    assert len(last_states(tmp_path / "cluster")) == 2
    assert last_states(tmp_path / "cluster") == last_states(tmp_path / "alone")
