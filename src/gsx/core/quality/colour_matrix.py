"""Affine colour transformations of images by 3x4 matrices."""

import torch
from torch import Tensor

from gsx.core.shapes import Bool, Float


def transform_colours(image: Float[Tensor, "3 H W"], matrix: Float[Tensor, "3 4"]) -> Float[Tensor, "3 H W"]:
    """Returns A [r, g, b, 1]^T of every pixel."""
    return (matrix[:, :3] @ image.flatten(1)).view_as(image) + matrix[:, 3, None, None]


def fit_colours(
    image: Float[Tensor, "3 H W"], truth: Float[Tensor, "3 H W"], mask: Bool[Tensor, "H W"]
) -> Float[Tensor, "3 4"]:
    """Returns the matrix that best fits the image to the truth where `mask` is True, by least squares."""
    mask = mask.to(image.device)
    rows = torch.cat([image, torch.ones_like(image[:1])])[:, mask].double().T.cpu()
    target = truth[:, mask].double().T.cpu()
    return torch.linalg.lstsq(rows, target, driver="gelsd").solution.T.float().to(image.device)  # least norm
