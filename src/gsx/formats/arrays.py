"""Gaussians as arrays of numpy in the units that compact files hold, and what their formats share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gsx.core.errors import InputError
from gsx.core.gaussians.sh import degree_of
from gsx.core.gaussians.splats import Gaussians
from gsx.core.shapes import Float, Int

SMALLEST_OPACITY = 1e-6
"""Opacities read as 0 or 1 are this far from it: their logits are finite."""


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
        """Of the spherical harmonics."""
        return degree_of(self.sh_rest.shape[1])


def arrays_of(gaussians: Gaussians) -> Arrays:
    """Return the arrays of Gaussians; a zero quaternion becomes the identity.

    Raises:
        InputError: a value is not finite; the message has its name and the number of rows.
    """
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
    """Return quaternions (w, x, y, z) of length 1; one of length 0 becomes the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    with np.errstate(invalid="ignore"):  # infinite ones become nan
        return np.where(norms == 0, [1.0, 0.0, 0.0, 0.0], quats / np.where(norms == 0, 1, norms))


def gaussians_from(arrays: Arrays) -> Gaussians:
    """Gaussians of arrays, float32."""
    inner = arrays.opacities.clip(SMALLEST_OPACITY, 1 - SMALLEST_OPACITY)
    raw = vars(arrays) | {"opacity_logits": np.log(inner / (1 - inner))}
    raw.pop("opacities")
    return Gaussians(**{name: torch.from_numpy(value.astype(np.float32)) for name, value in raw.items()})


def joined(parts: Sequence[Arrays]) -> Arrays:
    """Return the splats of several parts, with the bands of the highest degree among them; those that some lack are 0.

    One part is returned as it is.
    """
    if len(parts) == 1:
        return parts[0]
    most = max(part.sh_rest.shape[1] for part in parts)
    padded = [replace(part, sh_rest=np.pad(part.sh_rest, ((0, 0), (0, most - part.sh_rest.shape[1]), (0, 0))))
              for part in parts]  # fmt: skip
    return Arrays(**{name: np.concatenate([vars(part)[name] for part in padded]) for name in vars(parts[0])})


def rounded(values: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """The nearest whole numbers, halves away from zero."""
    return np.copysign(np.floor(np.abs(values) + 0.5), values)


def smallest_three(quats: Float[np.ndarray, "N 4"]) -> tuple[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]]:
    """(index of the largest component, the others in their order, signed so that the largest is positive)."""
    largest = np.abs(quats).argmax(1)
    rows = np.arange(len(quats))
    signs = np.where(quats[rows, largest] < 0, -1.0, 1.0)
    others = np.stack([np.delete(np.arange(4), index) for index in range(4)])[largest]
    return largest, quats[rows[:, None], others] * signs[:, None]


def from_smallest_three(largest: Int[np.ndarray, "N"], three: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 4"]:
    """Unit quaternions of `smallest_three`."""
    others = np.stack([np.delete(np.arange(4), index) for index in range(4)])[largest]
    quats, rows = np.empty((len(three), 4)), np.arange(len(three))
    quats[rows[:, None], others] = three
    quats[rows, largest] = np.sqrt(np.maximum(0, 1 - (three**2).sum(1)))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)
