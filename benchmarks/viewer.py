"""gsx view in a real browser: python benchmarks/viewer.py RUN [--training WORDS ...]

Starts `gsx view RUN` as a user would, turns the model with the mouse in headless Chromium, counts the pictures that
arrive, waits until the last is sharp, keeps screenshots in docs/viewer/. With --training it does the same first with
`gsx WORDS viewer=true`. What the browser's console said is counted, too. Needs Chromium, viser and websockets.
"""

import argparse
import math
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from gsx.builtin import plugins
from gsx.core.data.images import read_image, write_image
from gsx.experiments.runs.view import WatchedRun
from gsx.experiments.viewer.pictures import Look, RunModel, picture
from gsx.experiments.viewer.server import pose_of
from measuring.machine import ROOT, describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

sys.path.insert(0, str(ROOT / "tests"))
import itertools

from browser import browser  # type: ignore[import-not-found]

RESULTS, PICTURES = Path(__file__).parent / "results", ROOT / "docs" / "viewer"
SIZE, MOVING, REST, QUIET = (800, 560), 8.0, 90.0, 8.0
"""Of the window, px; seconds that the mouse moves; seconds at most until the picture is sharp, and without
a finer one after which it is."""
WIDTHS, DRAWING = (160, 320, 640, 1100), 5.0
"""Of pictures drawn without a browser, px; seconds for each."""
ALONE = [["run", "run"], ["width", "width, px"], ["rate", "pictures/s"]]
COUNTING = """
window.pictures = [];
const Plain = window.Worker;
window.Worker = class extends Plain {
  constructor(...given) {
    super(...given);
    this.addEventListener("message", (event) => {
      const text = JSON.stringify(event.data, (_, value) => (ArrayBuffer.isView(value) ? null : value)) || "";
      if (text.includes("BackgroundImage")) window.pictures.push(performance.now() / 1000);
    });
  }
};
"""
"""Remembers when pictures reach the page: viser's messages come through a worker."""
COLUMNS = [
    ["run", "run"],
    ["when", "when"],
    ["model", "model"],
    ["rate", "pictures/s while moving"],
    ["gap", "longest gap, s"],
    ["sharp", "s until sharp"],
    ["console", "console: errors and warnings"],
]


@contextmanager
def served(words: Sequence[str]) -> Iterator[str]:
    """The address that a command of gsx shows its model at."""
    command = [sys.executable, "-m", "gsx", *words]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    try:
        for line in process.stdout:
            sys.stderr.write(line)
            if found := re.search(r"http://127\.0\.0\.1:\d+", line):
                yield found.group()
                break
        else:
            raise SystemExit(f"gsx {' '.join(words)} showed nothing")
    finally:
        process.kill()
        process.wait()


def arrivals(page: Any) -> list[float]:
    """Seconds at which pictures came, by the page's clock."""
    return page.value("window.pictures")


def drag(page: Any, seconds: float) -> None:
    """Turn the model with the left button, in a slow eight."""
    begun, x, y = time.monotonic(), SIZE[0] / 3, SIZE[1] / 2
    page.call("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
    while (at := time.monotonic() - begun) < seconds:
        x, y = SIZE[0] / 3 + 90 * math.sin(0.8 * at), SIZE[1] / 2 + 25 * math.sin(1.6 * at)
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
        time.sleep(0.04)
    page.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)


def settled(page: Any) -> float:
    """Seconds from now until no further picture comes."""
    begun, known, last = time.monotonic(), len(arrivals(page)), time.monotonic()
    while time.monotonic() - begun < REST and time.monotonic() - last < QUIET:
        if len(arrivals(page)) > known:
            known, last = len(arrivals(page)), time.monotonic()
        time.sleep(0.1)
    return last - begun


def drawn_alone(folder: Path) -> list[dict[str, Any]]:
    """Pictures a second by width, with no browser on the same cores; the first counts for nothing."""
    watched, rows = WatchedRun(folder, plugins()), []
    watched.compiling.join()
    model, view = RunModel(watched.run), watched.run.scene.test[0]
    for width in WIDTHS:
        with torch.no_grad():
            picture(model, pose_of(view, SIZE[0]), Look(), width)
            begun, count = time.monotonic(), 0
            while time.monotonic() - begun < DRAWING:
                picture(model, pose_of(view, SIZE[0]), Look(), width)
                count += 1
        rows.append({"run": folder.name, "width": width, "rate": count / (time.monotonic() - begun)})
    return rows


def render_probe(name: str, when: str, words: Sequence[str], patience: float = 0.0) -> dict[str, Any]:
    """Figures of one session, whose pictures are kept."""
    with served(words) as address, browser(*SIZE) as page:
        page.call("Page.addScriptToEvaluateOnNewDocument", source=COUNTING)
        page.open(address)
        page.wait_for("document.body?.innerText.includes('primitives')", 120)
        time.sleep(patience)
        settled(page)
        kept(page, f"{when}.jpg")
        drag(page, 1.0)
        first = len(arrivals(page))
        drag(page, MOVING)
        moving = arrivals(page)[first:]
        kept(page, f"{when}_moving.jpg")
        sharp = settled(page)
        told = page.value("document.body.innerText")
        gaps = [after - before for before, after in itertools.pairwise(moving)]
        found = re.search(r"step [\d,]+ of [\d,]+, [\d,]+ primitives", told)
        sys.stderr.writelines(f"console: {said}\n" for said in page.said)
        return {
            "run": name,
            "when": when.replace("_", " "),
            "model": found.group() if found else "",
            "rate": len(moving) / MOVING,
            "gap": max(gaps, default=MOVING),
            "sharp": sharp,
            "console": len(page.said),
        }


def kept(page: Any, name: str) -> None:
    """A screenshot in docs/viewer/."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    picture = page.picture(PICTURES / "screenshot.png")
    write_image(PICTURES / name, read_image(picture)[:3])
    picture.unlink()


def main(words: Sequence[str]) -> None:
    """Look, show and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, metavar="RUN", help="a finished run")
    parser.add_argument("--training", nargs="*", default=[], metavar="WORD", help="words of a run to look at meanwhile")
    given, load = parser.parse_args(words), told_load()
    rows = []
    if given.training:
        words_of_training = [*given.training, "viewer=true", "viewer_port=0"]
        rows.append(render_probe(given.run.name, "during_training", words_of_training, 60.0))
    rows.append(render_probe(given.run.name, "after_training", ["view", str(given.run), "--port", "0"]))
    note = (
        f"A window of {SIZE[0]} x {SIZE[1]} px; the mouse turns the model for {MOVING:g} s; pictures: that arrive. "
        "Chromium draws without a GPU, on the same cores."
    )
    command = shown_command(words, "benchmarks/viewer.py")
    alone = stamped(
        "Pictures drawn, with no browser on the same cores", ALONE, drawn_alone(given.run), [], load, command
    )
    sys.stdout.write(text_table(alone))
    section = stamped("The viewer in Chromium", COLUMNS, rows, [note], load, command)
    sys.stdout.write(text_table(section))
    write_results(RESULTS, "viewer_cpu", describe_machine(torch.device("cpu")), {"alone": alone, "viewer": section})


if __name__ == "__main__":
    main(sys.argv[1:])
