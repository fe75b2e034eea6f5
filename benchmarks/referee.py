"""Is gsx a fair judge of other programs' splats? python benchmarks/referee.py SCENE

Trains a small splat on a COLMAP scene with gsplat's own projection, spherical harmonics and export (its torch path, pip
install gsplat; no gsx in it: pycolmap reads the cameras, Pillow the photographs), computes PSNR of held-out views there
and then, at x1 and x2, and has `gsx eval FILE` judge the exported file.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import fmean

import numpy as np
import pycolmap
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci, _spherical_harmonics
from gsplat.exporter import export_splats
from PIL import Image
from torch import Tensor

from gsx.core.shapes import Float
from measuring.machine import describe_machine, shown_command, told_load
from measuring.results import stamped, text_table, write_results

RESULTS = Path(__file__).parent / "results"
DOWNSCALE, STEPS, WINDOW, DEGREE = 8, 250, (48, 48), 1
RATES = {"means": 1e-3, "scales": 1e-2, "quats": 2e-3, "opacities": 5e-2, "sh0": 1e-2, "shN": 1e-3}
"""Of Adam; for few steps."""
LEAST_ALPHA, MOST_ALPHA, LEAST_LIGHT = 1 / 255, 0.99, 1e-4
"""3D-GS: contributions below are left out, above are limited; a pixel is done when so much light is left."""
COLUMNS = [["zoom", "zoom"], ["direct", "computed directly, dB"], ["judged", "gsx eval, dB"], ["off", "difference, dB"]]
Model = dict[str, Tensor]


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph and its camera at full size."""

    path: Path
    view: Float[Tensor, "4 4"]
    """camera_from_world."""
    focal: tuple[float, float, float, float]
    """fx, fy, cx, cy, px."""
    size: tuple[int, int]

    def at(self, zoom: int) -> tuple[Float[Tensor, "H W 3"], Float[Tensor, "3 3"]]:
        """(the photograph at `zoom` times the training size, intrinsics there)."""
        width, height = (zoom * round(side / DOWNSCALE) for side in self.size)
        photo = Image.open(self.path).convert("RGB").resize((width, height), Image.Resampling.BICUBIC)
        (fx, fy, cx, cy), across, down = self.focal, width / self.size[0], height / self.size[1]
        matrix = [[fx * across, 0, cx * across], [0, fy * down, cy * down], [0, 0, 1]]
        return torch.from_numpy(np.asarray(photo).copy()).float() / 255, torch.tensor(matrix, dtype=torch.float32)


def shots_of(scene: Path) -> tuple[list[Shot], list[Shot], Model]:
    """(training shots, every eighth by name held out as 3D-GS does, points and colours)."""
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    shots = []
    for image in sorted(model.images.values(), key=lambda one: one.name):
        camera, view = model.cameras[image.camera_id], torch.eye(4)
        view[:3] = torch.from_numpy(image.cam_from_world().matrix()).float()
        fx, fy, cx, cy = camera.params
        shots.append(Shot(scene / "images" / image.name, view, (fx, fy, cx, cy), (camera.width, camera.height)))
    points = list(model.points3D.values())
    cloud = {
        "xyz": torch.tensor(np.array([point.xyz for point in points])).float(),
        "rgb": torch.tensor(np.array([point.color for point in points])).float() / 255,
    }
    return [s for i, s in enumerate(shots) if i % 8], shots[::8], cloud


def started(cloud: Model) -> Model:
    """A Gaussian for each point, as wide as its three nearest neighbours are far."""
    means, count = cloud["xyz"], len(cloud["xyz"])
    nearest = [torch.cdist(part, means).topk(4, largest=False).values[:, 1:] for part in means.split(1000)]
    far = torch.cat(nearest).mean(1).clamp(min=1e-4)
    return {
        "means": means.clone(),
        "scales": far.log()[:, None].repeat(1, 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        "opacities": torch.full((count,), -1.0),
        "sh0": ((cloud["rgb"] - 0.5) / 0.28209479177387814)[:, None],
        "shN": torch.zeros(count, (DEGREE + 1) ** 2 - 1, 3),
    }


def drawn(
    model: Model,
    view: Float[Tensor, "4 4"],
    matrix: Float[Tensor, "3 3"],
    size: tuple[int, int],
    window: tuple[int, int, int, int],
) -> Float[Tensor, "height width 3"]:
    """The window (left, top, width, height) of a render of `size`, over black."""
    left, top, width, height = window
    covars, _ = _quat_scale_to_covar_preci(model["quats"], model["scales"].exp(), compute_preci=False)
    radii, places, depths, conics, _ = _fully_fused_projection(
        model["means"], covars, view[None], matrix[None], *size, near_plane=0.2
    )
    radii, places, depths, conics = radii[0].float(), places[0], depths[0], conics[0]
    low = torch.tensor([left, top]).float()
    high = low + torch.tensor([width, height])
    reach = radii.amax(1, keepdim=True)
    hit = (radii > 0).all(1) & (places + reach > low).all(1) & (places - reach < high).all(1)
    rows = hit.nonzero()[:, 0]
    rows = rows[depths[rows].argsort()]
    centre = -view[:3, :3].T @ view[:3, 3]
    bands = torch.cat([model["sh0"], model["shN"]], 1)[rows]
    colours = (_spherical_harmonics(DEGREE, model["means"][rows] - centre, bands) + 0.5).clamp(min=0)
    ys, xs = torch.meshgrid(torch.arange(height) + top + 0.5, torch.arange(width) + left + 0.5, indexing="ij")
    x, y = xs.reshape(-1, 1) - places[rows, 0], ys.reshape(-1, 1) - places[rows, 1]
    a, b, c = conics[rows].unbind(1)
    power = -0.5 * (a * x * x + c * y * y) - b * x * y
    alpha = (torch.sigmoid(model["opacities"][rows]) * power.clamp(max=0).exp()).clamp(max=MOST_ALPHA)
    alpha = torch.where(alpha < LEAST_ALPHA, 0, alpha)
    light = torch.cumprod(torch.cat([torch.ones(len(alpha), 1), 1 - alpha], 1), 1)
    weights = torch.where(light[:, 1:] >= LEAST_LIGHT, alpha * light[:, :-1], 0)
    return (weights @ colours).reshape(height, width, 3)


def trained(shots: Sequence[Shot], model: Model) -> Model:
    """The model after STEPS steps on windows of random photographs; no density control."""
    generator = torch.Generator().manual_seed(0)
    model = {name: value.requires_grad_() for name, value in model.items()}
    adam = torch.optim.Adam([{"params": [model[name]], "lr": rate} for name, rate in RATES.items()], eps=1e-15)
    known = [shot.at(1) for shot in shots]
    for _ in range(STEPS):
        number = int(torch.randint(len(shots), (), generator=generator))
        photo, matrix = known[number]
        top, left = (
            int(torch.randint(side - edge + 1, (), generator=generator))
            for side, edge in zip(photo.shape[:2], WINDOW[::-1], strict=True)
        )
        image = drawn(model, shots[number].view, matrix, (photo.shape[1], photo.shape[0]), (left, top, *WINDOW))
        loss = (image - photo[top : top + WINDOW[1], left : left + WINDOW[0]]).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
    return {name: value.detach() for name, value in model.items()}


@torch.no_grad()
def judged_directly(model: Model, shots: Sequence[Shot], zoom: int) -> float:
    """Mean PSNR over photographs, of renders in 8 bits, in dB."""
    found = []
    for shot in shots:
        photo, matrix = shot.at(zoom)
        height, width = photo.shape[:2]
        strips = [
            drawn(model, shot.view, matrix, (width, height), (0, top, width, min(16, height - top)))
            for top in range(0, height, 16)
        ]
        image = ((torch.cat(strips) * 255 + 0.5).clamp(0, 255).floor() / 255).double()
        found.append(-10 * float((image - photo.double()).square().mean().log10()))
    return fmean(found)


def judged_by_gsx(file: Path, scene: Path, place: Path) -> dict[str, float]:
    """PSNR by zoom, as `gsx eval FILE` has it."""
    words = ["scene=colmap", f"scene.path={scene.resolve()}", f"scene.downscale={DOWNSCALE}", "eval.zoom=[1,2]"]
    subprocess.run([sys.executable, "-m", "gsx", "eval", str(file), *words, f"folder={place}"], check=True)
    return {zoom: entry["psnr"] for zoom, entry in json.loads((place / "evaluation.json").read_text())["zoom"].items()}


def main(words: Sequence[str]) -> None:
    """Train, judge twice, show and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with sparse/0 (PINHOLE) and images")
    given, load = parser.parse_args(words), told_load()
    train, test, cloud = shots_of(given.scene)
    model = trained(train, started(cloud))
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "splats.ply"
        export_splats(**model, format="ply", save_to=str(file))
        judged = judged_by_gsx(file, given.scene, Path(place) / "run")
    rows = []
    for zoom in (1, 2):
        direct = judged_directly(model, test, zoom)
        rows.append({"zoom": zoom, "direct": direct, "judged": judged[str(zoom)], "off": judged[str(zoom)] - direct})
    note = (
        f"{given.scene.name} at downscale {DOWNSCALE}, {len(test)} held-out photographs; {len(cloud['xyz']):,} splats "
        f"trained for {STEPS} steps and exported by gsplat {version('gsplat')}."
    )
    command = shown_command(words, "benchmarks/referee.py")
    section = stamped("gsx as the judge of another program's splats", COLUMNS, rows, [note], load, command)
    sys.stdout.write(text_table(section))
    write_results(RESULTS, "referee_cpu", describe_machine(torch.device("cpu")), {"referee": section})


if __name__ == "__main__":
    main(sys.argv[1:])
