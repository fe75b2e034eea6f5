"""Splat files that hold scales and opacities as they are drawn, where 3D-GS stores logarithms and logits."""

from collections.abc import Iterator

import torch

from gsx.core.gaussians.splats import Gaussians

LEAST_SPLATS = 100
"""Splats from which on one of the two signs suffices."""
SMALL = 0.7
"""Scales, read as logarithms, of which most are in (0, SMALL): splats of 1 to 2 units, all of one size."""
MOST = 0.9
"""Quantile of scales that is compared with SMALL."""


def activated_words(gaussians: Gaussians) -> Iterator[str]:
    """Yields a sentence if raw values look like activated ones: all scales positive, all opacities in [0, 1].

    Both are one sign: large scenes have splats beyond one unit, and opacities between 0.5 and 0.73 may be all that a
    small file has. Of many splats one of them suffices if it is unmistakable.
    """
    count = len(gaussians.means)
    scales, opacities = gaussians.log_scales.flatten(), gaussians.opacity_logits
    positive = count > 0 and bool((scales > 0).all())
    shares = count > 0 and bool(((opacities >= 0) & (opacities <= 1)).all())
    alone = count >= LEAST_SPLATS
    small = positive and float(quantile(scales, MOST)) < SMALL
    several = shares and bool((opacities != opacities[0]).any())
    signs = []
    if positive and (shares or (alone and small)):
        signs.append(f"all scales are above 0 (median {float(scales.median()):.3g}), where logarithms are stored")
    if shares and (positive or (alone and several)):
        signs.append("all opacities are within [0, 1], where logits are stored")
    if signs:
        yield (
            f"these look like activated values: {', and '.join(signs)}. They are read as they are stored: export "
            "ln(scale) and ln(opacity / (1 - opacity))"
        )


def quantile(values: torch.Tensor, share: float) -> torch.Tensor:
    """Returns the value below which a share of the values lies."""
    return values.flatten().kthvalue(max(1, int(share * values.numel()))).values
