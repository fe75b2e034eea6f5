"""Places of COLMAP models in the folders that programs write, their files, and the places of their photos."""

import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path

from gsx.core.errors import InputError
from gsx.scenes.colmap_records import U64
from gsx.scenes.colmap_text import count_text_images

REQUIRED = ("cameras", "images", "points3D")
OPTIONAL = ("rigs", "frames")
"""Both or none; by COLMAP 4 they hold the poses."""
SUFFIXES = (".bin", ".txt")  # binary first, as 3D-GS
AUTO = "auto"  # value of scene.model: search

PLACES = {
    "sparse", "colmap", "glomap", "hloc", "sfm", "dense", "distorted", "undistorted", "model", "models", "output",
    "outputs", "reconstruction", "reconstructions", "triangulated", "export", "poses",
}  # fmt: skip
"""First or last words of folders in which COLMAP, INRIA's convert.py, hloc, GLOMAP, instant-ngp and nerfstudio keep
models."""
DEPTH = 4  # levels below a scene's folder: `dense/0/sparse/0`
UNUSUAL_DEPTH = 3  # levels below a folder of photos at which a model under any name is noticed
MOST_FOLDERS = 1000  # folders visited in such a search


# -- files of one model ------------------------------------------------------------------------------------------------


def model_files(folder: Path) -> dict[str, Path]:
    """Return the files of a model by content: binary where all are there, else text. Case is ignored.

    `points3D` is a PLY where there is no other file of points: 3D-GS reads scenes without it.

    Raises:
        InputError: a file is missing.
    """
    kinds = [_of_kind(folder, suffix) for suffix in SUFFIXES]
    files = next((found for found in kinds if set(REQUIRED) <= found.keys()), None) or max(kinds, key=len)
    ply = _listing(folder).get("points3d.ply")
    if "points3D" not in files and set(files) >= {"cameras", "images"} and ply is not None:
        files["points3D"] = ply
    suffix = next((file.suffix for file in files.values()), SUFFIXES[0])
    if lacking := [f"{name}{suffix}" for name in REQUIRED if name not in files]:
        other = [file.name for kind in SUFFIXES if kind != suffix for file in _of_kind(folder, kind).values()]
        mixed = f" ({', '.join(other)}: one model has files of one kind)" if other else ""
        raise InputError(
            f"The COLMAP model {folder} lacks {' and '.join(lacking)}{mixed}: copy the whole model folder again."
        )
    if len(optional := [name for name in OPTIONAL if name in files]) == 1:
        present, (absent,) = files[optional[0]].name, set(OPTIONAL) - set(optional)
        raise InputError(
            f"The COLMAP model {folder} has {present} and lacks {absent}{suffix}: copy that as well, or remove "
            f"{present} to use the poses in {files['images'].name}."
        )
    return files


def _of_kind(folder: Path, suffix: str) -> dict[str, Path]:
    """Return the files of a model with that suffix, by content."""
    names = _listing(folder)
    found = {name: names.get(f"{name}{suffix}".lower()) for name in (*REQUIRED, *OPTIONAL)}
    return {name: file for name, file in found.items() if file is not None}


def _listing(folder: Path) -> dict[str, Path]:
    """Return a model's files by name in lower case; of two that differ by case COLMAP's own comes first."""
    usual = {f"{name}{suffix}" for name in (*REQUIRED, *OPTIONAL) for suffix in (*SUFFIXES, ".ply")}
    known = {name.lower() for name in usual}
    found: dict[str, Path] = {}
    with suppress(OSError):
        present = [path for path in folder.iterdir() if path.name.lower() in known and path.is_file()]
        for path in sorted(present, key=lambda path: (path.name not in usual, path.name)):
            found.setdefault(path.name.lower(), path)
    return found


def count_images(folder: Path) -> int:
    """Return the number of images of a model, from the head of images.bin or the lines of images.txt."""
    file = model_files(folder)["images"]
    if file.suffix.lower() == ".txt":
        return count_text_images(file)
    with file.open("rb") as stream:
        head = stream.read(U64.size)
    return int(U64.unpack(head)[0]) if len(head) == U64.size else 0


# -- folders -----------------------------------------------------------------------------------------------------------


def find_model(path: Path, name: str = AUTO) -> tuple[Path, list[str]]:
    """Return the model folder `name`, or by `auto` that with the most images, and a note; InputError: none is whole."""
    if name != AUTO and not holds_model(path / name, 1):
        raise InputError(f"scene.model '{name}' is no folder with a COLMAP model in {path}: correct or omit it.")
    if name != AUTO:
        return path / name, []
    folders, counts = model_folders(path) or other_model_folders(path), dict[Path, int]()
    if not folders:
        raise InputError(
            f"No COLMAP model (cameras.bin or cameras.txt) in {path / 'sparse' / '0'}, {path / 'sparse'} or {path}: "
            "scene.path must be the folder that holds sparse/ and images/ (photos only: use scene=photos)."
        )
    for folder in folders:
        try:
            counts[folder] = count_images(folder)
        except InputError as problem:
            others = " or ".join(place(path, other) for other in folders if other != folder)
            raise InputError(f"{problem}{f' Or choose another model: scene.model={others}.' * bool(others)}") from None
    best = max(counts, key=lambda folder: counts[folder])  # max keeps the first of equals
    return best, [*_choice_note(path, best, counts)]


def _choice_note(path: Path, best: Path, counts: Mapping[Path, int]) -> Iterator[str]:
    """Yield a note where there was a choice of models, or the place is unusual."""
    elsewhere: dict[Path, int] = {}
    for folder in other_model_folders(path):
        with suppress(InputError):
            elsewhere[folder] = count_images(folder)
    larger = {folder: count for folder, count in elsewhere.items() if count > counts[best] and best not in elsewhere}
    others = {folder: count for folder, count in {**counts, **larger}.items() if folder != best}
    used = f"Took the model {place(path, best)} with {counts[best]} images"
    if others:
        unused = ", ".join(f"{place(path, folder)} ({count})" for folder, count in others.items())
        yield f"{used}; not used, with images: {unused} (scene.model chooses)."
    elif best not in model_folders(path):
        yield f"{used}."


def place(path: Path, folder: Path) -> str:
    """Return the name of a model folder relative to its scene's."""
    return folder.relative_to(path).as_posix()


def model_folders(path: Path) -> list[Path]:
    """Return the folders of models where 3D-GS has them: `sparse/*` in order of name, `sparse`, `path` itself."""
    sparse = [folder for folder in _inner(path) if folder.name.lower() == "sparse"]
    inner = [folder for outer in sparse for folder in _inner(outer)]
    return [folder for folder in (*inner, *sparse) if holds_model(folder, 1)] + ([path] if holds_model(path) else [])


def other_model_folders(path: Path) -> list[Path]:
    """Return the folders of models in the other places where programs have them, the nearest first."""
    known = model_folders(path)
    return [folder for folder in _search(path, DEPTH, _may_hold_model) if folder not in known]


def unusual_model_folders(path: Path) -> list[Path]:
    """Return the folders of models below a folder, under any name."""
    return _search(path, UNUSUAL_DEPTH, lambda folder, depth: True)


def _search(path: Path, levels: int, enter: Callable[[Path, int], bool]) -> list[Path]:
    """Return folders of models below `path`, level by level, inside of those that `enter` accepts."""
    found, level, left = list[Path](), [path], MOST_FOLDERS
    for depth in range(levels):
        level = [inner for folder in level for inner in _inner(folder) if enter(inner, depth)][:left]
        left -= len(level)
        found += [folder for folder in level if holds_model(folder)]
    return found


def _may_hold_model(folder: Path, depth: int) -> bool:
    """Recognise a folder by its name; a number by its files, where it may be another scene's."""
    words = re.findall(r"[a-z]+", folder.name.lower())
    if not words:
        return folder.name.isdecimal() and (depth > 0 or holds_model(folder))
    return bool({words[0], words[-1]} & PLACES)


def _inner(folder: Path) -> list[Path]:
    """Return folders inside of a folder that are not hidden, in order of name; none where it cannot be read."""
    with suppress(OSError):
        return sorted(inner for inner in folder.iterdir() if not inner.name.startswith(".") and inner.is_dir())
    return []


def holds_model(folder: Path, texts: int = 2) -> bool:
    """Recognise a model, perhaps an incomplete one: a binary file, cameras.txt, or this many text files."""
    binary, text = ([name for name in _of_kind(folder, suffix) if name in REQUIRED] for suffix in SUFFIXES)
    return bool(binary) or "cameras" in text or len(text) >= texts


# -- photos ------------------------------------------------------------------------------------------------------------


def photo_folders(path: Path, model: Path) -> list[Path]:
    """Return folders that may hold the photos of a model, the likeliest first: near the model, then near `path`.

    The model of INRIA's `distorted` is that of the photos in `input`; `images` holds undistorted ones.
    """
    inner = Path(os.path.relpath(model, path)).parts
    bases = [Path(path, *inner[:count]) for count in range(len(inner) + 1)] if ".." not in inner else [path]
    usual = ("input", "images") if "distorted" in inner else ("images", "input")
    found: list[Path] = []
    for base in reversed(bases):
        named = [base / name for name in usual if (base / name).is_dir()]
        others = [folder for folder in _inner(base) if folder not in named]
        found += [*named, *others, *(one / "images" for one in others if (one / "images").is_dir()), base]
    return list(dict.fromkeys(found))


def photo_folders_above(path: Path, model: Path) -> list[Path]:
    """Return such folders where `path` is the folder of a model, or of numbered ones, itself."""
    itself = model == path or (model.parent == path and model.name.isdecimal())
    return [Path(path, *[".."] * up, name) for up in (1, 2, 3) for name in ("images", "input")] if itself else []
