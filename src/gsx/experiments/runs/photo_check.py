"""`gsx photographs RUN`: training photos by how far the render is from them, and what is wrong with them."""

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
from gsx.core.training.render import render
from gsx.core.training.run import Run
from gsx.experiments.evaluation.chosen_views import distinct
from gsx.experiments.evaluation.photographs import Finding, concentrated, gains_of, remarks_on
from gsx.experiments.reports.pictures import Pictures, file_names, forget
from gsx.experiments.reports.report import write_report
from gsx.experiments.runs.open import reopened
from gsx.experiments.runs.progress import Countdown
from gsx.modules.corrections import Correction
from gsx.modules.image_shift import estimate_shift
from gsx.scenes.photo_source import PhotoSource

FOLDER = "photographs"
"""Folder of a run with index.json and pictures of the worst photos."""


def check_photos(folder: Path, plugins: Plugins, worst: int, overrides: Sequence[str] = ()) -> list[Finding]:
    """Return findings on all training photos of a run, worst first; errors as `reopened`.

    Writes them to FOLDER with pictures of the `worst` ones, and renews the report.
    """
    with reopened(folder, plugins, overrides) as (run, settings):
        findings = findings_of(run, settings.evaluation.tile_pixels)
        write_findings(run, findings, worst, settings.evaluation.tile_pixels)
        write_report(folder)
    return findings


def findings_of(run: Run, pixels: int) -> list[Finding]:
    """Return findings on every training photo, worst first."""
    views = distinct(run.train_views)
    progress, findings = Countdown("checking photos", len(views)), []
    files = {view.name: view.source.path for view in run.scene.train if isinstance(view.source, PhotoSource)}
    ratios = sharpness(sorted(set(files.values())))
    known = {name: ratios[path] for name, path in files.items() if path in ratios}
    for view in views:
        findings.append(finding(run, view, known.get(view.name), pixels))
        progress.advance(1, view.name)
    exposure, poses = run.modules.get("exposure"), run.modules.get("poses")
    when = "never" if exposure is None else exposure.options.when
    exposed, posed = (isinstance(module, Correction) and module.active for module in (exposure, poses))
    remarks = remarks_on(findings, when, exposed, posed)
    return sorted(
        (replace(one, remarks=words) for one, words in zip(findings, remarks, strict=True)), key=lambda one: one.psnr
    )


@torch.no_grad()
def finding(run: Run, view: View, known_sharpness: float | None, pixels: int) -> Finding:
    """Compare one photo with its render; without remarks."""
    plain, photo, counted = render(run, view.camera, pixels).image, view.image(), view.counted()
    image = as_photo(run, view, plain)
    error = black_out(image - photo, counted).square().mean(0)
    return Finding(
        name=view.name,
        psnr=psnr(image, photo, counted),
        gains=gains_of(plain, photo, counted),
        shift=estimate_shift(image, photo, counted),
        concentrated=concentrated(error, counted),
        sharpness=known_sharpness,
        masked=0.0 if counted is None else 1 - float(counted.float().mean()),
    )


def as_photo(run: Run, view: View, image: Float[Tensor, "3 H W"]) -> Float[Tensor, "3 H W"]:
    """Return a render with exposure and motion blur of its photo, on the CPU."""
    return run.as_photo(image, view).clamp(0, 1).cpu()


@torch.no_grad()
def write_findings(run: Run, findings: Sequence[Finding], worst: int, pixels: int) -> None:
    """Write index.json with all findings, and pictures of the worst."""
    place = Pictures(run.folder / FOLDER, run.step)
    place.folder.mkdir(parents=True, exist_ok=True)
    forget(place.folder)
    views, pictured = {view.name: view for view in run.train_views}, findings[:worst]
    entries: list[dict[str, Any]] = [asdict(one) for one in findings]
    for entry, name in zip(entries, file_names([one.name for one in pictured]), strict=False):
        view = views[entry["name"]]
        image = as_photo(run, view, render(run, view.camera, pixels).image)
        entry["files"] = place.compared(name, view, image)
        entry["size"] = list(view.camera.size)
    summary = {"step": run.step, "median_psnr": median(one.psnr for one in findings)}
    write_json(place.folder / "index.json", summary | {"views": entries})


def summary_lines(findings: Sequence[Finding], worst: int) -> list[str]:
    """Summarise findings for the log."""
    wrong = [one for one in findings if one.remarks]
    middle = median(one.psnr for one in findings)
    out = [f"training photos: {len(findings)}, median {middle:.2f} dB; with remarks: {len(wrong)}"]
    out += [f"{one.name}  {one.psnr:.2f} dB  {'; '.join(one.remarks)}" for one in wrong[:worst]]
    return out + ([f"and {len(wrong) - worst} more in {FOLDER}/index.json"] if len(wrong) > worst else [])
