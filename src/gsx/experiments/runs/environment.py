"""Scene, machine and versions of a run: environment.json, and the first lines of the log."""

import hashlib
import logging
import os
import platform
import sys
from collections.abc import Collection, Sequence
from importlib.metadata import PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

import torch

from gsx import __version__
from gsx.core.data.scene import View
from gsx.core.plugins import GROUP, Plugins
from gsx.core.training.backbone import CAUTION
from gsx.core.training.run import Run
from gsx.engine.cache import source_revision
from gsx.engine.machine import device_name
from gsx.experiments.run_folder.run_key import composition_key, scene_stamp
from gsx.experiments.runs.build import plan_of

logger = logging.getLogger(__name__)

PACKAGES = ("torch", "numpy", "hydra-core", "omegaconf", "pycolmap", "OpenImageIO", "kornia", "pluggy", "safetensors")
POSE_DIGITS = 6
"""Digits of camera values in digests, relative to the largest of their kind: other machines differ beyond them."""


def environment(run: Run, plugins: Plugins, idle: Collection[str]) -> dict[str, Any]:
    """Return the content of environment.json; `idle`: keys that change no result."""
    scene, points = run.scene, [point for point in entry_points(group=GROUP) if point.dist]
    return {
        "gsx": __version__,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "rasterizer": run.raster.path_on(run.device.type),
        "source": source_revision(),
        "device": device_name(run.device),
        "processes": run.ranks.size,
        "packages": {name: installed_version(name) for name in PACKAGES},
        "plugins": plugins.versions,
        "distributions": {one.name: one.dist.name for one in points if one.dist and one.name in plugins.versions},
        "options": composition_key(run.config, "", idle),
        "plan": plan_of(run),
        "training_focal": max(view.camera.focal for view in scene.train),
        "scene": {
            "stamp": scene_stamp(run.config),
            "cameras": camera_digest([*scene.train, *scene.test]),
            "train_views": len(scene.train),
            "test_views": len(scene.test),
            "points": len(scene.points),
            "extent": scene.extent,
            "origin": list(scene.origin),
            "notes": list(scene.notes),
        },
    }


def camera_digest(views: Sequence[View]) -> str:
    """Return a digest of names, sizes, intrinsics and poses of views, in order."""
    content = hashlib.sha256(repr([(view.name, view.camera.size) for view in views]).encode())
    lenses = [view.camera.lens for view in views if view.camera.lens is not None]
    content.update(repr(lenses).encode() if lenses else b"")
    cameras = [view.camera for view in views]
    numbers = [torch.tensor([[c.fx, c.fy, c.cx, c.cy] for c in cameras], dtype=torch.float64)]
    numbers += [torch.stack([c.rotation.double().flatten() for c in cameras])]
    numbers += [torch.stack([c.translation.double() for c in cameras])]
    for values in numbers:
        largest = values.abs().max().clamp_min(1e-300)
        content.update((values / largest * 10**POSE_DIGITS).round().add(0.0).numpy().tobytes())  # -0 becomes 0
    return content.hexdigest()[:16]


def installed_version(package: str) -> str:
    """Return the version of an installed distribution."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def announce(run: Run, plugins: Plugins) -> None:
    """Log scene, notes, failed plugins, the schedules and the run folder."""
    scene = run.scene
    (width, height), points = scene.train[0].camera.size, f"{len(scene.points):,}"
    views = f"{len(scene.train)} training and {len(scene.test)} test views of {width}x{height} px"
    logger.info("scene %s: %s, %s points, extent %.3g", scene.name, views, points, scene.extent)
    for note in scene.notes:
        logger.info("note: %s", note)
    for failure in plugins.failures:
        logger.warning("plugin %s did not load: %s", failure.plugin, failure.reason)
    for name, part in plan_of(run).items():
        entries = [f"{key} {in_words(value)}" for key, value in part.items() if key != CAUTION]
        logger.info("schedule of %s: %s", name, ", ".join(entries))
        if CAUTION in part:
            logger.warning("%s %s", name, part[CAUTION])
    logger.info(
        "seed %s, %d threads, %s; run folder %s", run.config["seed"], torch.get_num_threads(), run.device, run.folder
    )


def in_words(value: object) -> str:
    """Format a value of a plan: a number, several, or anything else of a plugin."""
    if isinstance(value, list | tuple):
        return " ".join(map(in_words, value)) or "none"
    return f"{value:.6g}" if isinstance(value, int | float) else str(value)
