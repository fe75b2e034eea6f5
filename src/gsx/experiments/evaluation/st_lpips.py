"""Shift-tolerant LPIPS (Ghildyal and Liu, ECCV 2022) with the weights of the package stlpips-pytorch.

The networks differ from those of LPIPS: convolutions and max pooling have stride 1, and a blur with reflected borders
takes every second sample instead. A shift by less than a pixel, which nobody notices, changes the figure less.
"""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from gsx.core.shapes import Float
from gsx.experiments.evaluation.feature_distance import FeatureDistance
from gsx.experiments.evaluation.lpips import STAGES, head_name, widths_of

BINOMIAL = (0.25, 0.5, 0.25)
"""Weights of the blur along each axis."""
REFLECTED = 2
"""Samples by which a blur reflects its input at each border."""
LEAST_MERGED = 32
"""Edge of the smallest picture whose first convolution is merged with its blur, px."""
STRIP = 16
"""Even width of a border strip that holds all pixels behind the last output sample, px."""


def binomial(like: Tensor) -> Float[Tensor, "3 3"]:
    """Returns the kernel of the blur."""
    line = like.new_tensor(BINOMIAL)
    return line[:, None] * line


def blur(features: Float[Tensor, "N C H W"]) -> Float[Tensor, "N C h w"]:
    """Blurs features with reflected borders and keeps every second sample."""
    channels = features.shape[1]
    kernel = binomial(features).expand(channels, 1, 3, 3)
    return conv2d(pad(features, [REFLECTED] * 4, "reflect"), kernel, stride=2, groups=channels)


class Blur(nn.Module):
    """Blur that keeps every second sample."""

    def forward(self, features: Float[Tensor, "N C H W"]) -> Float[Tensor, "N C h w"]:
        """Blurs features."""
        return blur(features)


class BlurredConv2d(nn.Conv2d):
    """Convolution with stride 1, followed by a blur that keeps every second sample."""

    def forward(self, picture: Float[Tensor, "N C H W"]) -> Float[Tensor, "N D h w"]:
        """Convolves and blurs; large pictures by one merged kernel, which takes a third of the time."""
        return self.merged(picture) if min(picture.shape[2:]) >= LEAST_MERGED else self.separate(picture)

    def separate(self, picture: Float[Tensor, "N C H W"]) -> Float[Tensor, "N D h w"]:
        """Convolves, then blurs."""
        return blur(super().forward(picture))

    def merged(self, picture: Float[Tensor, "N C H W"]) -> Float[Tensor, "N D h w"]:
        """Convolves with the blurred kernel at stride 2, then adds the borders.

        The first sample reflects the second, as does the last one where the convolution has an odd size. Where it has
        an even one, the last sample comes from a strip along that border.
        """
        kernel = conv2d(self.weight.flatten(0, 1)[:, None], binomial(self.weight)[None, None], padding=2)
        kernel = kernel.unflatten(0, self.weight.shape[:2]).squeeze(2)
        kernel = kernel.contiguous(memory_format=torch.channels_last)  # twice as fast on a CPU
        out = pad(conv2d(picture, kernel, self.bias, 2, self.padding), (1, 1, 1, 1), "replicate")
        if self.has_even_size(picture.shape[2]):
            out[..., -1:, :] = self.separate(picture[..., -STRIP:, :])[..., -1:, :]
        if self.has_even_size(picture.shape[3]):
            out[..., -1:] = self.separate(picture[..., -STRIP:])[..., -1:]
        return out

    def has_even_size(self, side: int) -> bool:
        """Returns whether the convolution of so many pixels has an even number of samples."""
        return (side + 2 * int(self.padding[0]) - self.kernel_size[0]) % 2 == 1


def shift_tolerant_stages(net: str) -> nn.ModuleList:
    """Builds the stages whose features are compared; children have the numbers of the package's networks."""
    stages, index, channels = nn.ModuleList(), 0, 3
    for pooling, layers in STAGES[net]:
        stage = nn.Sequential()
        for part, places in parts_of(pooling, layers, channels):
            stage.add_module(str(index), part)
            index += places
        stages.append(stage)
        channels = layers[-1][0]
    return stages


def parts_of(pooling: int, layers: list[tuple[int, int, int, int]], channels: int) -> Iterator[tuple[nn.Module, int]]:
    """Yields the parts of a stage, each with the number of modules that it stands for."""
    if pooling:
        yield nn.MaxPool2d(pooling, 1), 1
        yield Blur(), 1
    for width, kernel, stride, padding in layers:
        convolution = nn.Conv2d if stride == 1 else BlurredConv2d
        yield convolution(channels, width, kernel, 1, padding), 1 if stride == 1 else 2
        yield nn.ReLU(inplace=True), 1
        channels = width


def shift_tolerant_lpips(net: str, weights: Mapping[str, Tensor]) -> FeatureDistance:
    """Builds the metric from the tensors of the package's file; `net`: alex or vgg."""
    network = FeatureDistance(shift_tolerant_stages(net), widths_of(net), signed=True)
    for number, stage in enumerate(network.stages, 1):
        stage.load_state_dict({name: weights[f"net.slice{number}.{name}"] for name in stage.state_dict()})
    for number, head in enumerate(network.heads):
        head.data.copy_(weights[head_name(number)].flatten())
    return network.eval().requires_grad_(False)
