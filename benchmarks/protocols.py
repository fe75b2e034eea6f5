"""How far do figures of the same renders move between protocols? python benchmarks/protocols.py --runs FOLDER

    gsx prepare SCENE --to PREPARED/NAME ...         once for each scene
    gsx ... folder=FOLDER/NAME                       a run for each scene, by the name of the prepared one

Renders each run by `gsx judge --protocols`, and writes PSNR and SSIM by protocol, scene and zoom.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from gsx.core.files import read_json
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
PROTOCOLS = ("inria", "nerfbaselines", "gsplat", "nerfstudio")
"""Of conf/protocol: each measures otherwise; those of papers build on them."""
FIRST = PROTOCOLS[0]
SETTINGS = ("eval.competitor=null", "metrics.perceptual=[]", "eval.zoom=[1,4]")
COLUMNS = [
    *(["scene", "scene"], ["zoom", "zoom"], ["protocol", "protocol"], ["psnr", "PSNR, dB"], ["ssim", "SSIM"]),
    *(["psnr_more", "change, dB"], ["ssim_more", "change, SSIM"]),
]


def compared(prepared: Sequence[Path], runs: Path) -> list[dict[str, Any]]:
    """Returns the rows of gsx judge over all scenes and protocols."""
    with tempfile.TemporaryDirectory() as name:
        to = Path(name) / "compared"
        words = ["judge", f"run={runs}/{{scene}}", *map(str, prepared), "--protocols", ",".join(PROTOCOLS)]
        subprocess.run([sys.executable, "-m", "gsx", *words, *SETTINGS, "--to", str(to)], check=True)
        return list(read_json(to / "comparison.json")["rows"])


def changes(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the rows by scene and zoom, with changes from the first protocol."""
    first = {(row["scene"], row["zoom"]): row for row in rows if row["protocol"] == FIRST}
    found = []
    for row in sorted(rows, key=lambda row: (row["scene"], float(row["zoom"]), PROTOCOLS.index(row["protocol"]))):
        base = first[row["scene"], row["zoom"]]
        kept = {key: row[key] for key in ("scene", "protocol", "psnr", "ssim")} | {"zoom": f"x{row['zoom']}"}
        found.append(kept | {f"{key}_more": row[key] - base[key] for key in ("psnr", "ssim")})
    return found


def main(words: Sequence[str]) -> None:
    """Compares and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--prepared", type=Path, required=True, help="folder of prepared scenes")
    parser.add_argument("--runs", type=Path, required=True, help="folder of runs, one for each scene")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    scenes = [path for path in sorted(options.prepared.iterdir()) if (options.runs / path.name).is_dir()]
    rows = changes(compared(scenes, options.runs))
    steps = {path.name: read_json(options.runs / path.name / "evaluation.json")["step"] for path in scenes}
    listed = ", ".join(f"{name} {count:,}" for name, count in steps.items())
    note = f"Means over test views of renders by gs3d_zoom, steps: {listed}. Changes are from protocol {FIRST}."
    command = shown_command(words, "benchmarks/protocols.py")
    section = stamped("The same renders by several protocols", COLUMNS, rows, [note], load, command)
    sys.stdout.write(text_table(section))
    write_results(options.to, "protocols_cpu", describe_machine(torch.device("cpu")), {"protocols": section})


if __name__ == "__main__":
    main(sys.argv[1:])
