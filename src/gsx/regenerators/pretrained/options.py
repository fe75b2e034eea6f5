"""Options of pretrained networks."""

from dataclasses import dataclass
from typing import Annotated

from gsx.core.ranges import Range

SCALES = (1, 2, 3, 4)
"""Scales that a network of the options may have."""


@dataclass(frozen=True, kw_only=True)
class ModelOptions:
    """Files of one network."""

    file: str
    """Path of the .param file, next to its .bin file, or of an .onnx file; empty: no network of this scale."""
    sha256: str
    """Digest of the files, .param first; empty: any."""


@dataclass(frozen=True, kw_only=True)
class PretrainedOptions:
    """Options of conf/regenerator/*/{span,real_esrgan,ncnn}.yaml."""

    name: str
    package: str
    """Installed package that contains the files; empty: the files are the user's."""
    licence: str
    """Licences of code and weights, for provenance."""
    x1: ModelOptions
    x2: ModelOptions
    x3: ModelOptions
    x4: ModelOptions
    tile: Annotated[int, Range(16, 1 << 16)]
    """Largest side of the part of a picture that is run at a time, px of the input."""
    border: Annotated[int, Range(0, 1024)]
    """Overlap of parts and reflected rim of the picture, px of the input."""
    photos_gb: Annotated[float, Range(0, 1e6)]
    """Memory for enlarged photos, 1e9 bytes; if they need more, windows are enlarged one by one."""
    vulkan: bool
    """True: run on a GPU by Vulkan."""

    def __post_init__(self) -> None:
        if self.border > self.tile:
            sides = f"border is {self.border} px, tile is {self.tile} px"
            raise ValueError(f"regenerator {self.name}: {sides}. Lower border, or raise tile.")

    def models(self) -> dict[int, ModelOptions]:
        """Returns the networks with a file, by scale."""
        by_scale = {scale: getattr(self, f"x{scale}") for scale in SCALES}
        return {scale: model for scale, model in by_scale.items() if model.file}
