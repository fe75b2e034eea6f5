"""Two processes train one scene: the same bits as one process with the same batch, one voice, one set of files."""

import json
import multiprocessing
import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from small_scene import small_gs3d, small_scene, spread
from tiny import OVERRIDES, final_tensors, same_ending

from gsx.cli.dispatch import main
from gsx.core.errors import ConfigError, Disagreement
from gsx.core.plugins import load_plugins
from gsx.core.rasterizer import RasterSettings
from gsx.core.training.distributed import Ranks
from gsx.core.training.photo_cache import PhotoCache
from gsx.core.training.run import Run, TrainingOptions
from gsx.core.training.sampler import Sampler
from gsx.core.training.trainer import train_step
from gsx.core.training.training_views import TrainingViews
from gsx.engine.joined_ranks import current_ranks
from gsx.experiments.runs.build import placed, refuse_uneven
from gsx.experiments.runs.guard import Agreement

COMMON = ("rasterizer=eager", "iterations=20", "training.batch=2", "training.checkpoint_every=8")
GS3D = (*COMMON, "backbone.density.every=400", "backbone.density.reset_passes=1", "backbone.density.gradient=1e-6",
        "training.random_background=true")  # fmt: skip
FEW = [f"augmenter.{name}.timing.{key}" for name in ("upscale", "bootstrap") for key in ("every=8000", "span=2500")]
OCTREE = (*COMMON, "iterations=16", "backbone=octree_scaffold", "backbone.offsets=4", "scene.points=60",
          "backbone.growth.every=400", "backbone.growth.gradient=1e-5", "training.log_every=1",
          "augmenter=[upscale_paper,bootstrap]", "augmenter.upscale.scales=[2]", *FEW,
          "augmenter.bootstrap.freeze_shared=active",
          "regenerator/upscale=lanczos", "regenerator/restore=identity")  # fmt: skip
TRAINING = TrainingOptions(
    ssim_weight=0.2, random_background=False, log_every=1, checkpoint_every=1, checkpoints_kept=1, test_points=0
)
FAILING = str(Path(__file__).with_name("failing_rank.py"))


def called(words: Sequence[str], **environment: str) -> subprocess.CompletedProcess:
    """A program of Python, single-threaded as all of torchrun's are."""
    return subprocess.run(
        [sys.executable, *words],
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def alone(*words: str) -> None:
    """One process: this one."""
    assert main(list(words)) == 0


def together(*words: str, program: tuple[str, ...] = ("-m", "gsx"), **environment: str) -> subprocess.CompletedProcess:
    """torchrun with two processes."""
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    return called((*launcher, *program, *words), **environment)


def as_rank(rank: int, words: Sequence[str], port: int, folder: Path, failing: dict[str, str]) -> None:
    """One of two processes as torchrun starts them, in a process that has all imported."""
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2"}
    os.environ |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), "OMP_NUM_THREADS": "1"} | failing
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(folder / f"{name}{rank}", os.O_CREAT | os.O_WRONLY), number)
    if failing:
        import failing_rank

        failing_rank.fail()
    torch.set_num_threads(1)
    sys.exit(main(list(words)))


@pytest.fixture(scope="module")
def forking(signals: None) -> Any:
    """Starts processes that have gsx and all it needs imported."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(
        ["torch._dynamo", "hydra.compose", "gsx.experiments.runs.job", "tiny", "small_scene"]
    )
    return context


def both(context: Any, folder: Path, *words: str, **failing: str) -> subprocess.CompletedProcess:
    """Two processes by themselves; what the first says, and what both complain of."""
    folder.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    ranks = [context.Process(target=as_rank, args=(rank, words, port, folder, failing)) for rank in (0, 1)]
    for rank in ranks:
        rank.start()
    for rank in ranks:
        rank.join(300)
        rank.kill()
        rank.join()
    said = ["".join((folder / f"{name}{rank}").read_text() for rank in (0, 1)) for name in ("out", "err")]
    return subprocess.CompletedProcess(words, max(abs(rank.exitcode or 0) for rank in ranks), *said)


def sentences(finished: subprocess.CompletedProcess) -> list[str]:
    """What gsx itself had to complain of; torchrun has more to say."""
    lines = finished.stderr.splitlines()
    return [line for line in lines if line.startswith("gsx: ")]


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


def files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


# -- whole runs --------------------------------------------------------------------------------------------------------


def test_two_processes_equal_one_and_resume_as_one(forking: Any, tmp_path: Path) -> None:
    """gs3d with clones, splits, opacity resets and random backgrounds; the first two are torchrun's."""
    two = together(*OVERRIDES, *GS3D, f"output={tmp_path / 'two'}")
    assert two.returncode == 0, two.stderr
    (folder,) = (tmp_path / "two" / "demo" / "gs3d").iterdir()
    alone(*OVERRIDES, *GS3D, f"folder={tmp_path / 'one'}")
    assert any("cloned" in line for line in lines(folder)), "the test needs density events"
    same_ending(folder, tmp_path / "one")
    for mine, theirs in zip(lines(folder), lines(tmp_path / "one"), strict=True):
        same = mine.keys() - {"seconds", "memory_mb", "psnr"}
        assert {key: mine[key] for key in same} == {key: theirs[key] for key in same}
    assert files(folder) == files(tmp_path / "one")
    assert json.loads((folder / "environment.json").read_text())["processes"] == 2
    assert two.stdout.split() == [str(folder / "report.html")]
    assert (folder / "log.txt").read_text().count("evaluating 2 test views") == 1

    shutil.copytree(folder, tmp_path / "killed")
    for path in (tmp_path / "killed" / "checkpoints").glob("step_0000020.*"):
        path.unlink()
    (tmp_path / "killed" / "evaluation.json").unlink()
    again = both(forking, tmp_path / "said", "resume", str(tmp_path / "killed"))
    assert again.returncode == 0, again.stderr
    assert "at step 16" in again.stderr
    same_ending(folder, tmp_path / "killed")
    assert files(folder) == files(tmp_path / "killed")


def test_two_processes_judge_as_one(forking: Any, tmp_path: Path) -> None:
    """Growth that has to pay for itself, coarse pictures first, bands of colour judged: what the first finds holds."""
    judged = ("backbone.capacity=adaptive", "backbone.adaptive.price=0.01", "backbone.sh_judged=0.6")
    coarse = (
        "iterations=26",
        "scene.width=64",
        "scene.height=48",
        "training.coarse_to_fine.factor=2",
        "training.coarse_to_fine.until=0.4",
    )
    words = (*OVERRIDES, *COMMON, "backbone.density.every=2500", *judged, *coarse)
    two = both(forking, tmp_path / "said", *words, f"folder={tmp_path / 'two'}")
    assert two.returncode == 0, two.stderr
    alone(*words, f"folder={tmp_path / 'one'}")
    told = [line for line in lines(tmp_path / "one") if "judged" in line or "degree_0" in line]
    assert len(told) > 1, "the test needs something judged"
    same_ending(tmp_path / "two", tmp_path / "one")


def test_two_processes_relocate_as_one(forking: Any, tmp_path: Path) -> None:
    """Both draw the same donors and the same noise."""
    chain = ("backbone.capacity=mcmc", "backbone.mcmc.primitives=400", "backbone.mcmc.dead_opacity=0.4")
    words = (*OVERRIDES, *COMMON, *chain, "iterations=8")
    two = both(forking, tmp_path / "said", *words, f"folder={tmp_path / 'two'}")
    assert two.returncode == 0, two.stderr
    alone(*words, f"folder={tmp_path / 'one'}")
    assert any(line.get("relocated") for line in lines(tmp_path / "one")), "the test needs relocation"
    same_ending(tmp_path / "two", tmp_path / "one")


def test_two_processes_with_networks_and_pseudo_views_equal_one(forking: Any, tmp_path: Path) -> None:
    """Growth across levels, and pseudo views that the first process makes for both."""
    two = both(forking, tmp_path / "said", *OVERRIDES, *OCTREE, f"folder={tmp_path / 'two'}")
    assert two.returncode == 0, two.stderr
    alone(*OVERRIDES, *OCTREE, f"folder={tmp_path / 'one'}")
    same_ending(tmp_path / "two", tmp_path / "one")
    assert any(line.get("grown") for line in lines(tmp_path / "two")), "the test needs growth"
    terms = [line["terms"] for line in lines(tmp_path / "two") if "terms" in line]
    assert terms == [line["terms"] for line in lines(tmp_path / "one") if "terms" in line]
    assert set().union(*terms) == {"own", "upscale", "bootstrap"}
    assert files(tmp_path / "two") == files(tmp_path / "one")


# -- what goes wrong ---------------------------------------------------------------------------------------------------


def test_the_error_of_one_process_ends_both_with_one_sentence(forking: Any, tmp_path: Path) -> None:
    words = (*OVERRIDES, *COMMON, f"folder={tmp_path / 'run'}")
    failed = both(forking, tmp_path / "said", *words, KIND="input", WHO="1")
    assert failed.returncode != 0
    assert sentences(failed) == ["gsx: process 1 of 2 has stopped: a photograph cannot be read: mend it"]
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "failed"
    assert final_tensors(tmp_path / "run")  # of step 4, the last one taken
    assert json.loads((tmp_path / "run" / "checkpoints" / "step_0000004.json").read_text())["step"] == 4


@pytest.mark.slow
def test_a_batch_that_cannot_be_shared_is_refused_with_a_remedy(tmp_path: Path) -> None:
    words = [word for word in COMMON if "batch" not in word]
    refused = together(*OVERRIDES, *words, f"folder={tmp_path / 'run'}")
    assert sentences(refused) == [
        "gsx: training.batch is 1, and 2 processes share its views: give a multiple of 2, "
        "for example training.batch=2"
    ]  # fmt: skip
    assert refused.returncode != 0
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_stop_asked_of_one_process_stops_both_after_the_same_step(tmp_path: Path) -> None:
    """And `gsx resume` on two processes ends as if nobody had asked."""
    words = (*OVERRIDES, *GS3D)
    stopped = together(*words, f"folder={tmp_path / 'run'}", program=(FAILING,), KIND="stop", WHO="1")
    assert sentences(stopped) == [f"gsx: stopped at step 5; continue with: gsx resume {tmp_path / 'run'}"]
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "interrupted"
    again = together("resume", str(tmp_path / "run"))
    assert again.returncode == 0, again.stderr
    alone(*words, f"folder={tmp_path / 'one'}")
    same_ending(tmp_path / "run", tmp_path / "one")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "sentence"), [
    ("killed", "gsx: another process of this run exited unexpectedly"),
    ("drift", "gsx: ranks disagree at step 8"),
])  # fmt: skip
def test_a_process_that_dies_or_drifts_is_noticed(kind: str, sentence: str, tmp_path: Path) -> None:
    failed = together(*OVERRIDES, *COMMON, f"folder={tmp_path / 'run'}", program=(FAILING,), KIND=kind, WHO="1")
    (found,) = sentences(failed)
    assert found.startswith(sentence)
    assert json.loads((tmp_path / "run" / "status.json").read_text())["state"] == "failed"
    assert (tmp_path / "run" / "checkpoints").exists() == (kind == "killed")


@pytest.mark.slow
def test_a_branch_from_a_trunk_equals_one_from_scratch(tmp_path: Path) -> None:
    words = (*OVERRIDES, *GS3D, "init=warm_start", "augmenter=bootstrap", "regenerator/restore=identity")
    environment = {"GSX_CACHE": str(tmp_path / "cache")}
    for name in ("first", "second"):
        done = together(*words, f"folder={tmp_path / name}", **environment)
        assert done.returncode == 0, done.stderr
    assert "branching at step" in done.stderr
    same_ending(tmp_path / "first", tmp_path / "second")


@pytest.mark.slow
def test_other_verbs_are_for_one_process(tmp_path: Path) -> None:
    refused = together("eval", str(tmp_path))
    assert sentences(refused) == [
        f"gsx eval {tmp_path}: torchrun is for training one scene and for gsx resume; call gsx without it"
    ]


# -- alone -------------------------------------------------------------------------------------------------------------


def test_a_process_by_itself_exchanges_nothing() -> None:
    ranks = current_ranks()
    part = {"rows": torch.arange(3)}
    assert (ranks.rank, ranks.size, ranks.first) == (0, 1, True)
    assert ranks.all_gather("word") == ["word"]
    assert ranks.broadcast(lambda: 5) == ranks.rank0_first(lambda: 5) == 5
    assert ranks.gathered([part], torch.device("cpu"))[0] is part
    assert placed(torch.device("cuda")) == torch.device("cuda")


@pytest.mark.parametrize("size", [1, 2, 3])
def test_shares_in_order_are_the_batch(size: int) -> None:
    batch = [9, 2, 7, 7, 1, 5]
    assert [view for rank in range(size) for view in Ranks(rank=rank, size=size).share(batch)] == batch


def test_uneven_batches_are_refused() -> None:
    refuse_uneven(6, Ranks(size=3))
    with pytest.raises(ConfigError, match=r"training.batch is 7, and 3 processes .* training.batch=9"):
        refuse_uneven(7, Ranks(size=3))


@dataclass(frozen=True, kw_only=True)
class Two(Ranks):
    """Two ranks, of which the other says what it is told to, or the same."""

    other: str = ""

    def all_gather(self, word: str) -> list[str]:
        return [word, self.other or word]


def test_ranks_that_disagree_are_stopped_where_checkpoints_are_due(tmp_path: Path) -> None:
    scene = small_scene(spread(5))
    run = Run(
        config={},
        folder=tmp_path,
        backbone=small_gs3d(scene),
        raster=RasterSettings(),
        training=replace(TRAINING, checkpoint_every=3),
        iterations=7,
        photos=PhotoCache(torch.device("cpu")),
        generator=torch.Generator(),
        views=TrainingViews(scene=scene),
        sampler=Sampler(4, 0),
    )
    step = train_step(run, load_plugins([], points=[]))
    agreed, apart = replace(run, ranks=Two(size=2)), replace(run, ranks=Two(size=2, other="another digest"))
    for apart.step in (1, 2, 4, 5):
        Agreement().gsx_step_finished(apart, step)
    for number in (3, 6, 7):
        apart.step = agreed.step = number
        Agreement().gsx_step_finished(agreed, step)
        with pytest.raises(Disagreement, match=f"ranks disagree at step {number}"):
            Agreement().gsx_step_finished(apart, step)
