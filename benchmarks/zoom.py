"""Looking closer, and from afar, on held-out true pixels: the tables of docs/benchmarks/zooming.md.

    python benchmarks/zoom.py [--what compositions,afar] --scenes FOLDER [--only fox,lego] [--seeds 0,1,2] [--jobs 2]

FOLDER holds `fox`, `desk_bottle` (COLMAP), `lego` (NeRF-Synthetic) and `castle` (photographs alone); without it only
the built-in scene is measured. Tables (--what): `rules`: each scene is trained by plain 3D-GS, once a seed, and drawn
by every rule for zoomed cameras. `compositions`: each is trained by mip_splatting and by its preset for zooming in.
`cooled`: by the preset, and by it with learning rates that stay. `views`: by the preset with `backbone.mip.views=2`.
`parts`: by parts of the preset. `levels`: by Octree-GS with its preset for zooming in. `pictures`: by the preset with
pseudo details, enlarged or true, in half of the run; `trusted`: by such that narrow the 3D filter. `afar`: what
compositions draw from four times as far as photographs were taken, by each way of looking. Finished runs below --runs
are not trained again. Some hours on two cores. What `gsx +experiment=zoom_truth` finds is measured by
benchmarks/zoom_truth.py.
"""

import argparse
import re
import statistics
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Lock
from typing import Any

import torch

from gsx.builtin import plugins
from gsx.core.files import read_json, write_json
from gsx.core.quality.metrics import psnr
from gsx.experiments.evaluation.evaluator import Evaluator
from gsx.experiments.run_folder.files import read_run
from gsx.experiments.run_folder.run_key import comparable
from gsx.experiments.runs.compose import compose
from gsx.experiments.runs.open import open_run
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import read_sections, stamped, text_table, write_results
from measuring.runs import train

RESULTS = Path(__file__).parent / "results"
SUBJECTS = {
    "fox": ("scene=colmap", "scene.downscale=8", "iterations=1000"),
    "lego": ("scene=blender", "scene.downscale=4", "iterations=1200"),
    "desk_bottle": ("scene=colmap", "scene.downscale=8", "iterations=1000"),
    "castle": ("scene=photos", "scene.downscale=8", "iterations=800"),
    "office": ("scene=colmap", "scene.downscale=4", "iterations=1000"),
    "demo": ("scene=demo", "iterations=900"),
    "room": ("scene=room", "iterations=1500"),
    "mixed": ("scene=demo", "scene.distances=mixed", "iterations=900"),
}
BUILT_IN = ("demo", "room", "mixed")
USUAL = "fox,lego,desk_bottle,castle,demo"
RULES = ("none", "magnified", "resampled")
"""Values of backbone.filter that suit a model of plain 3D-GS."""
ZOOMS = ("1", "2", "4")
MIP = ("backbone=mip_splatting",)
ZOOM = (*MIP, "preset=zoom", "backbone.capacity=published")
"""Growth has tables of its own (benchmarks/capacity.py)."""
EARLY = (*ZOOM, "training.supersampling.start=0.5")
COMPOSITIONS = {"mip_splatting": MIP, "preset=zoom": ZOOM}
"""Overrides by the name of a row."""
VIEWS = {"mip_splatting": MIP, "preset=zoom, views=2": (*ZOOM, "backbone.mip.views=2")}
"""With a narrower 3D filter where many views sample a place."""
COOLED = {"preset=zoom, rates held": (*ZOOM, "training.cooldown=0"), "preset=zoom": ZOOM}
"""With learning rates that stay, and that go down at the end."""
PARTS = {
    "mip_splatting": MIP,
    "finer pixels alone": (*MIP, "training.supersampling.factor=2", "training.supersampling.start=0.5"),
    "rates alone": (*EARLY, "training.supersampling.factor=1"),
    "finer pixels and rates": EARLY,
}
"""Finer pixels in the second half of the steps."""
LEVELS = {"preset=octree_zoom": ("backbone=octree_scaffold", "preset=octree_zoom")}


def strong(scale: int) -> tuple[str, ...]:
    """Pseudo views so many times as fine count for half of the run, by absolute values; the rest is the augmenter's
    default."""
    return (
        *(*EARLY, "augmenter=upscale", "augmenter.upscale.timing.start=20000", f"augmenter.upscale.scales=[{scale}]"),
        *("augmenter.upscale.loss=l1", "augmenter.upscale.gain=1"),
    )


LANCZOS, ORACLE = (("regenerator/upscale=lanczos",), ("regenerator/upscale=oracle",))
REPLACING = ("augmenter.upscale.mode=hybrid", "augmenter.upscale.weights=[0.6,0.6]")
"""0.6 of the photographs' loss."""
ADDED = ("augmenter.upscale.mode=direct",)
"""To the photographs' loss, at weight 1."""
PICTURES = {
    "lanczos replacing 0.6": (*strong(2), *REPLACING, *LANCZOS),
    "oracle replacing 0.6": (*strong(2), *REPLACING, *ORACLE),
    "lanczos added": (*strong(2), *ADDED, *LANCZOS),
    "oracle added": (*strong(2), *ADDED, *ORACLE),
}
TRUSTED = {
    "lanczos x4, filter narrowed": (*strong(4), *REPLACING, *LANCZOS, "backbone.mip.pseudo=true"),
    "oracle x4, filter narrowed": (*strong(4), *REPLACING, *ORACLE, "backbone.mip.pseudo=true"),
}
"""Pseudo views four times as fine, which narrow the 3D filter of what they see."""
WAYS = {
    "samples of its pixels": ("eval.supersample=1",),
    "four times as fine, reduced": ("eval.supersample=4",),
    "as trained": (),
}
"""Of looking from afar: overrides by the name of a row."""
COMPOSING = Lock()
"""Hydra has one session at a time."""
COMPARED = ("backbone", "training", "augmenter", "regenerator", "scene", "seed", "iterations")
"""Keys in which runs of one row may not differ."""
AFAR, FEW = 0.25, 25
"""The zoom, and of how many test views."""


def numbers(text: str) -> list[int]:
    """Numbers by commas."""
    return [int(word) for word in text.split(",")]


def shared_arguments(description: str | None, only: str, kept: str) -> argparse.ArgumentParser:
    """What benchmarks over captures are all asked; only: their scenes, by commas; kept: where their runs are."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, default=None, help="the folder with the captures")
    parser.add_argument("--only", default=only, help="scenes, by commas")
    parser.add_argument("--seeds", type=numbers, default=[0, 1, 2], help="by commas (0,1,2)")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--runs", type=Path, default=Path(kept), help="where the runs are kept")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the tables")
    return parser


def arguments(words: Sequence[str]) -> argparse.Namespace:
    """The command line."""
    parser = shared_arguments(__doc__, USUAL, "outputs/zoom")
    parser.add_argument("--what", default="rules,compositions,parts,levels,pictures,afar", help="tables, by commas")
    parser.add_argument("--label", default="", help="of tables over other scenes or seeds: added to their names")
    return parser.parse_args(words)


def refuse_unknown(asked: str, known: Collection[str]) -> None:
    """End with a message where a name is none of those known; asked: by commas."""
    if unknown := [name for name in asked.split(",") if name not in known]:
        sys.exit(f"{', '.join(unknown)}: choose from {', '.join(known)}")


def scenes_at_hand(given: argparse.Namespace) -> list[str]:
    """Those asked for that are there; ends with a message where there are none."""
    refuse_unknown(given.only, SUBJECTS)
    scenes = [name for name in given.only.split(",") if name in BUILT_IN or given.scenes is not None]
    if not scenes:
        sys.exit(f"--only {given.only}: all but {' and '.join(BUILT_IN)} need --scenes FOLDER")
    return scenes


def steps_among(words: Sequence[str]) -> int:
    """What `iterations=` among overrides says."""
    return next(int(word.partition("=")[2]) for word in words if word.startswith("iterations="))


def folder_of(scene: str, seed: int, given: argparse.Namespace, name: str = "") -> Path:
    """Where a run is kept; `name`: of its composition, plain 3D-GS without one."""
    return given.runs / "_".join([*re.findall(r"\w+", name), scene, str(seed)])


def trained(scene: str, seed: int, given: argparse.Namespace, overrides: Sequence[str], name: str = "") -> Path:
    """The folder of a run, which is trained unless it is there; overrides win over the subject's own."""
    where = () if scene in BUILT_IN else (f"scene.path={given.scenes / scene}",)
    threads = {"OMP_NUM_THREADS": "1"} if given.jobs > 1 else {}
    folder = folder_of(scene, seed, given, name)
    print(time.strftime("%H:%M"), folder.name, flush=True)
    words = [*SUBJECTS[scene], *where, f"seed={seed}", f"eval.zoom=[{','.join(ZOOMS)}]", *overrides]
    refuse_another(folder, words)
    train(folder, words, threads, folder.with_name(f"{folder.name}.log"))
    return folder


def refuse_another(folder: Path, words: Sequence[str]) -> None:
    """End with a message where a folder holds a finished run of another composition, perhaps of an earlier preset."""
    if not (folder / "evaluation.json").is_file():
        return
    with COMPOSING:
        asked = compose(words, plugins())
    there = read_run(folder).config
    own, others = (comparable({key: config.get(key) for key in COMPARED}) for config in (asked.resolved, there))
    differing = [key for key in own.keys() & others.keys() - asked.idle if own[key] != others[key]]
    if differing:
        sys.exit(f"{folder} was trained by another {', '.join(sorted(differing))}: remove it, or give other --runs")


def seen_from_afar(folder: Path, way: str, overrides: Sequence[str]) -> float:
    """Mean PSNR of a trained run at AFAR times the training resolution, by one way of looking; kept beside it."""
    path = (folder / "_".join(["afar", *re.findall(r"\w+", way)])).with_suffix(".json")
    if not path.is_file():
        run, settings = open_run(folder, plugins(), overrides)
        options, test = settings.evaluation, run.scene.test
        evaluator = Evaluator(run, options)
        views = [view.zoom(AFAR) for view in test[:: -(-len(test) // FEW)]]
        shown = [(options.measured(evaluator.renders.render(v, AFAR).image), v.image()) for v in views if v is not None]
        write_json(path, {"psnr": statistics.mean(psnr(image, truth) for image, truth in shown)})
    return float(read_json(path)["psnr"])


def render_probe(folder: Path, name: str, overrides: Sequence[str]) -> dict[str, Any]:
    """Figures by zoom of a trained run under other settings; kept beside it."""
    path = folder / f"zoom_{name}.json"
    if not path.is_file():
        run, settings = open_run(folder, plugins(), overrides)
        write_json(path, Evaluator(run, settings.evaluation).evaluate()["zoom"])
    return read_json(path)


def figure(shown: Sequence[dict[str, Any]], factor: str, *keys: str) -> list[float]:
    """One figure of every seed."""
    out = []
    for zoom in shown:
        value: Any = zoom[factor]
        for key in keys:
            value = value[key]
        out.append(value)
    return out


def told(values: Sequence[float], form: str, form_of_half: str = ".2f") -> str:
    """Mean, ± half the range where there are several."""
    half = f" ± {(max(values) - min(values)) / 2:{form_of_half}}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{form}}{half}"


def row_of(shown: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Figures over seeds at each zoom, beside the competitors'."""
    row: dict[str, Any] = {"seeds": len(shown)}
    for factor in ZOOMS if shown else ():
        own = figure(shown, factor, "psnr")
        row[f"x{factor}"] = told(own, ".2f")
        if factor != "1":
            enlarged = figure(shown, factor, "enlarged_psnr")
            row[f"over{factor}"] = told([a - b for a, b in zip(own, enlarged, strict=True)], "+.2f")
            row[f"photograph{factor}"] = told(figure(shown, factor, "photograph_psnr"), ".2f")
            for name in ("render", "enlarged", "photograph"):
                share = figure(shown, factor, "detail", name, "explained")
                row[f"{name}_detail{factor}"] = f"{statistics.mean(share):+.3f}"
    return row


def columns_of(kind: str, competitors: bool) -> list[list[str]]:
    """Keys and headings; with what competitors have of detail."""
    columns = [["scene", "scene"], ["name", kind], ["seeds", "seeds"], ["x1", "x1"]]
    for factor in ZOOMS[1:]:
        columns += [[f"x{factor}", f"x{factor}"], [f"over{factor}", f"x{factor} - x1 enlarged"]]
        if competitors:
            columns += [[f"photograph{factor}", f"photograph enlarged to x{factor}"]]
        columns += [[f"render_detail{factor}", f"detail x{factor}"]]
        if competitors:
            columns += [
                [f"enlarged_detail{factor}", "of x1 enlarged"],
                [f"photograph_detail{factor}", "of the photograph"],
            ]
    return columns


Measured = tuple[str, list[list[str]], list[dict[str, Any]], str]
"""Title, columns, rows, a note."""
Measure = Callable[[Sequence[str], argparse.Namespace], Measured]
"""What makes a table of scenes and the command line."""


def rules(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Plain 3D-GS by each rule for zoomed cameras."""

    def look(scene: str, seed: int) -> dict[str, Any]:
        folder = trained(scene, seed, given, ["backbone=gs3d"])
        return {rule: render_probe(folder, rule, [f"backbone.filter={rule}"]) for rule in RULES}

    found = over_seeds(look, scenes, given)
    rows = [{"scene": s, "name": rule} | row_of([one[rule] for one in found[s]]) for s in scenes for rule in RULES]
    note = (
        "Plain 3D-GS trained by photographs alone, drawn by each rule; PSNR on held-out views and explained detail "
        "above the training Nyquist frequency, means over seeds ± half their range; differences seed by seed."
    )
    return "Ways of looking closer", columns_of("backbone.filter", competitors=True), rows, note


def compositions(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Trained for zooming in, and not."""
    return "Compositions for zooming in", *compared(COMPOSITIONS, scenes, given)


def views(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """The preset with a 3D filter that knows several views."""
    return "Several views in the 3D filter", *compared(VIEWS, scenes, given)


def cooled(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """The preset with learning rates that stay, and that go down at the end."""
    return "Learning rates of preset=zoom that go down at the end", *compared(COOLED, scenes, given)


def parts(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """What each part of the preset does."""
    return "Parts of preset=zoom", *compared(PARTS, scenes, given)


def levels(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """Octree-GS with its preset for zooming in."""
    return "Octree-GS for zooming in", *compared(LEVELS, scenes, given)


def pictures(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """With pseudo details, enlarged by a filter or true."""
    return "Pseudo details on a composition for zooming in", *compared(PICTURES, scenes, given)


def trusted(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """With pseudo details that narrow the 3D filter, enlarged by a filter or true."""
    return "Pseudo details that narrow the 3D filter", *compared(TRUSTED, scenes, given)


def compared(
    named: Mapping[str, tuple[str, ...]], scenes: Sequence[str], given: argparse.Namespace
) -> tuple[list[list[str]], list[dict[str, Any]], str]:
    """(columns, rows, a note) of compositions by name, each against the first with the same seed."""
    base = next(iter(named))

    def look(scene: str, seed: int) -> dict[str, Any]:
        folders = {name: trained(scene, seed, given, words, name) for name, words in named.items()}
        return {name: read_json(folder / "evaluation.json") for name, folder in folders.items()}

    found, rows = over_seeds(look, scenes, given), []
    for scene in scenes:
        for name in named:
            pairs = [(one[name], one[base]) for one in found[scene]]
            row = {"scene": scene, "name": name} | row_of([own["zoom"] for own, _ in pairs])
            for factor in ZOOMS:
                gains = [own["zoom"][factor]["psnr"] - first["zoom"][factor]["psnr"] for own, first in pairs]
                row[f"more{factor}"] = told(gains, "+.2f")
            least = [min(run["train_seconds"] for run in runs) for runs in zip(*pairs, strict=True)]
            row["primitives"] = round(statistics.mean(own["primitives"] for own, _ in pairs))
            rows.append(row | {"times": f"{least[0] / least[1]:.2f}"})
    columns = columns_of("composition", competitors=False)
    columns += [[f"more{factor}", f"x{factor} - {base}"] for factor in ZOOMS]
    columns += [["primitives", "primitives"], ["times", f"training time / {base}"]]
    note = (
        "PSNR on held-out views and explained detail above the training Nyquist frequency, means over seeds ± half "
        f"their range; differences seed by seed. The same steps; runs at a time: {given.jobs}, times are the least."
    )
    return columns, rows, note


def afar(scenes: Sequence[str], given: argparse.Namespace) -> Measured:
    """A quarter of the resolution of training, by each way of looking."""

    def look(scene: str, seed: int) -> dict[Any, Any]:
        out: dict[Any, Any] = {}
        for name, words in COMPOSITIONS.items():
            folder = trained(scene, seed, given, words, name)
            for way, more in WAYS.items():
                out[name, way] = seen_from_afar(folder, way, more)
        return out

    found, rows = over_seeds(look, scenes, given), []
    for scene in scenes:
        for name in COMPOSITIONS:
            for way in WAYS:
                shown = [one[name, way] for one in found[scene]]
                rows.append({"scene": scene, "name": name, "way": way, "seeds": len(shown), "psnr": told(shown, ".2f")})
    columns = [["scene", "scene"], ["name", "composition"], ["way", "looked at by"], ["seeds", "seeds"]]
    note = (
        f"PSNR on at most {FEW} held-out views at a quarter of the training resolution, means over seeds ± half their "
        "range."
    )
    return "Looking from afar", [*columns, ["psnr", "x1/4"]], rows, note


def over_seeds(
    look: Callable[[str, int], dict[Any, Any]], scenes: Sequence[str], given: argparse.Namespace
) -> dict[str, list[dict[Any, Any]]]:
    """What was found with every seed, by scene."""
    with ThreadPoolExecutor(given.jobs) as pool:
        tasks = {(scene, seed): pool.submit(look, scene, seed) for seed in given.seeds for scene in scenes}
        return {scene: [tasks[scene, seed].result() for seed in given.seeds] for scene in scenes}


WHAT: dict[str, Measure] = {
    "rules": rules,
    "compositions": compositions,
    "cooled": cooled,
    "views": views,
    "parts": parts,
    "levels": levels,
    "pictures": pictures,
    "trusted": trusted,
    "afar": afar,
}


def write_tables(
    words: Sequence[str], given: argparse.Namespace, name: str, what: Mapping[str, Measure], label: str = ""
) -> None:
    """Train and look, and write the tables asked for by --what to NAME_cpu.json (the name of the benchmark); `label` is
    added to those of the tables."""
    machine, load = describe_machine(torch.device("cpu")), told_load()
    machine |= {"threads": 1} if given.jobs > 1 else {}
    read_sections(given.to / f"{name}_cpu.json")  # what cannot be added to is refused before training
    refuse_unknown(given.what, what)
    scenes = scenes_at_hand(given)
    for kind in given.what.split(","):
        title, columns, rows, note = what[kind](scenes, given)
        table = stamped(title, columns, rows, [note], load, shown_command(words, f"benchmarks/{name}.py"))
        write_results(given.to, f"{name}_cpu", machine, {kind + label: table})
        print(text_table(table))


def main(words: Sequence[str]) -> None:
    """Train and look, and write the tables."""
    given = arguments(words)
    write_tables(words, given, "zoom", WHAT, given.label)


if __name__ == "__main__":
    main(sys.argv[1:])
