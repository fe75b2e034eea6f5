"""Small networks that decode an anchor into Gaussians for one camera (Scaffold-GS)."""

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor, nn

from gsx.core.errors import InputError
from gsx.core.ranges import Range
from gsx.core.shapes import Float

LEAST_DISTANCE = 1e-8
"""Lower bound of distances whose direction is taken, world units (Scaffold-GS, generate_neural_gaussians)."""


@dataclass(frozen=True, kw_only=True)
class HeadOptions:
    """Shape of the networks; values in conf/backbone, with their sources."""

    features: Annotated[int, Range(4, 1024)]
    """C: width of an anchor's feature and of the one hidden layer of every head."""
    bank: bool
    """Mix the feature with coarser copies of itself by view (Scaffold-GS, gaussian_model.py)."""
    bank_distance: bool
    """Feed the distance to the bank (Scaffold-GS yes, Octree-GS no)."""
    opacity_distance: bool
    covariance_distance: bool
    colour_distance: bool
    """Feed the distance between camera and anchor to a head."""
    level: bool
    """Feed an anchor's level to every head and to the bank (Octree-GS: add_level)."""
    appearance: Annotated[int, Range(0, 1024)]
    """Length of a training view's appearance code, an input of the colour head; 0: none."""
    appearance_code: Annotated[int, Range(-1, 10**6)]
    """Training view whose code all other cameras use; -1: the mean of all codes."""

    def __post_init__(self) -> None:
        if self.features % 4:
            raise ValueError(f"backbone.heads.features is {self.features}; give a multiple of 4")


def linear(inputs: int, outputs: int, generator: torch.Generator) -> nn.Linear:
    """Builds a layer with torch's default initial distribution, drawn from `generator`."""
    layer, bound = nn.utils.skip_init(nn.Linear, inputs, outputs), 1 / math.sqrt(inputs)
    with torch.no_grad():
        layer.weight.uniform_(-bound, bound, generator=generator)
        layer.bias.uniform_(-bound, bound, generator=generator)
    return layer


def head(inputs: int, width: int, outputs: int, last: nn.Module, generator: torch.Generator) -> nn.Sequential:
    """Builds a network with one hidden layer and ReLU."""
    return nn.Sequential(
        linear(inputs, width, generator), nn.ReLU(inplace=True), linear(width, outputs, generator), last
    )


def tiled(feature: Float[Tensor, "A C"], stride: int) -> Float[Tensor, "A C"]:
    """Takes every `stride`-th value and tiles the sub-vector to full length."""
    return feature[:, ::stride].repeat(1, stride)


class Heads(nn.Module):
    """Opacity, covariance and colour of k Gaussians per anchor."""

    def __init__(self, options: HeadOptions, offsets: int, views: int, generator: torch.Generator) -> None:
        super().__init__()
        width, o = options.features, options
        if o.appearance and o.appearance_code >= views:
            raise InputError(
                f"backbone.heads.appearance_code is {o.appearance_code}; training views have numbers 0 to {views - 1}"
            )
        base = width + 3 + int(o.level)
        self.options, self.offsets = options, offsets
        self.opacity = head(base + int(o.opacity_distance), width, offsets, nn.Tanh(), generator)
        self.covariance = head(base + int(o.covariance_distance), width, 7 * offsets, nn.Identity(), generator)
        colour = base + int(o.colour_distance) + o.appearance
        self.colour = head(colour, width, 3 * offsets, nn.Sigmoid(), generator)
        if o.bank:
            inputs = 3 + int(o.bank_distance) + int(o.level)
            self.bank = head(inputs, width, 3, nn.Softmax(dim=1), generator)
        if o.appearance:
            self.appearance = nn.Embedding(
                views, o.appearance, _weight=torch.randn(views, o.appearance, generator=generator)
            )

    def forward(
        self,
        feature: Float[Tensor, "A C"],
        offset: Float[Tensor, "A 3"],
        level: Float[Tensor, "A 1"],
        view: int,
    ) -> tuple[Float[Tensor, "A k"], Float[Tensor, "A k 7"], Float[Tensor, "A k 3"]]:
        """Returns (opacities in (-1, 1), raw scales and quaternions, colours in (0, 1)).

        `offset` is anchor minus camera centre, world units; `view` the number of a training view, or -1.
        """
        o = self.options
        distance = offset.norm(dim=1, keepdim=True)
        direction = offset / distance.clamp_min(LEAST_DISTANCE)
        extra = [level] if o.level else []
        if o.bank:
            feature = self.mixed(feature, [direction, *([distance] if o.bank_distance else []), *extra])

        def inputs(with_distance: bool, *more: Tensor) -> Tensor:
            return torch.cat([feature, direction, *([distance] if with_distance else []), *extra, *more], 1)

        code = [self.code(view).expand(len(feature), -1)] if o.appearance else []
        return (
            self.opacity(inputs(o.opacity_distance)),
            self.covariance(inputs(o.covariance_distance)).view(-1, self.offsets, 7),
            self.colour(inputs(o.colour_distance, *code)).view(-1, self.offsets, 3),
        )

    def mixed(self, feature: Float[Tensor, "A C"], inputs: list[Tensor]) -> Float[Tensor, "A C"]:
        """Mixes features at three resolutions, weighted by view."""
        weights = self.bank(torch.cat(inputs, 1))
        parts = (tiled(feature, 4), tiled(feature, 2), feature)
        return sum((weights[:, i : i + 1] * part for i, part in enumerate(parts)), start=torch.zeros_like(feature))

    def code(self, view: int) -> Float[Tensor, "A"]:
        """Returns the appearance code of a training view, or that of all other cameras."""
        number = view if view >= 0 else self.options.appearance_code
        return self.appearance.weight[number] if number >= 0 else self.appearance.weight.mean(0)
