"""Colour matrices: A [r, g, b, 1]^T of every pixel."""

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float


def transform_colours(image: Float[Tensor, "3 H W"], matrix: Float[Tensor, "3 4"]) -> Float[Tensor, "3 H W"]:
    """Returns A [r, g, b, 1]^T of every pixel."""
    return (matrix[:, :3] @ image.flatten(1)).view_as(image) + matrix[:, 3, None, None]


def fit_colours(
    image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """Returns the matrix that brings the masked pixels closest to the truth, by least squares."""
    mask = mask.to(image.device)
    rows = torch.cat([image, torch.ones_like(image[:1])])[:, mask].double().T.cpu()
    target = truth[:, mask].double().T.cpu()
    return torch.linalg.lstsq(rows, target, driver="gelsd").solution.T.float().to(image.device)  # of lower rank: least
