"""Models near photos: gsx reconstructs such photos again only if the user says so."""

import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from gsx.core.errors import InputError
from gsx.scenes.colmap_folders import count_images, model_folders, place, unusual_model_folders

logger = logging.getLogger(__name__)

FOREIGN = {
    "poses_bounds.npy": "poses of LLFF",
    "cameras.xml": "cameras of Metashape",
    "cameras.sfm": "cameras of Meshroom",
    "sfm_data.json": "cameras of OpenMVG",
    "reconstruction.json": "cameras of OpenSfM",
    "bundle.out": "cameras of Bundler",
    "*.nvm": "cameras of VisualSFM",
    "corrected_cameras/*.json": "cameras of Polycam",
    "cameras/*.json": "cameras of Polycam",
}
"""Files with poses that gsx does not read, as patterns below a folder."""


def refuse_passed_over(path: Path) -> Mapping[str, str]:
    """Return no options for a folder of photos, after a warning for poses near it that are not used.

    Raises:
        InputError: a COLMAP model or a transforms.json lies below the folder.
    """
    if found := [*_models_below(path), *_transforms_below(path)]:
        raise InputError(
            f"{path} holds photos, and {found[0]}; to reconstruct the photos again: scene=photos scene.path={path}."
        )
    for sentence in (*_foreign(path), *_models_above(path)):
        logger.warning("%s", sentence)
    return {}


def _models_below(path: Path) -> Iterator[str]:
    for folder in unusual_model_folders(path):
        name, count = place(path, folder), ""
        with suppress(InputError):
            count = f" ({count_images(folder)} images)"
        yield f"a COLMAP model in {name}{count}: train from it by scene=colmap scene.path={path} scene.model={name}"


def _transforms_below(path: Path) -> Iterator[str]:
    for file in sorted(path.glob("*/transforms*.json")):
        yield f"poses in {place(path, file)}: train from them by gsx {file.parent}"


def _foreign(path: Path) -> Iterator[str]:
    for pattern, meaning in FOREIGN.items():
        for file in sorted(path.glob(pattern))[:1]:
            yield (
                f"{file} holds {meaning}, which gsx does not read: photos are reconstructed again. Export a COLMAP "
                "model to use them."
            )


def _models_above(path: Path) -> Iterator[str]:
    above = path / ".."
    if model_folders(above) or (above / "transforms.json").is_file():
        yield f"{path.resolve().parent} has poses of photos, which are not used here: gsx {path.resolve().parent} does."
