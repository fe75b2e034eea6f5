"""README.txt of a prepared folder: its files, and commands of other programs."""

import shlex
from collections.abc import Mapping
from typing import Any

VERB = "judge"

FILES = """\
Files
  images/               photos to train on, 8 bits{with_test}
{masks}  sparse/0/             COLMAP model of the photos in images/: pinhole cameras, poses, points
  all_views/sparse/0/   the same with all training and test views
  transforms.json       the cameras of images/ for nerfstudio and OpenSplat; points.ply: the points
  test_views.txt        names of the pictures to render, one a line
  cameras_xK.json       test cameras at K times the training resolution; the file states its convention
  test_xK/sparse/0/     the same cameras as a COLMAP model
{truth}  prepared.json         manifest: settings, protocol and its hash, names of views
"""

COMMANDS = {
    "3D-GS": "python train.py -s FOLDER -r 1{white}{eval}",
    "gsplat": (
        "python examples/simple_trainer.py default --data_dir FOLDER --data_factor 1 --test_every {every} "
        "--no-normalize-world-space"
    ),
    "nerfstudio": (
        "ns-train splatfacto{background} --data FOLDER nerfstudio-data{all} --orientation-method none "
        "--center-method none --auto-scale-poses False"
    ),
    "OpenSplat": "opensplat FOLDER --keep-crs",
}
"""Commands that train by program."""
COLOURS = {(0, 0, 0): "black", (1, 1, 1): "white"}
"""Backgrounds that nerfstudio can name."""

EVALUATE = f"""\
Evaluate
  Render the cameras of cameras_xK.json to PICTURES/xK/ under the names in test_views.txt, or save a splat file in the
  coordinates of sparse/0. Then:
    gsx {VERB} NAME=PICTURES FOLDER
    gsx {VERB} NAME=model.ply FOLDER
"""


def readme_of(name: str, manifest: Mapping[str, Any]) -> str:
    """Return the text for a scene's manifest."""
    return "\n".join([heading(name, manifest), files(manifest), training(manifest), EVALUATE])


def heading(name: str, manifest: Mapping[str, Any]) -> str:
    """Return the first paragraph."""
    width, height = manifest["protocol"]["size"]
    views = f"{len(manifest['train'])} training and {len(manifest['test'])} test views of {width} x {height} px"
    reduced = f"reduced by filter={manifest['filter']} of {manifest['light']} values"
    made = reduced if "resize" in manifest["protocol"]["scene"] else "rendered at that size"
    return (
        f"Scene '{name}' as gsx {manifest['gsx']} trains on it: {views}, {made}.\n"
        f"Protocol {manifest['protocol']['hash']}. Settings: {shlex.join(manifest['overrides'])}\n"
    )


def files(manifest: Mapping[str, Any]) -> str:
    """Return the paragraph on the files."""
    masks = "  masks/                masks of the photos; white pixels count\n"
    truth = "  truth/xK/             test photos at each zoom\n"
    return FILES.format(
        with_test=", and test photos" if manifest["with_test"] else "",
        masks=masks if manifest["masks"] else "",
        truth=truth if manifest["with_truth"] else "",
    )


def training(manifest: Mapping[str, Any]) -> str:
    """Return the commands that train on the training views alone."""
    test, eighth = manifest["with_test"], manifest["every_8th_is_test"]
    background = COLOURS.get(tuple(manifest["background"]), "")
    values = {
        "white": " --white_background" if background == "white" else "",
        "eval": " --eval" if test else "",
        "every": 8 if test else 1_000_000,
        "background": f" --pipeline.model.background-color {background}" if background else "",
        "all": "" if test else " --eval-mode all",
    }
    programs = COMMANDS if not test else ("3D-GS", "gsplat", "nerfstudio") if eighth else ("nerfstudio",)
    lines = [f"  {program:12} {COMMANDS[program].format(**values)}" for program in programs]
    return "\n".join(["Train (FOLDER is this folder)", *lines, caution(test, eighth)])


def caution(test: bool, eighth: bool) -> str:
    """Return a sentence on programs that split otherwise."""
    if not test:
        return "  gsplat's trainer holds out the first photo even so; the others train on all of images/.\n"
    others = "OpenSplat trains" if eighth else "3D-GS, gsplat and OpenSplat train"
    return f"  {others} on test photos here: prepare without --with-test.\n"
