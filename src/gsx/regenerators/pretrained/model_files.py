"""Options and files of pretrained networks: found in installed packages without import, checked by digest."""

import hashlib
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

from gsx.core.errors import ConfigError
from gsx.core.files import LFS_POINTER, expand_home
from gsx.core.ranges import Range

SCALES = (1, 2, 3, 4)
"""Scales that a network of the options may have."""
RUNNERS = {".param": ("ncnn", "gsx[upscalers]"), ".onnx": ("onnxruntime", "gsx[onnx]")}
"""Package that runs a file, and the extra that installs it, by suffix."""


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


@dataclass(frozen=True, kw_only=True)
class Model:
    """A network in files."""

    scale: int
    file: Path
    """.param or .onnx file."""
    sha256: str


def locate_models(options: PretrainedOptions, key: str) -> dict[int, Model]:
    """Locates and checks the networks of some options; `key`: their place in the configuration, for errors.

    Raises:
        ConfigError: a package or file is missing, or a file differs from the known one.
    """
    return {scale: locate(options, scale, model, key) for scale, model in options.models().items()}


def locate(options: PretrainedOptions, scale: int, model: ModelOptions, key: str) -> Model:
    """Locates and checks one network; errors as `locate_models`."""
    option = f"{key}.x{scale}.file"
    runner, extra = RUNNERS.get(Path(model.file).suffix, ("", ""))
    if not runner:
        raise ConfigError(f"{option}={model.file}: give a .param file of ncnn, next to its .bin file, or an .onnx file")
    if find_spec(runner) is None:
        raise ConfigError(f"{option}={model.file} needs the package {runner}: pip install '{extra}'")
    file = packaged(options, model.file, extra) if options.package else expand_home(model.file)
    return Model(scale=scale, file=file, sha256=checked_digest(file, model, option, options.package))


def packaged(options: PretrainedOptions, file: str, extra: str) -> Path:
    """Returns the path of a file in an installed package; ConfigError: the package is missing."""
    try:
        return Path(str(distribution(options.package).locate_file(file)))
    except PackageNotFoundError:
        raise ConfigError(
            f"regenerator {options.name} needs the package {options.package}: pip install '{extra}'"
        ) from None


def checked_digest(file: Path, model: ModelOptions, option: str, package: str) -> str:
    """Returns the sha256 of a network's files; ConfigError: they are missing, or others than the options say."""
    digest = hashlib.sha256(b"".join(read(path, option) for path in files_of(file))).hexdigest()
    if model.sha256 and digest != model.sha256:
        remedy = f"reinstall {package}" if package else "download it again"
        raise ConfigError(
            f"{option}={file} has sha256 {digest}, not {model.sha256}: it is damaged or another version. {remedy}, or "
            f"accept it by {option.removesuffix('file')}sha256={digest}"
        )
    return digest


def files_of(file: Path) -> list[Path]:
    """Lists the files of a network: structure and weights of ncnn, or one of ONNX."""
    return [file, file.with_suffix(".bin")] if file.suffix == ".param" else [file]


def read(path: Path, option: str) -> bytes:
    """Reads a file of a network; ConfigError: it is missing, empty, or a pointer of Git LFS."""
    try:
        content = path.read_bytes()
    except OSError as error:
        place = path.absolute()  # a run may be continued in another folder than its own
        raise ConfigError(f"{option}: {place} cannot be read ({error.strerror}): give the path of a network") from None
    if not content:
        raise ConfigError(f"{option}: {path} is empty: download it again")
    if content.startswith(LFS_POINTER):
        raise ConfigError(f"{option}: {path} is a Git LFS pointer: `git lfs pull` fetches the file")
    return content
