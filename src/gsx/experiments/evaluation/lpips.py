"""LPIPS (Zhang et al. 2018, v0.1) with weights from local files; nothing is ever downloaded.

The trunk is torchvision's VGG16 or AlexNet state dict (`vgg16-397923af.pth`, `alexnet-owt-7be5be79.pth`), the head the
linear layers of the lpips package (`vgg.pth`, `alex.pth`). Published 3D-GS figures feed images in [0, 1] although the
network expects [-1, 1] (3D-GS, metrics.py): `input_range` selects, and the name of the figure says which.
"""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor, nn

from gsx.core.errors import InputError
from gsx.core.shapes import Float
from gsx.experiments.evaluation.weight_files import read_weights

logger = logging.getLogger(__name__)

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""LPIPS input normalisation for values in [-1, 1]."""
Layer: TypeAlias = tuple[int, int, int, int]
"""Of a convolution: channels, kernel, stride, padding; a ReLU follows."""
VGG_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
STAGES: dict[str, list[tuple[int, list[Layer]]]] = {
    "vgg": [(2 if n else 0, [(width, 3, 1, 1) for width in widths]) for n, widths in enumerate(VGG_WIDTHS)],
    "alex": [(0, [(64, 11, 4, 2)]), (3, [(192, 5, 1, 2)]), (3, [(384, 3, 1, 1)]), *[(0, [(256, 3, 1, 1)])] * 2],
}
"""VGG16 and AlexNet up to their last ReLUs: the edge of the max pooling before each stage (0: none), and its layers."""


@dataclass(frozen=True, kw_only=True)
class LpipsOptions:
    """Where the weights are; empty paths: LPIPS is not computed."""

    trunk: str
    head: str
    net: str
    input_range: str


def stages_of(net: str) -> nn.ModuleList:
    """Stages whose features are compared; children numbered as in torchvision's `features`."""
    stages, number, channels = nn.ModuleList(), 0, 3
    for pooling, layers in STAGES[net]:
        stage = nn.Sequential()
        if pooling:
            stage.add_module(str(number), nn.MaxPool2d(pooling, 2))
            number += 1
        for width, kernel, stride, padding in layers:
            stage.add_module(str(number), nn.Conv2d(channels, width, kernel, stride, padding))
            stage.add_module(str(number + 1), nn.ReLU())
            number, channels = number + 2, width
        stages.append(stage)
    return stages


class Lpips(nn.Module):
    """Perceptual distance: weighted squared differences of unit-normalised features, averaged over space."""

    def __init__(self, net: str, input_range: str) -> None:
        super().__init__()
        if net not in STAGES or input_range not in ("unit", "signed"):
            raise InputError(
                f"metrics.lpips has net '{net}' and input_range '{input_range}': "
                "choose net vgg or alex, input_range unit ([0,1], as published) or signed ([-1,1])"
            )
        self.net, self.signed = net, input_range == "signed"
        self.stages = stages_of(net)
        self.heads = nn.ParameterList([torch.zeros(layers[-1][0]) for _, layers in STAGES[net]])
        self.note = ""

    @property
    def name(self) -> str:
        """Names the variant in results."""
        return f"lpips_{self.net}, input in {'[-1,1]' if self.signed else '[0,1]'}{self.note}"

    @torch.no_grad()
    def distance(self, image: Float[Tensor, "3 H W"], target: Float[Tensor, "3 H W"]) -> float:
        """LPIPS of two pictures with values in [0, 1]."""
        pair = torch.stack([image, target]).to(self.heads[0])
        features = (pair * 2 - 1 if self.signed else pair) - pair.new_tensor(SHIFT)[:, None, None]
        features = features / pair.new_tensor(SCALE)[:, None, None]
        total = 0.0
        for stage, head in zip(self.stages, self.heads, strict=True):
            features = stage(features)
            unit = features / (features.norm(dim=1, keepdim=True) + 1e-10)
            total += float(((unit[0] - unit[1]).square() * head[:, None, None]).sum(0).mean())
        return total


def shapes_of(net: str) -> tuple[dict[str, torch.Size], dict[str, int]]:
    """Return what net `vgg` or `alex` needs: shapes of the trunk's tensors, lengths of the head's, by name."""
    with torch.device("meta"):
        stages = stages_of(net)
    trunk = {f"features.{name.partition('.')[2]}": value.shape for name, value in stages.state_dict().items()}
    return trunk, {f"lin{index}.model.1.weight": layers[-1][0] for index, (_, layers) in enumerate(STAGES[net])}


def misfit(trunk: Mapping[str, Tensor], head: Mapping[str, Tensor], net: str) -> str:
    """Return what is wrong with the two files for a net, in words; empty if both fit."""
    shapes, lengths = shapes_of(net)
    for file, weights, needed in (("trunk", trunk, shapes), ("head", head, lengths)):
        for name, size in needed.items():
            if name not in weights:
                return f"the {file} file lacks finite '{name}'"
            found = weights[name].shape if file == "trunk" else weights[name].numel()
            if found != size:
                return f"'{name}' of the {file} file has {words_of(found)} instead of {words_of(size)} numbers"
    return ""


def words_of(size: int | torch.Size) -> str:
    """Return a shape or a length as text."""
    return str(size) if isinstance(size, int) else "x".join(map(str, size))


def refuse_misfit(trunk: Mapping[str, Tensor], head: Mapping[str, Tensor], net: str) -> None:
    """Raise InputError if the two files do not hold the weights of a net."""
    problem = misfit(trunk, head, net)
    if not problem:
        return
    other = next((name for name in STAGES if not misfit(trunk, head, name)), None)
    swapped = not misfit(head, trunk, net)
    remedy = f"set metrics.lpips.net={other}" if other else "swap them" if swapped else "check both files"
    raise InputError(f"metrics.lpips weights do not fit net '{net}' ({problem}): {remedy}")


def load_lpips(options: LpipsOptions) -> Lpips | None:
    """The network, or None without weights (said once in the log).

    Raises:
        InputError: a given file is missing, unreadable or of another network.
    """
    if bool(options.trunk) != bool(options.head):
        missing = "head" if options.trunk else "trunk"
        raise InputError(f"metrics.lpips.{missing} is missing: give both weights files, or neither")
    if not options.trunk:
        logger.info("LPIPS: n/a (no weights); give metrics.lpips.trunk=FILE and metrics.lpips.head=FILE")
        return None
    network = Lpips(options.net, options.input_range)
    trunk, trunk_hash = read_weights(options.trunk, "metrics.lpips.trunk")
    head, head_hash = read_weights(options.head, "metrics.lpips.head")
    refuse_misfit(trunk, head, options.net)
    for stage in network.stages:
        for number, layer in stage.named_children():
            if isinstance(layer, nn.Conv2d):
                layer.load_state_dict({k: trunk[f"features.{number}.{k}"] for k in ("weight", "bias")})
    for index, parameter in enumerate(network.heads):
        parameter.data.copy_(head[f"lin{index}.model.1.weight"].flatten())
    network.note = f", trunk {trunk_hash}, head {head_hash}"
    return network.eval()
