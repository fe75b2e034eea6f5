"""LPIPS (Zhang et al. 2018, v0.1) with weights from local files; nothing is ever downloaded.

The trunk is torchvision's VGG16 or AlexNet state dict (`vgg16-397923af.pth`, `alexnet-owt-7be5be79.pth`), the head the
linear layers of the lpips package (`vgg.pth`, `alex.pth`). 3D-GS (metrics.py) feeds [0, 1] although the network expects
[-1, 1]: `input_range` selects.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import torch
from torch import Tensor, nn

from gsx.core.errors import InputError
from gsx.experiments.evaluation.feature_distance import FeatureDistance
from gsx.experiments.evaluation.weights import read_weights

Layer: TypeAlias = tuple[int, int, int, int]
"""Convolution: channels, kernel, stride, padding; a ReLU follows."""
VGG_WIDTHS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
STAGES: dict[str, list[tuple[int, list[Layer]]]] = {
    "vgg": [(2 if n else 0, [(width, 3, 1, 1) for width in widths]) for n, widths in enumerate(VGG_WIDTHS)],
    "alex": [(0, [(64, 11, 4, 2)]), (3, [(192, 5, 1, 2)]), (3, [(384, 3, 1, 1)]), *[(0, [(256, 3, 1, 1)])] * 2],
}
"""VGG16 and AlexNet up to their last ReLUs: the edge of the max pooling before each stage (0: none), and its layers."""


@dataclass(frozen=True, kw_only=True)
class LpipsOptions:
    """Weights files; empty paths: LPIPS is not computed."""

    trunk: str
    head: str
    net: str
    input_range: str


def stages_of(net: str) -> nn.ModuleList:
    """Builds the stages whose features are compared; children have the numbers of torchvision's `features`."""
    stages, index, channels = nn.ModuleList(), 0, 3
    for pooling, layers in STAGES[net]:
        stage = nn.Sequential()
        if pooling:
            stage.add_module(str(index), nn.MaxPool2d(pooling, 2))
            index += 1
        for width, kernel, stride, padding in layers:
            stage.add_module(str(index), nn.Conv2d(channels, width, kernel, stride, padding))
            stage.add_module(str(index + 1), nn.ReLU())
            index, channels = index + 2, width
        stages.append(stage)
    return stages


class Lpips(FeatureDistance):
    """LPIPS with the features of VGG16 or AlexNet."""

    def __init__(self, net: str, input_range: str) -> None:
        if net not in STAGES or input_range not in ("unit", "signed"):
            raise InputError(
                f"metrics.lpips has net '{net}' and input_range '{input_range}': "
                "choose net vgg or alex, input_range unit ([0,1], as published) or signed ([-1,1])"
            )
        super().__init__(stages_of(net), widths_of(net), input_range == "signed")
        self.net, self.note = net, ""

    @property
    def name(self) -> str:
        """Returns the name of the variant in results."""
        return f"lpips_{self.net}, input in {self.input}{self.note}"


def widths_of(net: str) -> list[int]:
    """Returns the channels after each stage."""
    return [layers[-1][0] for _, layers in STAGES[net]]


def shapes_of(net: str) -> dict[str, dict[str, str]]:
    """Returns the shapes that a net needs, as text, by file and name of the tensor."""
    with torch.device("meta"):
        stages = stages_of(net)
    trunk = {f"features.{name.partition('.')[2]}": shape_text(value) for name, value in stages.state_dict().items()}
    return {"trunk": trunk, "head": {head_name(i): str(width) for i, width in enumerate(widths_of(net))}}


def head_name(stage: int) -> str:
    """Names the tensor of a stage in the head's file."""
    return f"lin{stage}.model.1.weight"


def shape_text(value: Tensor) -> str:
    """Formats a shape without its ones, since heads differ in these."""
    return "x".join(str(size) for size in value.shape if size > 1)


def misfit(trunk: Mapping[str, Tensor], head: Mapping[str, Tensor], net: str) -> str:
    """Describes what is wrong with two files for a net; empty: both fit."""
    for (file, needed), weights in zip(shapes_of(net).items(), (trunk, head), strict=True):
        for name, shape in needed.items():
            if name not in weights:
                return f"the {file} file lacks finite '{name}'"
            if shape_text(weights[name]) != shape:
                return f"'{name}' of the {file} file has {shape_text(weights[name])} instead of {shape} numbers"
    return ""


def refuse_misfit(trunk: Mapping[str, Tensor], head: Mapping[str, Tensor], net: str) -> None:
    """Raises InputError if two files do not hold the weights of a net."""
    problem = misfit(trunk, head, net)
    if not problem:
        return
    other = next((name for name in STAGES if not misfit(trunk, head, name)), None)
    swapped = not misfit(head, trunk, net)
    remedy = f"set metrics.lpips.net={other}" if other else "swap them" if swapped else "check both files"
    raise InputError(f"metrics.lpips weights do not fit net '{net}' ({problem}): {remedy}")


def load_lpips(options: LpipsOptions) -> Lpips | None:
    """Loads the network; None without weights.

    Raises:
        InputError: a file is missing, unreadable or of another network.
    """
    if bool(options.trunk) != bool(options.head):
        missing = "head" if options.trunk else "trunk"
        raise InputError(f"metrics.lpips.{missing} is missing: give both weights files, or neither")
    if not options.trunk:
        return None
    trunk, trunk_hash = read_weights(options.trunk, "metrics.lpips.trunk")
    head, head_hash = read_weights(options.head, "metrics.lpips.head")
    network = lpips_from(options.net, options.input_range, trunk, head)
    network.note = f", trunk {trunk_hash}, head {head_hash}"
    return network


def lpips_from(net: str, input_range: str, trunk: Mapping[str, Tensor], head: Mapping[str, Tensor]) -> Lpips:
    """Builds the network from the tensors of two files.

    Raises:
        InputError: the options are unknown, or the files hold another network.
    """
    network = Lpips(net, input_range)
    refuse_misfit(trunk, head, net)
    for stage in network.stages:
        stage.load_state_dict({name: trunk[f"features.{name}"] for name in stage.state_dict()})
    for index, parameter in enumerate(network.heads):
        parameter.data.copy_(head[head_name(index)].flatten())
    return network.eval()
