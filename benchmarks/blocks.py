"""Blocks of a scene against the model in one piece: three built-in rooms, held-out views near the cuts and elsewhere.

    python benchmarks/blocks.py [--seeds 0] [--steps 1000,3000] [--whole 3000] [--count 3] [--runs FOLDER]

The model in one piece takes --whole steps and has 30,000 primitives, each block --steps and two thirds of that, since
it also learns what is around its cell. Finished runs are kept. Forty minutes a seed on one core.
"""

import argparse
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from gsx.builtin import plugins
from gsx.core.data.camera import centres_of
from gsx.core.files import read_json
from gsx.experiments.blocks.merge import merge_blocks
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.load_scene import load_scene
from gsx.formats.splat_files import read_splats
from gsx.scenes.blocks import scene_cells
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import Section, stamped, text_table, write_results
from measuring.runs import gsx, train

RESULTS = Path(__file__).parent / "results"
SCENE = ("scene=room", "scene.rooms=3", "scene.train_views=180", "scene.test_views=18", "scene.points=9000")
QUICK = ("training.cooldown=0.25", "training.supersampling.start=0.95", "backbone.density.reset_every=1000000")
ZOOMS = "eval.zoom=[1,2,4]"
WHOLE, NEAR = 30_000, 1.2
"""Primitives of the model in one piece, and distance from a cut within which a test camera is near it, scene units."""
COLUMNS = [
    *(
        ["seed", "seed"],
        ["model", "model"],
        ["steps", "steps"],
        ["x1", "x1, dB"],
        ["x4", "x4, dB"],
        ["near", "near cuts, dB"],
    ),
    *(["far", "elsewhere, dB"], ["worst", "worst view, dB"], ["primitives", "primitives"], ["seconds", "training, s"]),
]
Row = dict[str, object]


def words_for(seed: int, steps: int, primitives: int) -> list[str]:
    """The settings of a run."""
    budget = ("backbone.capacity=budget", f"backbone.budget.primitives={primitives}")
    return [*SCENE, *QUICK, *budget, f"seed={seed}", f"iterations={steps}", "rasterizer=compiled"]


def views_near_cuts(count: int) -> set[str]:
    """Names of the test views whose cameras are near a cut."""
    scene = load_scene(compose(SCENE, plugins()))
    cuts = torch.stack([torch.stack([cell.low, cell.high]) for cell in scene_cells(scene, count)]).view(-1, 3)
    apart = (centres_of([view.camera for view in scene.test])[:, None] - cuts).abs().amin((1, 2))
    return {view.name for view, distance in zip(scene.test, apart.tolist(), strict=True) if distance < NEAR}


def figures(folder: Path, near: set[str]) -> Row:
    """The figures of an evaluation."""
    found = read_json(folder / "evaluation.json")
    levels = {view["name"]: view["psnr"] for view in found["views"]}
    return {
        "x1": found["psnr"],
        "x4": found["zoom"]["4"]["psnr"],
        "near": statistics.fmean(level for name, level in levels.items() if name in near),
        "far": statistics.fmean(level for name, level in levels.items() if name not in near),
        "worst": min(levels.values()),
        "primitives": found["primitives"],
    }


def trained_blocks(seed: int, steps: int, options: argparse.Namespace) -> tuple[list[Path], float]:
    """Folders of the runs on all blocks, and the seconds of their training, one after the other."""
    blocks = range(1, options.count + 1)
    folders = [options.runs / f"block_{block}_{options.count}_{steps}_{seed}" for block in blocks]
    words, found = [*words_for(seed, steps, options.primitives), "eval.competitor=null"], []
    for folder, block in zip(folders, blocks, strict=True):
        found.append(train(folder, [*words, f"scene.block={block}/{options.count}"])["train_seconds"])
    return folders, sum(found)


def merged_row(seed: int, steps: int, options: argparse.Namespace, near: set[str]) -> Row:
    """Trains and merges blocks; returns the figures of the merged model."""
    folders, seconds = trained_blocks(seed, steps, options)
    merged = options.runs / f"merged_{options.count}_{steps}_{seed}"
    file = merged.with_suffix(".ply")
    if not (merged / "evaluation.json").is_file():
        merge_blocks(folders, file, plugins())
        gsx(["eval", str(file), *SCENE, ZOOMS, f"folder={merged}"])
    row = {"model": f"{options.count} blocks, merged", "steps": steps, "seconds": seconds} | figures(merged, near)
    assert row["primitives"] == len(read_splats(file).gaussians.means)
    return {"seed": seed} | row


def measure(seed: int, options: argparse.Namespace, near: set[str]) -> list[Row]:
    """Trains the scene in one piece and in blocks."""
    folder = options.runs / f"whole_{options.whole}_{seed}"
    whole = train(folder, [*words_for(seed, options.whole, WHOLE), ZOOMS])
    row = {"seed": seed, "model": "in one piece", "steps": options.whole, "seconds": whole["train_seconds"]}
    steps = [int(one) for one in options.steps.split(",")]
    return [row | figures(folder, near), *(merged_row(seed, one, options, near) for one in steps)]


def main(words: Sequence[str]) -> None:
    """Trains, merges and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0", help="by commas (0)")
    parser.add_argument("--whole", type=int, default=3000, help="steps of the model in one piece (3000)")
    parser.add_argument("--steps", default="1000,3000", help="steps of a block, by commas (1000,3000)")
    parser.add_argument("--primitives", type=int, default=2 * WHOLE // 3, help="budget of a block (20000)")
    parser.add_argument("--count", type=int, default=3, help="blocks (3)")
    parser.add_argument("--runs", type=Path, default=Path("outputs/blocks"), help="folder of the runs")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    near = views_near_cuts(options.count)
    rows = [row for seed in options.seeds.split(",") for row in measure(int(seed), options, near)]
    notes = [
        f"Held-out views; {len(near)} of 18 are within {NEAR:g} units of a cut. Steps of each block; seconds of all "
        f"blocks, one after the other. A block has {options.primitives:,} splats, of which those in its cell are kept."
    ]
    command = shown_command(words, "benchmarks/blocks.py")
    sections: dict[str, Section] = {"blocks": stamped("Blocks and one piece", COLUMNS, rows, notes, load, command)}
    write_results(options.to, "blocks_cpu", describe_machine(torch.device("cpu")), sections)
    print(text_table(sections["blocks"]))


if __name__ == "__main__":
    main(sys.argv[1:])
