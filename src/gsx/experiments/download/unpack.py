"""Folders of scenes out of ZIP archives: whole or not at all, and never outside of their place."""

import shutil
import stat
import zipfile
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from gsx.core.errors import InputError
from gsx.experiments.download.receive import refuse_small_disk
from gsx.experiments.prepare.whole_folder import whole_folder
from gsx.experiments.runs.progress import Countdown


def unpack_scene(archive: Path, scene: str, needs: Sequence[str], to: Path) -> None:
    """Unpack the folder of a scene to `to`, which must not exist or be empty.

    Args:
        needs: Files and folders that the scene's folder holds.

    Raises:
        InputError: the archive is damaged, has no such folder, or holds a path that leaves it or a link.
        OSError: the disk is full.
    """
    try:
        with zipfile.ZipFile(archive) as opened:
            for member in opened.infolist():
                refuse_unsafe(member, archive)
            inside = folder_inside(opened.namelist(), scene, needs, archive)
            members = [m for m in opened.infolist() if m.filename.startswith(inside) and not m.is_dir()]
            to.parent.mkdir(parents=True, exist_ok=True)
            refuse_small_disk(to.parent, sum(member.file_size for member in members), scene)
            with whole_folder(to) as folder:
                extract(opened, members, inside, folder)
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError) as error:
        raise InputError(
            f"{archive} is damaged or encrypted ({error}): delete it and its .sha256, fetch it again"
        ) from None


def extract(archive: zipfile.ZipFile, members: Sequence[zipfile.ZipInfo], inside: str, folder: Path) -> None:
    """Write members below `inside` to a folder."""
    progress = Countdown("unpacking", max(1, sum(member.file_size for member in members)))
    for member in members:
        path = folder / member.filename.removeprefix(inside)
        path.parent.mkdir(parents=True, exist_ok=True)
        with archive.open(member) as source, path.open("wb") as target:
            shutil.copyfileobj(source, target)
        progress.advance(member.file_size, path.name)


def refuse_unsafe(member: zipfile.ZipInfo, archive: Path) -> None:
    """Raise InputError for a member that leaves the folder, on any system, or that is no file or folder."""
    name = member.filename
    windows = PureWindowsPath(name)
    leaves = ".." in windows.parts or windows.drive or windows.root or "\\" in name
    kind = stat.S_IFMT(member.external_attr >> 16)
    if leaves or kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        reason = "leaves its folder" if leaves else "is a link or a device"
        raise InputError(f"{archive}: '{name}' {reason}: nothing is unpacked. Ask its authors for another archive")


def folder_inside(names: Sequence[str], scene: str, needs: Sequence[str], archive: Path) -> str:
    """Return the uppermost folder with a scene's name and files, with a slash at its end."""
    parts = [PurePosixPath(name).parts for name in names]
    places = {"/".join(p[: i + 1]) + "/" for p in parts for i, part in enumerate(p[:-1]) if part == scene}
    for place in sorted(places, key=lambda each: each.count("/")):
        if all(any(name == place + need or name.startswith(f"{place}{need}/") for name in names) for need in needs):
            return place
    raise InputError(
        f"{archive} holds no folder '{scene}' with {', '.join(needs)}: "
        "its authors may have changed it, unpack it by hand"
    )
