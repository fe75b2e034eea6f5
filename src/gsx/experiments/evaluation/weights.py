"""Weights of networks in local files, as `torch.save` writes state dicts, and in installed packages.

conf/perceptual.yaml lists the latter. Packages are located, not imported: some import what they do not need. No code in
files is run.
"""

import hashlib
import io
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
from gsx.core.files import LFS_POINTER, expand_home

SAVED = (b"PK\x03\x04", b"\x80")
"""First bytes of what `torch.save` writes: a ZIP archive, or a pickle as before torch 1.6."""
OTHERS = ((LFS_POINTER, "a Git LFS pointer (`git lfs pull` fetches the file)"), (b"<", "a web page"))
"""First bytes of files that are often in the place of weights."""


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
    if "hub" in place:
        path, owner = Path(torch.hub.get_dir()) / "checkpoints" / place["hub"], "torch's hub cache"
    else:
        path, owner = in_package(place["package"], place["path"])
    if not path.is_file():
        raise FileNotFoundError(f"{owner} has no file {path}")
    return path, f"{owner}, {path.name}, sha256 {place['sha256']}"


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


def read_weights(path: str, option: str) -> tuple[dict[str, Tensor], str]:
    """Returns the tensors of a weights file by name, and a prefix of its sha256.

    Raises:
        InputError: the file is missing or holds no state dict; the message begins with `option`.
    """
    try:
        data = expand_home(path).read_bytes()
        weights = state_dict(data)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"{option}={path} cannot be read as weights ({reason}): give a local .pth file with a state dict"
        ) from None
    dense = {
        name: value
        for name, value in weights.items()
        if isinstance(value, Tensor) and value.layout is torch.strided and value.device.type == "cpu"
    }
    usable = {name: one for name, one in dense.items() if one.is_floating_point() and bool(one.isfinite().all())}
    return usable, hashlib.sha256(data).hexdigest()[:8]


def state_dict(data: bytes) -> dict[str, Tensor]:
    """Decodes a state dict.

    Raises:
        ValueError: the bytes are none.
    """
    if not data.startswith(SAVED):
        raise ValueError(f"it is {kind_of(data)}")
    try:
        weights = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds, and advises to run what the file holds
        raise ValueError("it is damaged, or holds other things than tensors") from error
    if not isinstance(weights, dict):
        raise ValueError(f"it holds a {type(weights).__name__}, not a state dict")
    return {str(name): value for name, value in weights.items()}


def kind_of(data: bytes) -> str:
    """Names the kind of a file that `torch.save` did not write."""
    if not data:
        return "empty"
    start = data[:256].lstrip(b"\xef\xbb\xbf \t\r\n")
    known = next((words for mark, words in OTHERS if start.startswith(mark)), None)
    return known or ("a safetensors file" if data[8:9] == b"{" else "no file of torch.save")
