"""Colours of a photo as a function of its render: light across the photo, then a colour matrix.

Ours: 14 numbers, all 0 for the identity, in display values; Gauss-Newton fits them. A falloff towards the corners and a
tone, as in PPISP (Deutsch et al. 2026), recovered no more of demo with gains and slopes.
"""

import torch
from torch import Tensor

from gsx.core.quality.colour_matrix import transform_colours
from gsx.core.shapes import Bool, Float
from gsx.modules.bilateral_grid import WHOLE, Edges, centres

NUMBERS, MATRIX = 14, 12
"""Numbers of a response; the first of them are the matrix less the identity, the others slopes of the log light."""
FIT_PIXELS = 1 << 14
"""Most pixels of a fit, evenly spread over those that count."""
FIT_STEPS = 5
INDEPENDENT = 250
"""Pixels that count as one measurement: a model's errors are alike in neighbours (as in `alignment`)."""
LEAST_ERROR = 1 / 255
"""Least standard deviation of a fit's residuals, display values."""


def light_fields(image: Float[Tensor, "3 H W"], edges: Edges = WHOLE) -> Float[Tensor, "2 H W"]:
    """Returns x and y of each pixel, [-1, 1] over the photo: the fields of the log light."""
    left, top, right, bottom = edges
    height, width = image.shape[1:]
    x = centres(left, right, width, image).expand(height, -1)
    return torch.stack([x, centres(top, bottom, height, image)[:, None].expand(-1, width)])


def respond(
    image: Float[Tensor, "3 H W"], fields: Float[Tensor, "2 H W"], numbers: Float[Tensor, "14"]
) -> Float[Tensor, "3 H W"]:
    """Returns the photo of a render by these numbers. Differentiable in both."""
    return transform_colours(image * torch.einsum("k,khw->hw", numbers[MATRIX:], fields).exp(), matrix_of(numbers))


def matrix_of(numbers: Float[Tensor, "14"]) -> Float[Tensor, "3 4"]:
    """Returns the colour matrix."""
    return torch.eye(3, 4, dtype=numbers.dtype, device=numbers.device) + numbers[:MATRIX].view(3, 4)


def response_slopes(
    image: Float[Tensor, "3 N"], fields: Float[Tensor, "2 N"], numbers: Float[Tensor, "14"]
) -> Float[Tensor, "3 N 14"]:
    """Returns the derivatives of `respond` by its numbers."""
    lit = image * (numbers[MATRIX:] @ fields).exp()
    entries = torch.cat([lit, torch.ones_like(lit[:1])]).T
    by_matrix = torch.eye(3).to(lit)[:, None, :, None] * entries[:, None]
    by_light = (matrix_of(numbers)[:, :3] @ lit)[..., None] * fields.T
    return torch.cat([by_matrix.flatten(2), by_light], 2)


def fit_code(
    image: Float[Tensor, "3 H W"],
    photo: Float[Tensor, "3 H W"],
    counted: Bool[Tensor, "H W"],
    decoder: Float[Tensor, "14 C"],
    precisions: Float[Tensor, "C"],
) -> Float[Tensor, "C"]:
    """Fits a code, whose numbers are `decoder @ code`, to the pixels of a photo that count.

    precisions: inverse variances of the prior, which is centred on 0: the answer where no pixel counts.
    """
    places = counted.flatten().cpu().nonzero()[:, 0]
    places = places[:: max(1, -(-len(places) // FIT_PIXELS))].to(image.device)
    pixels, target, fields = (
        part.flatten(1)[:, None, places].double() for part in (image, photo.to(image.device), light_fields(image))
    )
    decoder, prior = decoder.double(), torch.diag(precisions.double())
    code = decoder.new_zeros(decoder.shape[1])
    for _ in range(FIT_STEPS if len(places) else 0):
        error = (target - respond(pixels, fields, decoder @ code)).flatten()
        slope = (response_slopes(pixels[:, 0], fields[:, 0], decoder @ code) @ decoder).flatten(0, 1)
        weight = 1 / (INDEPENDENT * float(error.square().mean().clamp(min=LEAST_ERROR**2)))
        code = code + torch.linalg.solve(weight * slope.T @ slope + prior, weight * slope.T @ error - prior @ code)
    return code.to(image.dtype)


def principal_codes(numbers: Float[Tensor, "N 14"], size: int) -> tuple[Float[Tensor, "N C"], Float[Tensor, "14 C"]]:
    """Returns (codes, decoder) that come closest to the numbers less their mean: their principal components."""
    left, scales, right = torch.linalg.svd(numbers - numbers.mean(0), full_matrices=False)
    return (left[:, :size] * scales[:size]).contiguous(), right[:size].T.contiguous()
