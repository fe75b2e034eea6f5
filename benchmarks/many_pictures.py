"""How long does `gsx judge` take for many pictures? python benchmarks/many_pictures.py [--views 200] [--width 1600]

Makes a scene of photos of smooth noise with cameras on a circle, all of them test views but every second, and noisy
pictures of a method at x1 and x4. Measures wall time of the whole command and its peak memory.
"""

import argparse
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from gsx.core.data.camera import Camera, look_at
from gsx.core.data.images import read_image, write_image
from gsx.core.data.resize import resize
from gsx.core.data.scene import PointCloud
from gsx.experiments.prepare.colmap_files import write_model
from measuring.machine import describe_machine, shown_command, told_load
from measuring.opensplat import WRAPPER
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
DOWNSCALE = 4
ORIGIN = (0.0, 0.0, 0.0)
ARMS = {
    "all figures": (),
    "without the network's enlargement": ("eval.competitor=null",),
    "without networks": ("eval.competitor=null", "metrics.perceptual=[]"),
}
"""Settings of the command."""
COLUMNS = [
    *(["arm", "figures"], ["pictures", "pictures"], ["width", "px"], ["seconds", "wall time, s"]),
    *(["each", "s a picture"], ["peak_mb", "peak MB"]),
]


def smooth_noise(height: int, width: int, generator: torch.Generator) -> torch.Tensor:
    """Returns an 8-bit picture [3, height, width] of noise at several scales."""
    total = torch.zeros(3, height, width)
    for scale in (2, 8, 32):
        coarse = torch.rand(3, height // scale + 1, width // scale + 1, generator=generator)[None]
        total += torch.nn.functional.interpolate(coarse, size=(height, width), mode="bilinear")[0]
    return (total / 3 * 255).to(torch.uint8)


def camera_at(number: int, views: int, width: int, height: int) -> Camera:
    """Returns a camera on a circle that faces its middle."""
    angle = 2 * math.pi * number / views
    return look_at((3 * math.cos(angle), 3 * math.sin(angle), 1.0), ORIGIN, fov_x=1.0, width=width, height=height)


def write_scene(folder: Path, views: int, width: int) -> None:
    """Writes photos and a COLMAP model; every second photo, in the order of names, will be a test view."""
    (folder / "images").mkdir(parents=True)
    generator, height, cameras = torch.Generator().manual_seed(0), width * 2 // 3 // 4 * 4, []
    for number in range(2 * views):
        cameras.append((f"{number:04d}.png", camera_at(number, 2 * views, width, height)))
        if number % 2 == 0:
            write_image(folder / "images" / cameras[-1][0], smooth_noise(height, width, generator))
    still = smooth_noise(height, width, generator)
    for name, _ in cameras[1::2]:
        write_image(folder / "images" / name, still)
    points = PointCloud(positions=torch.rand(100, 3, generator=generator), colours=torch.zeros(100, 3).byte())
    write_model(folder / "sparse" / "0", cameras, points, ORIGIN)


def write_pictures(scene: Path, folder: Path) -> int:
    """Writes noisy pictures of the test views at x1 and x4; returns their number."""
    generator = torch.Generator().manual_seed(1)
    photos = sorted((scene / "images").iterdir())[::2]
    for photo in photos:
        whole = read_image(photo)
        for factor in (1, 4):
            height, width = (side * factor // DOWNSCALE for side in whole.shape[1:])
            picture = resize(whole, width, height, "bicubic").float()
            picture += 10 * torch.randn(picture.shape, generator=generator)
            (folder / f"x{factor}").mkdir(parents=True, exist_ok=True)
            write_image(folder / f"x{factor}" / photo.name, picture.clamp(0, 255).to(torch.uint8))
    return 2 * len(photos)


def measure(arm: str, place: Path, count: int, width: int, threads: int) -> dict[str, object]:
    """Compares the pictures with the scene by the command line."""
    words = ["judge", f"noisy={place / 'pictures'}", str(place / "scene"), f"scene.downscale={DOWNSCALE}"]
    words += ["scene.split=every:2", *ARMS[arm], "--to", str(place / arm.replace(" ", "_"))]
    peak, started = place / "peak", time.perf_counter()
    environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
    command = [sys.executable, "-c", WRAPPER, str(peak), sys.executable, "-m", "gsx", *words]
    subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
    seconds, memory = time.perf_counter() - started, int(peak.read_text()) * 1024 / 1e6
    row = {"arm": arm, "pictures": count, "width": width, "seconds": seconds, "each": seconds / count}
    return row | {"peak_mb": memory}


def main(words: Sequence[str]) -> None:
    """Makes pictures, measures and writes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--views", type=int, default=200, help="test views (200)")
    parser.add_argument("--width", type=int, default=1600, help="width of photos and of pictures at x4, px (1600)")
    parser.add_argument("--threads", type=int, default=2, help="threads (2)")
    parser.add_argument("--arms", default=",".join(ARMS), help="by commas")
    parser.add_argument("--to", type=Path, default=RESULTS, help="folder of the results")
    options, load = parser.parse_args(words), told_load()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        write_scene(place / "scene", options.views, options.width)
        count = write_pictures(place / "scene", place / "pictures")
        rows = [measure(arm, place, count, options.width, options.threads) for arm in options.arms.split(",")]
    note = "Half of the pictures are x1, a quarter of the width. Wall time of the whole command."
    command = shown_command(words, "benchmarks/many_pictures.py")
    section = stamped("Time of gsx judge", COLUMNS, rows, [note], load, command)
    sys.stdout.write(text_table(section))
    write_results(options.to, "many_pictures_cpu", describe_machine(torch.device("cpu")), {"many_pictures": section})


if __name__ == "__main__":
    main(sys.argv[1:])
