"""Weights of networks in local files, as `torch.save` writes state dicts; nothing of what they hold is run."""

import hashlib
import io

import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.files import LFS_POINTER, at_home

REMEDY = "give a local .pth file with a state dict"
SAVED = (b"PK\x03\x04", b"\x80")
"""First bytes of what `torch.save` writes: a ZIP archive, or a pickle as before torch 1.6."""
OTHERS = ((LFS_POINTER, "a Git LFS pointer (`git lfs pull` fetches the file)"), (b"<", "a web page"))
"""First bytes of files that often lie where weights should."""


def read_weights(path: str, option: str) -> tuple[dict[str, Tensor], str]:
    """Return the tensors of a weights file by name, and a prefix of its sha256.

    Raises:
        InputError: the file is missing or holds no state dict; the message begins with `option`.
    """
    data = _content(path, option)
    if not data.startswith(SAVED):
        raise _unusable(path, option, f"it is {_kind(data)}")
    try:
        weights = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds, and advises to run what the file holds
        raise _unusable(path, option, "it is damaged, or holds other things than tensors") from error
    if not isinstance(weights, dict):
        raise _unusable(path, option, f"it holds a {type(weights).__name__}, not a state dict")
    tensors = {str(name): value for name, value in weights.items() if is_dense(value)}
    return tensors, hashlib.sha256(data).hexdigest()[:8]


def is_dense(value: object) -> bool:
    """Return whether a value is a tensor of finite floating-point numbers."""
    if not isinstance(value, Tensor) or value.layout is not torch.strided or value.device.type != "cpu":
        return False
    return value.is_floating_point() and bool(value.isfinite().all())


def _content(path: str, option: str) -> bytes:
    try:
        return at_home(path).read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "its name is none"
        raise _unusable(path, option, reason) from None


def _kind(data: bytes) -> str:
    """Return what a file that `torch.save` did not write is, in words."""
    if not data:
        return "empty"
    start = data[:256].lstrip(b"\xef\xbb\xbf \t\r\n")
    known = next((words for mark, words in OTHERS if start.startswith(mark)), None)
    return known or ("a safetensors file" if data[8:9] == b"{" else "no file of torch.save")


def _unusable(path: str, option: str, reason: str) -> InputError:
    return InputError(f"{option}={path} cannot be read as weights ({reason}): {REMEDY}")
