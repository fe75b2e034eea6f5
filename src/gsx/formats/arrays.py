"""Gaussians as numpy arrays in the units of compact files, and code that these formats share."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import degree_of
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float, Int

logger = logging.getLogger(__name__)

V = TypeVar("V", np.ndarray, torch.Tensor)
OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components of a quaternion except the first, second, third, fourth."""
SMALLEST_OPACITY = 1e-6
"""Least distance of opacities from 0 and 1, where logits are infinite."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Arrays:
    """N Gaussians, float64."""

    means: Float[np.ndarray, "N 3"]
    log_scales: Float[np.ndarray, "N 3"]
    quats: Float[np.ndarray, "N 4"]
    """(w, x, y, z), unit."""
    opacities: Float[np.ndarray, "N"]
    """In [0, 1]."""
    sh_dc: Float[np.ndarray, "N 3"]
    sh_rest: Float[np.ndarray, "N B 3"]

    @property
    def degree(self) -> int:
        """Returns the degree of the spherical harmonics."""
        return degree_of(self.sh_rest.shape[1])


def arrays_of(gaussians: Gaussians) -> Arrays:
    """Returns the arrays of Gaussians; a zero quaternion becomes the identity.

    Raises:
        InputError: there are none, or a value is not finite.
    """
    if not len(gaussians.means):
        raise InputError("no splat file is written: the model has no splats")
    raw = {name: value.detach().double().cpu().numpy() for name, value in vars(gaussians).items()}
    for name, value in raw.items():
        bad = int((~np.isfinite(value)).sum())
        if bad:
            raise InputError(f"no splat file is written: {bad} of {value.size} values of '{name}' are not finite")
    return Arrays(
        means=raw["means"],
        log_scales=raw["log_scales"],
        quats=unit_quaternions(raw["quats"]),
        opacities=1 / (1 + np.exp(-raw["opacity_logits"].clip(-700, 700))),
        sh_dc=raw["sh_dc"],
        sh_rest=raw["sh_rest"],
    )


def unit_quaternions(quats: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Normalises quaternions (w, x, y, z); those of length 0 become the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):  # infinite ones become nan
        return np.where(norms == 0, [1.0, 0.0, 0.0, 0.0], quats / np.where(norms == 0, 1, norms))


def gaussians_from(arrays: Arrays) -> Gaussians:
    """Returns the Gaussians of arrays, float32."""
    inner = arrays.opacities.clip(SMALLEST_OPACITY, 1 - SMALLEST_OPACITY)
    raw = vars(arrays) | {"opacity_logits": np.log(inner / (1 - inner))}
    raw.pop("opacities")
    return Gaussians(**{name: torch.from_numpy(value.astype(np.float32)) for name, value in raw.items()})


def finite_rows(values: Mapping[str, V], name: str) -> dict[str, V]:
    """Drops rows with NaN or inf, and logs their number with the file's name."""
    arrays = [np.asarray(part) for part in values.values()]
    finite = np.all([np.isfinite(array).all(tuple(range(1, array.ndim))) for array in arrays], 0)
    if finite.all():
        return dict(values)
    logger.warning(
        "%s: %d of %d splats have values that are not finite, dropping them", name, (~finite).sum(), len(finite)
    )
    return {key: part[finite] for key, part in values.items()}


def joined(parts: Sequence[Arrays]) -> Arrays:
    """Concatenates parts, with the bands of the highest degree; missing bands are 0."""
    if len(parts) == 1:
        return parts[0]
    most = max(part.sh_rest.shape[1] for part in parts)
    padded = [replace(part, sh_rest=np.pad(part.sh_rest, ((0, 0), (0, most - part.sh_rest.shape[1]), (0, 0))))
              for part in parts]  # fmt: skip
    return Arrays(**{name: np.concatenate([vars(part)[name] for part in padded]) for name in vars(parts[0])})


def rounded(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Rounds to whole numbers, halves away from zero."""
    return np.copysign(np.floor(np.abs(values) + 0.5), values)


def smallest_three(quats: Float[np.ndarray, "N 4"]) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """Returns (index of the largest component, the others with the sign that makes the largest positive)."""
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, -1.0, 1.0)
    return largest, quats[rows[:, None], OTHERS[largest]] * signs[:, None]


def from_smallest_three(largest: Int[np.ndarray, "N"], three: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """Returns unit quaternions: the inverse of `smallest_three`."""
    quats, rows = np.empty((len(three), 4)), np.arange(len(three))
    quats[rows[:, None], OTHERS[largest]] = three
    quats[rows, largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
