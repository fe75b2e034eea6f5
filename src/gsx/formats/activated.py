"""Detection of splat files with activated values: scales and opacities instead of logarithms and logits."""

from collections.abc import Iterator

from gsx.core.gaussians.splats import Gaussians

LEAST_SPLATS = 100
"""Least number of splats for which one of the two signs suffices."""
SMALL = 0.7
"""Bound of the `MOST` quantile of activated scales: as logarithms they would be splats of 1 to 2 units."""
MOST = 0.9


def activated_words(gaussians: Gaussians) -> Iterator[str]:
    """Yields a sentence if raw values look activated: all scales positive and all opacities in [0, 1].

    Either may be a coincidence in small files and large scenes; for many splats one clear sign suffices.
    """
    count = len(gaussians.means)
    scales, opacities = gaussians.log_scales.flatten(), gaussians.opacity_logits
    positive = count > 0 and bool((scales > 0).all())
    shares = count > 0 and bool(((opacities >= 0) & (opacities <= 1)).all())
    alone = count >= LEAST_SPLATS
    small = positive and float(scales.kthvalue(max(1, int(MOST * scales.numel()))).values) < SMALL
    several = shares and bool((opacities != opacities[0]).any())
    signs = []
    if positive and (shares or (alone and small)):
        signs.append(f"all scales are above 0 (median {float(scales.median()):.3g}), where logarithms are stored")
    if shares and (positive or (alone and several)):
        signs.append("all opacities are within [0, 1], where logits are stored")
    if signs:
        yield (
            f"these look like activated values: {', and '.join(signs)}. They are read as logarithms and logits: "
            "export ln(scale) and ln(opacity / (1 - opacity))"
        )
