"""Weights of networks in local files, as `torch.save` writes state dicts; no code in them is run."""

import hashlib
import io

import torch
from torch import Tensor

from gsx.core.errors import InputError
from gsx.core.files import LFS_POINTER, expand_home

SAVED = (b"PK\x03\x04", b"\x80")
"""First bytes of what `torch.save` writes: a ZIP archive, or a pickle as before torch 1.6."""
OTHERS = ((LFS_POINTER, "a Git LFS pointer (`git lfs pull` fetches the file)"), (b"<", "a web page"))
"""First bytes of files that are often in the place of weights."""


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
    return {name: value for name, value in weights.items() if is_dense(value)}, hashlib.sha256(data).hexdigest()[:8]


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


def is_dense(value: object) -> bool:
    """Recognises a tensor of finite floating-point numbers."""
    if not isinstance(value, Tensor) or value.layout is not torch.strided or value.device.type != "cpu":
        return False
    return value.is_floating_point() and bool(value.isfinite().all())


def kind_of(data: bytes) -> str:
    """Names the kind of a file that `torch.save` did not write."""
    if not data:
        return "empty"
    start = data[:256].lstrip(b"\xef\xbb\xbf \t\r\n")
    known = next((words for mark, words in OTHERS if start.startswith(mark)), None)
    return known or ("a safetensors file" if data[8:9] == b"{" else "no file of torch.save")
