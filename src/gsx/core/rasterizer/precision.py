"""Number formats of one picture: what `evaluation` and `accumulation` of the settings mean for given splats."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from gsx.core.rasterizer.settings import RasterSettings
from gsx.core.shapes import Float

DTYPES = {
    "float64": torch.float64,
    "float32": torch.float32,
    "tf32": torch.float32,
    "bfloat16": torch.bfloat16,
    "float16": torch.float16,
}


def named_dtype(name: str, splats: torch.dtype) -> torch.dtype:
    """The dtype a setting names; `float32` and `tf32` mean at least the splats' own, so float64 splats keep float64."""
    dtype = DTYPES[name]
    return torch.promote_types(dtype, splats) if dtype == torch.float32 else dtype


@dataclass(frozen=True, kw_only=True)
class Precision:
    """dtypes of the work on one picture."""

    evaluation: torch.dtype
    """Of ln alpha and alpha at pixels."""
    accumulation: torch.dtype
    """Of transmittance, weights, sums of light, and of their gradients at pixels."""
    exact: torch.dtype
    """The widest of the splats' dtype and the two above: of what is computed once per list entry, and of the sums over
    pixels and list entries that make a splat's gradient."""
    tf32: bool
    """Matrix products of float32 may round their factors to 10 bits; a CPU never does."""

    @staticmethod
    def of(settings: RasterSettings, splats: torch.dtype) -> "Precision":
        """What `settings` mean for splats of this dtype."""
        evaluation = named_dtype(settings.evaluation, splats)
        accumulation = named_dtype(settings.accumulation, splats)
        return Precision(
            evaluation=evaluation,
            accumulation=accumulation,
            exact=torch.promote_types(torch.promote_types(evaluation, accumulation), splats),
            tf32=settings.evaluation == "tf32",
        )

    @property
    def narrow(self) -> bool:
        """Light is summed in 16 bits: its range or resolution is then too small for arbitrary units."""
        return self.accumulation.itemsize == 2

    @contextmanager
    def products(self) -> Iterator[None]:
        """Inside, matrix products on a GPU follow `tf32`; torch's own setting is put back afterwards."""
        before = torch.backends.cuda.matmul.fp32_precision
        if self.tf32:
            torch.backends.cuda.matmul.fp32_precision = "tf32"
        try:
            yield
        finally:
            if self.tf32:
                torch.backends.cuda.matmul.fp32_precision = before


def power_of_two_above(largest: Float[Tensor, "..."]) -> Float[Tensor, "..."]:
    """The least power of two above each value, so that dividing by it is exact; 1 for zero and what is not finite."""
    exponent = torch.frexp(largest).exponent.clamp(-126, 126)
    return torch.where((largest > 0) & largest.isfinite(), torch.ldexp(torch.ones_like(largest), exponent), 1.0)
