"""Whether a change of the source leaves every result as it was, bit for bit.

    python benchmarks/same_results.py FOLDER before.json      # on the old source: run the compositions, keep digests
    python benchmarks/same_results.py FOLDER after.json --against before.json

Digests are those of tensors, pixels and figures, without clocks and paths. They hold for one machine and one torch and
are not committed. A quarter of an hour on two cores.
"""

import argparse
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import load_file

from gsx.core.files import read_json, write_json

LANCZOS, WARN = "regenerator/upscale=lanczos", "augmenter.upscale.checks.agreement.action=warn"
TINY = (
    "scene.width=48",
    "scene.height=36",
    "scene.train_views=6",
    "scene.test_views=2",
    "scene.points=300",
    "scene.samples=1",
    "training.test_points=2",
    "training.checkpoint_every=20",
    "training.checkpoints_kept=9",
    "iterations=60",
    "device=cpu",
    "eval.zoom=[1,2]",
)
CORRECTED = (
    "scene.width=96",
    "scene.height=72",
    "scene.train_views=12",
    "scene.points=600",
    "scene.disturb={exposure:0.3,pose:2,blur:3,covered:0.1,some:0.5}",
    "training.exposure.when=always",
    "training.exposure.grid=always",
    "training.poses.when=always",
    "training.blur.when=always",
    "training.distractors.when=always",
    "training.coarse_to_fine.factor=4",
    "training.coarse_to_fine.until=0.3",
    "training.supersampling.factor=2",
    "training.supersampling.start=0.6",
    "training.plateau.price=90",
    "training.plateau.to=0.9",
    "iterations=120",
)
"""Everything that corrects photos, and every schedule of the loop, on disturbed photos."""
RUNS: Mapping[str, tuple[str, ...]] = {
    "gs3d": ("backbone=gs3d",),
    "mip_splatting": ("backbone=mip_splatting",),
    "scaffold": ("backbone=scaffold",),
    "octree_scaffold": ("backbone=octree_scaffold",),
    "octree_gs3d": ("backbone=octree_gs3d",),
    "octree_gs3d_clone_split": ("backbone=octree_gs3d", "backbone.densification=clone_split"),
    "gs3d_upscale": ("backbone=gs3d", "augmenter=[upscale]", "regenerator/upscale=scene_sr_brief"),
    "gs3d_upscale_paper": ("backbone=gs3d", "augmenter=[upscale_paper]", "regenerator/upscale=lanczos"),
    "mipmap": ("backbone=gs3d", "augmenter=[mipmap]", "regenerator/upscale=lanczos"),
    "octree_scaffold_both": (
        "backbone=octree_scaffold",
        "augmenter=[upscale,bootstrap]",
        "regenerator/upscale=scene_sr_brief",
        "regenerator/restore=scene_restorer_brief",
    ),
    "octree_ub": ("variant=octree_ub", "dataset=demo", "budget=smoke"),
    "corrected": ("backbone=gs3d", *CORRECTED),
    "corrected_mip": ("backbone=mip_splatting", *CORRECTED, "training.batch=2", "augmenter=[upscale]", LANCZOS, WARN),
    "corrected_anchors": ("backbone=octree_scaffold", *CORRECTED),
    "adaptive": ("backbone=gs3d_zoom", "backbone.capacity=adaptive", "backbone.sh_judged=0.5", "backbone.sh_every=10"),
    "budget": ("backbone=octree_gs3d", "backbone.capacity=budget", "backbone.budget.primitives=900"),
    "closer": ("backbone=gs3d_zoom", "backbone.mip.pseudo=true", "augmenter=[upscale]", LANCZOS, WARN),
    "compiled": ("backbone=gs3d", "rasterizer=compiled"),
    "compiled_corrected": ("backbone=octree_scaffold", "rasterizer=compiled", *CORRECTED),
    "batch": ("backbone=octree_scaffold", "training.batch=2", "augmenter=[upscale]", "regenerator/upscale=lanczos"),
}
CLOCKS = ("time", "seconds", "fps", "per_second", "memory_mb")
"""How keys of figures end that two runs of the same source do not share: seconds, speed, memory."""
WORDS = ("version", "hash", "remarks")
"""Keys of what follows the source by design: digests of the built-in scene's code, and sentences."""


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="where the runs go; those there are not run again")
    parser.add_argument("to", type=Path, help="JSON of the digests")
    parser.add_argument("--against", type=Path, help="digests of another source; exits with 1 where they differ")
    return parser.parse_args(words)


def gsx(folder: Path, *words: str, launcher: Sequence[str] = ()) -> None:
    """One command, with a cache of its own and one thread."""
    environment = os.environ | {"OMP_NUM_THREADS": "1", "GSX_CACHE": str(folder.resolve() / "cache")}
    command = [sys.executable, *launcher, "-m", "gsx", *words]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)


def train(folder: Path, name: str, *words: str, launcher: Sequence[str] = ()) -> Path:
    """The run of that name, trained where it is not there."""
    run = folder / name
    if not (run / "evaluation.json").exists():
        gsx(folder, *TINY, f"folder={run}", *words, launcher=launcher)
    return run


def two_processes(folder: Path) -> None:
    """A batch of two views over two processes."""
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")
    train(folder, "two_processes", "backbone=octree_scaffold", "training.batch=2", launcher=launcher)


def resumed(folder: Path) -> None:
    """A run that goes on from its state at step 40."""
    if (folder / "resumed").exists():
        return
    run = train(folder, "resumed", *RUNS["octree_scaffold_both"])
    for path in run.glob("checkpoints/*60*"):
        path.unlink()
    gsx(folder, "resume", str(run))


def corrected_resumed(folder: Path) -> None:
    """A corrected run that goes on from its state at step 60."""
    if (folder / "corrected_resumed").exists():
        return
    run = train(folder, "corrected_resumed", *RUNS["corrected"])
    for path in run.glob("checkpoints/*"):
        if int(path.stem.removeprefix("step_")) > 60:
            path.unlink()
    gsx(folder, "resume", str(run))


def branched(folder: Path) -> None:
    """A run with an augmenter that begins with the state of one without."""
    train(folder, "unbranched", "init=warm_start")
    told = "augmenter.upscale.checks.agreement.action=warn"  # pictures are tiny
    train(folder, "branched", "init=warm_start", "augmenter=[upscale]", "regenerator/upscale=lanczos", told)


def evaluated(folder: Path) -> None:
    """A finished run that is evaluated at other zooms, and exported."""
    run = train(folder, "evaluated", "backbone=octree_gs3d")
    gsx(folder, "eval", str(run), "eval.zoom=[1,4]")
    gsx(folder, "export", str(run), str(run / "exported.ply"))
    gsx(folder, "render", str(run))


FURTHER: Sequence[Callable[[Path], None]] = (two_processes, resumed, corrected_resumed, branched, evaluated)


def digests(run: Path) -> dict[str, str]:
    """Digest of each result below a run's folder, by its path there."""
    found: dict[str, str] = {}
    for path in sorted(run.rglob("*")):
        if content := content_of(path):
            found[str(path.relative_to(run))] = hashlib.sha256(content).hexdigest()[:16]
    return found


def content_of(path: Path) -> bytes:
    """What counts in a file; nothing of those that hold clocks and paths."""
    if path.suffix == ".safetensors":
        return b"".join(tensor_bytes(load_file(path)))
    if path.suffix in (".png", ".ply", ".csv"):
        return path.read_bytes()
    if path.name in ("evaluation.json", "index.json"):
        return json.dumps(without_clocks(read_json(path)), sort_keys=True).encode()
    if path.name == "metrics.jsonl":
        lines = (without_clocks(json.loads(line)) for line in path.read_text().splitlines())
        return "\n".join(json.dumps(line, sort_keys=True) for line in lines).encode()
    return b""


def tensor_bytes(tensors: Mapping[str, np.ndarray[Any, Any]]) -> Iterator[bytes]:
    """Names, shapes and bits."""
    for name in sorted(tensors):
        yield f"{name} {tensors[name].shape} {tensors[name].dtype}".encode()
        yield tensors[name].tobytes()


def without_clocks(value: Any) -> Any:
    """Without what two runs of the same source do not share."""
    if isinstance(value, dict):
        return {key: without_clocks(part) for key, part in value.items() if not is_clock(key)}
    return [without_clocks(part) for part in value] if isinstance(value, list) else value


def is_clock(key: str) -> bool:
    """Returns whether a key names seconds, speed, memory, or what follows the source."""
    return key.endswith(CLOCKS) or key in WORDS


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """What is not the same, a line each."""
    lines = []
    for run in sorted(before.keys() | after.keys()):
        one, other = before.get(run, {}), after.get(run, {})
        lines += [f"{run}: {path}" for path in sorted(one.keys() | other.keys()) if one.get(path) != other.get(path)]
    return lines


def main(words: Sequence[str]) -> int:
    """Run everything, write the digests, compare."""
    given = arguments(words)
    before = read_json(given.against) if given.against else None
    for name, overrides in RUNS.items():
        train(given.folder, name, *overrides)
    for further in FURTHER:
        further(given.folder)
    runs = sorted(path for path in given.folder.iterdir() if (path / "evaluation.json").exists())
    found = {run.name: digests(run) for run in runs}
    write_json(given.to, found)
    lines = [] if before is None else differences(before, found)
    print("\n".join(lines) or f"{sum(map(len, found.values()))} results of {len(found)} runs")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
