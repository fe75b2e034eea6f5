"""Number formats of one picture: what `evaluation` and `accumulation` of the settings mean for its splats."""

from dataclasses import dataclass

import torch

from gsx.core.rasterizer.settings import RasterSettings

DTYPES = {"float64": torch.float64, "float32": torch.float32}


@dataclass(frozen=True, kw_only=True)
class Precision:
    """dtypes of the work on one picture."""

    evaluation: torch.dtype
    """Of ln alpha and alpha at pixels."""
    accumulation: torch.dtype
    """Of transmittance, weights, sums of light, and of their gradients at pixels."""
    exact: torch.dtype
    """The wider of both: of numbers per list entry, and of the sums over pixels and entries in a splat's gradient."""

    @staticmethod
    def of(settings: RasterSettings, splats: torch.dtype) -> "Precision":
        """Returns the formats for splats of a dtype, never narrower than it."""
        evaluation = torch.promote_types(DTYPES[settings.evaluation], splats)
        accumulation = torch.promote_types(DTYPES[settings.accumulation], splats)
        exact = torch.promote_types(evaluation, accumulation)
        return Precision(evaluation=evaluation, accumulation=accumulation, exact=exact)
