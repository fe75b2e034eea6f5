"""Options common to all loaders of photographs; values and sources are in conf/scene/*.yaml."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from gsx.core.data.resize import FILTERS, LIGHTS
from gsx.core.errors import ConfigError, nearest
from gsx.core.options import without_effect
from gsx.core.ranges import Gigabytes, Range, Share, Steps
from gsx.scenes.blocks import parsed_block

WORDS = {
    "resize_filter": FILTERS,
    "resize_light": LIGHTS,
    "principal_point": ("exact", "centred"),
    "masks": ("auto", "alpha", "none"),
    "orientation": ("auto", "stored", "turned"),
    "lens": ("undistort", "native"),
    "depth_values": ("depth", "disparity"),
    "depth_fit": ("affine", "scale", "none"),
}
"""Values of options that are words."""


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Fields common to all loaders; each format adds its own."""

    name: str
    """Name of the format, and of its file in conf/scene."""
    background: Annotated[list[float], Range(0, 1)]
    """Display RGB in [0, 1] behind the scene; images with alpha are composited over it (3D-GS, dataset_readers.py)."""
    iterations: Steps = without_effect(default=0)
    """Length of a run on this scene, unless a variant or the top-level `iterations` sets it; 0: the backbone's."""
    path: str = without_effect(default="")
    """Folder of the scene."""
    downscale: Annotated[int, Range(1, 1024)] = 1
    """Train on images reduced by this factor; the originals stay the truth of zoomed-in views (3D-GS)."""
    max_width: Annotated[int, Range(0, 1 << 20)] = 1600
    """With downscale=1, wider images are reduced to this many pixels; 0: no limit (3D-GS, camera_utils.py)."""
    resize_filter: str = "bicubic"
    """bicubic (as published) | area | lanczos; all of them prefilter."""
    resize_light: str = "display"
    """display (as published): filter the stored values; linear: filter light, after undoing the sRGB curve."""
    principal_point: str = "exact"
    """exact | centred; centred ignores the measured principal point, as 3D-GS does (3D-GS, dataset_readers.py)."""
    unit: Annotated[float, Range(1e-9, 1e9)] = 1.0
    """Factor of all positions; published constants (near plane 0.2, limits of scales) expect scenes of a few units."""
    fill: Annotated[int, Range(0, 10**8)] = 0
    """Points that are added where training views have none (gsx.scenes.filling)."""
    stereo: Annotated[int, Range(0, 10**8)] = 0
    """Points that are measured by stereo and added (gsx.scenes.stereo)."""
    depth_values: str = "depth"
    """Content of depth maps: depth, which is camera z, or disparity, which is 1 / z."""
    depth_fit: str = "affine"
    """Fit of each depth map on points of the scene: affine (scale and shift) | scale | none."""
    depth_unit: Annotated[float, Range(0, 1e9)] = 0.0
    """Units of the scene's files in a number of a depth map; 0: 0.001 for whole numbers, else 1."""
    disturb: Annotated[dict[str, float], Range(0, 64)] = field(
        default_factory=lambda: {"exposure": 0.0, "shade": 0.0, "pose": 0.0, "blur": 0.0, "covered": 0.0, "some": 1.0}
    )
    """Degradation of training photographs, for research (gsx.experiments.runs.degraded); 0: none."""
    block: str = ""
    """NUMBER/COUNT: train on one of so many blocks of the scene (gsx.scenes.blocks); empty: on all of it."""
    block_margin: Annotated[float, Range(0, 10)] = 0.2
    """Width of the zone around a block's cell whose cameras are used, as a share of its cameras' box."""
    block_share: Share = 0.25
    """Share of the cell's points that a camera outside of that zone must show to be used."""
    cache_gb: Gigabytes = without_effect(default=1.0)
    """Memory for decoded images, in 10^9 bytes; the least recently used ones are dropped."""
    missing: Share = without_effect(default=0.1)
    """Share of the images that may be absent or unreadable; more are refused."""
    masks: str = "auto"
    """Pixels of photographs that count. auto: by the scene's masks (`mask_path` of nerfstudio), else files in a folder
    `masks`; alpha: opaque ones, instead of compositing the rest; none: all pixels (gsx.scenes.masked)."""
    orientation: str = "auto"
    """Use of EXIF's orientation by scene=photos, colmap and transforms (gsx.scenes.orientation). auto: photos and
    cameras are turned upright from the raster of the cameras: the stored one, or the turned one where only that has
    their shape; stored: not at all; turned: cameras are those of turned photos, of any shape."""
    lens: str = "undistort"
    """Use of photos with distortion. undistort: they are resampled to a pinhole's; native: they stay, and are rendered
    through their lens (docs/how-to/lenses.md)."""
    split: str = "every:8"
    """every:K | sharp:K | files:train.txt,test.txt | counts:N_TRAIN,N_TEST | none: train on all, measure nothing
    (gsx.scenes.splits)."""

    def __post_init__(self) -> None:
        for key, words in WORDS.items():
            refuse_other(key, getattr(self, key), words)
        if self.block:
            parsed_block(self.block)
        if len(self.background) != 3:
            raise ConfigError(f"scene.background is {list(self.background)}, give red, green and blue in [0, 1].")


def refuse_other(key: str, word: str, words: Sequence[str]) -> None:
    """Raise ConfigError for a word that is no value of the option."""
    if word not in words:
        raise ConfigError(f"scene.{key} is '{word}', use one of {', '.join(words)}.{nearest(word, words)}")
