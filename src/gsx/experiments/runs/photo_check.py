"""`gsx photographs RUN`: training photographs by how badly the model shows them, and what is wrong with them."""

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from statistics import median
from typing import Any

import torch
from torch import Tensor

from gsx.core.data.masks import black_out
from gsx.core.data.scene import View
from gsx.core.files import write_json
from gsx.core.plugins import Plugins
from gsx.core.quality.metrics import psnr
from gsx.core.quality.sharpness import sharpness
from gsx.core.shapes import Float
from gsx.core.training.module import TrainingModule
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.photographs import Finding, concentrated, gains_of, remarks_on
from gsx.experiments.reports.pictures import Pictures, file_names, forget
from gsx.experiments.reports.report import write_report
from gsx.experiments.run_folder.claims import claimed
from gsx.experiments.runs.open import as_trained, open_run, refuse_other, refuse_training
from gsx.experiments.runs.progress import Countdown
from gsx.experiments.runs.rasterizer_path import warm
from gsx.modules.corrections import Correction
from gsx.modules.shifts import shift_of
from gsx.scenes.photo_source import PhotoSource

FOLDER = "photographs"
"""Of the run's, with index.json and pictures of the worst."""


def check_photos(folder: Path, plugins: Plugins, worst: int, overrides: Sequence[str] = ()) -> list[Finding]:
    """Returns findings on all training photographs of a run, worst first.

    The folder keeps them, with pictures of the `worst` ones, and the report shows them.


    Raises:
        ConfigError, InputError: an override is wrong, the folder is no run, or somebody trains in it.
        CheckpointError: there is no usable checkpoint.
    """
    refuse_other(folder)
    refuse_training(folder, overrides)
    with claimed(folder):
        run, settings = open_run(folder, plugins, overrides)
        run.raster = as_trained(run)
        warm(run)
        findings = findings_of(run, settings.evaluation.tile_pixels)
        write_findings(run, findings, worst, settings.evaluation.tile_pixels)
        write_report(folder)
    return findings


def findings_of(run: Run, pixels: int) -> list[Finding]:
    """Returns findings on every training photograph, worst first."""
    views = different(run.train_views)
    progress, known = Countdown("looking at photographs", len(views)), sharpness_of(run.scene.train)
    findings = []
    for view in views:
        findings.append(finding(run, view, known.get(view.name), pixels))
        progress.advance(1, view.name)
    exposure, poses = run.modules.get("exposure"), run.modules.get("poses")
    when = "never" if exposure is None else exposure.options.when
    remarks = remarks_on(findings, when, is_active(exposure), is_active(poses))
    return sorted(
        (replace(one, remarks=words) for one, words in zip(findings, remarks, strict=True)), key=lambda one: one.psnr
    )


def is_active(module: TrainingModule | None) -> bool:
    """Returns whether a module corrects photos now."""
    return isinstance(module, Correction) and module.active


def different(views: Sequence[View]) -> list[View]:
    """Returns each view once: some protocols have the same one several times."""
    return list({view.name: view for view in views}.values())


def sharpness_of(views: Sequence[View]) -> dict[str, float]:
    """Returns sharpness against neighbours by the name of a view, of those that are photographs."""
    files = {view.name: view.source.path for view in views if isinstance(view.source, PhotoSource)}
    ratios = sharpness(sorted(set(files.values())))
    return {name: ratios[path] for name, path in files.items() if path in ratios}


@torch.no_grad()
def finding(run: Run, view: View, known_sharpness: float | None, pixels: int) -> Finding:
    """Compares one photograph with the render; without remarks."""
    own, photograph, counted = render(run, view.camera, pixels).image, view.image(), view.counted()
    image = at_exposure(run, view, own)
    error = black_out(image - photograph, counted).square().mean(0)
    return Finding(
        name=view.name,
        psnr=psnr(image, photograph, counted),
        gains=gains_of(own, photograph, counted),
        shift=shift_of(image, photograph, counted),
        concentrated=concentrated(error, counted),
        sharpness=known_sharpness,
        masked=0.0 if counted is None else 1 - float(counted.float().mean()),
    )


def at_exposure(run: Run, view: View, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Returns a render at the exposure and with the movement of its photograph, on the CPU."""
    return run.as_photo(image, view).clamp(0, 1).cpu()


@torch.no_grad()
def write_findings(run: Run, findings: Sequence[Finding], worst: int, pixels: int) -> None:
    """Writes index.json with all findings, and pictures of the worst."""
    place = Pictures(run.folder / FOLDER, run.step)
    place.folder.mkdir(parents=True, exist_ok=True)
    forget(place.folder)
    views, pictured = {view.name: view for view in run.train_views}, findings[:worst]
    entries: list[dict[str, Any]] = [asdict(one) for one in findings]
    for entry, name in zip(entries, file_names([one.name for one in pictured]), strict=False):
        view = views[entry["name"]]
        image = at_exposure(run, view, render(run, view.camera, pixels).image)
        entry["files"] = place.compared(name, view, image)
        entry["size"] = list(view.camera.size)
    summary = {"step": run.step, "median_psnr": median(one.psnr for one in findings)}
    write_json(place.folder / "index.json", summary | {"views": entries})


def lines(findings: Sequence[Finding], worst: int) -> list[str]:
    """Returns lines for the terminal."""
    wrong = [one for one in findings if one.remarks]
    middle = median(one.psnr for one in findings)
    out = [f"training photographs: {len(findings)}, median {middle:.2f} dB; standing out: {len(wrong)}"]
    out += [f"{one.name}  {one.psnr:.2f} dB  {'; '.join(one.remarks)}" for one in wrong[:worst]]
    return out + ([f"and {len(wrong) - worst} more in {FOLDER}/index.json"] if len(wrong) > worst else [])
