"""Weights of perceptual metrics in installed packages and in torch's cache, as conf/perceptual.yaml lists them.

Packages are located, not imported: some import what they do not need.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from gsx.core.errors import InputError
from gsx.experiments.evaluation.weight_files import read_weights


class MetricUnavailable(Exception):
    """A file of weights is missing, or differs from the known one; the message ends with a remedy."""


@dataclass(frozen=True, eq=False, kw_only=True)
class InstalledWeights:
    """Tensors of a metric by file and name, and where they come from."""

    tensors: dict[str, dict[str, Tensor]]
    provenance: dict[str, Any]


@cache
def known_weights() -> dict[str, Any]:
    """Returns conf/perceptual.yaml."""
    text = (files("gsx.conf") / "perceptual.yaml").read_text(encoding="utf-8")
    return dict(yaml.safe_load(text))


def installed_weights(metric: str) -> InstalledWeights:
    """Reads the weights of a metric of conf/perceptual.yaml.

    Raises:
        MetricUnavailable: a file is missing or unknown.
    """
    entry = known_weights()[metric]
    tensors, sources = {}, {}
    try:
        for role, place in entry["files"].items():
            path, source = locate(place)
            tensors[role] = read_known(path, str(place["sha256"]), f"metrics.perceptual={metric}")
            sources[role] = source
    except (OSError, InputError) as error:
        raise MetricUnavailable(f"{error}: {again(place.get('package', ''), entry['remedy'])}") from error
    provenance = {key: entry[key] for key in ("metric", "licence")} | {"weights": sources}
    return InstalledWeights(tensors=tensors, provenance=provenance)


def again(package: str, remedy: str) -> str:
    """Returns how to get a missing or damaged file: pip does nothing for an installed package unless it is forced."""
    try:
        distribution(package)
    except (PackageNotFoundError, ValueError):  # for an empty name
        return remedy
    return f"pip install --force-reinstall --no-deps {package}"


def locate(place: Mapping[str, Any]) -> tuple[Path, str]:
    """Returns the path of a file, and where it comes from in words.

    Raises:
        FileNotFoundError: it is not on this machine.
    """
    path, owner = in_hub(place["hub"]) if "hub" in place else in_package(place["package"], place["path"])
    if not path.is_file():
        raise FileNotFoundError(f"{owner} has no file {path}")
    return path, f"{owner}, {path.name}, sha256 {place['sha256']}"


def in_hub(name: str) -> tuple[Path, str]:
    """Returns the place of a file in torch's cache of downloads."""
    return Path(torch.hub.get_dir()) / "checkpoints" / name, "torch's hub cache"


def in_package(package: str, inner: str) -> tuple[Path, str]:
    """Returns the place of a file in an installed package, and the package with its version.

    Raises:
        FileNotFoundError: the package is not installed.
    """
    try:
        found = distribution(package)
    except PackageNotFoundError:
        raise FileNotFoundError(f"{package} is not installed") from None
    return Path(str(found.locate_file(inner))), f"{package} {found.version}"


def read_known(path: Path, sha256: str, option: str) -> dict[str, Tensor]:
    """Reads a file of weights whose hash is, or begins with, a known one.

    Raises:
        InputError: it is another file.
    """
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if not digest.startswith(sha256):
        raise InputError(f"{path} has sha256 {digest[:16]} instead of {sha256[:16]}")
    return read_weights(str(path), option)[0]
