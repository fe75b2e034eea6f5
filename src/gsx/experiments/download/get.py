"""`gsx datasets --get NAME`: state licence and size, fetch, check, unpack, name the command that trains."""

import hashlib
import logging
import os
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from gsx.core.errors import InputError, command
from gsx.core.files import replace_text, sync_folder
from gsx.experiments.download.receive import Download
from gsx.experiments.download.unpack import unpack_scene
from gsx.experiments.run_folder.claims import held, name_lock
from gsx.experiments.runs.settings import Archive, Dataset
from gsx.experiments.tables.datasets import licence_of, missing, size_of

ARCHIVES = "archives"
"""Folder below data_root for archives and their checksums."""
Due = tuple[Archive, list[str]]
"""An archive, and the scenes to take from it."""


def get(dataset: Dataset, root: Path, scenes: Sequence[str]) -> Iterator[str]:
    """Fetch and unpack the scenes that are not there; yield lines to print, licence and sizes before any request.

    Args:
        root: Folder with the datasets.
        scenes: Scenes of the dataset that are required.

    Raises:
        InputError: a scene is incomplete, has to be fetched by hand, or cannot be fetched.
        OSError: the disk is full.
    """
    lacking = lacking_of(dataset, root, scenes)
    due = due_of(dataset, root / ARCHIVES, lacking)
    by_hand = [scene for scene in lacking if not any(scene in taken for _, taken in due)]
    if by_hand and not due:
        raise InputError(hand_sentence(dataset, root, by_hand))
    yield from announced(dataset, root, due)
    for archive, taken in due:
        file = fetch(archive, root / ARCHIVES)
        for scene in taken:
            unpack_scene(file, scene, dataset.needs, root / dataset.folder / scene)
        yield f"unpacked {', '.join(taken)}; {file} may be deleted"
    if by_hand:
        yield hand_sentence(dataset, root, by_hand)
    first = next(scene for scene in scenes if scene not in by_hand)
    yield command(f"dataset={dataset.name}", f"dataset.scene={first}", f"data_root={root}", "minutes=10")


def announced(dataset: Dataset, root: Path, due: Sequence[Due]) -> Iterator[str]:
    """Yield licence, sizes, addresses and places of what is due, or where the dataset is if nothing is."""
    if not due:
        yield f"{dataset.title}: already here, {root / dataset.folder if dataset.folder else dataset.obtained}"
        return
    yield f"{dataset.title}, {licence_of(asdict(dataset))}"
    for archive, _ in due:
        yield f"  {archive.file}: {size_of(asdict(archive))}, from {archive.url or root / ARCHIVES}"
    yield f"  to {root / ARCHIVES}, scenes to {root / dataset.folder}"


def lacking_of(dataset: Dataset, root: Path, scenes: Sequence[str]) -> list[str]:
    """Return the scenes that are not there; InputError: the folder of one is incomplete."""
    reasons = {scene: missing(asdict(dataset), scene, root) for scene in scenes}
    for scene, reason in reasons.items():
        folder = root / dataset.folder / scene
        if reason and folder.is_dir() and any(folder.iterdir()):
            raise InputError(f"{reason}: delete or rename {folder}, and repeat the command")
    return [scene for scene, reason in reasons.items() if reason]


def due_of(dataset: Dataset, folder: Path, lacking: Sequence[str]) -> list[Due]:
    """Choose archives for scenes, in their order; those without an address count only if they are here."""
    due, left = list[Due](), list(lacking)
    for archive in dataset.archives:
        taken = [scene for scene in left if scene in archive.scenes]
        if taken and (archive.url or (folder / archive.file).is_file()):
            due.append((archive, taken))
            left = [scene for scene in left if scene not in taken]
    return due


def fetch(archive: Archive, folder: Path) -> Path:
    """Return the file of an archive with the right checksum, fetched if it is not there."""
    file = folder / archive.file
    folder.mkdir(parents=True, exist_ok=True)
    with held(name_lock(file), file):
        if file.is_file():
            verify(file, file, archive.sha256)
        else:
            download = Download(archive.url, file)
            download.run()
            accept(download, archive.sha256)
    return file


def hand_sentence(dataset: Dataset, root: Path, scenes: Sequence[str]) -> str:
    """Return where scenes can be had that gsx cannot fetch."""
    files = [archive.file for archive in dataset.archives if not archive.url]
    place = f"{root / ARCHIVES / files[0]}, and repeat the command" if files else f"{root / dataset.folder}/SCENE"
    return f"gsx cannot fetch {', '.join(scenes)} of {dataset.title}. Source: {dataset.obtained}. Put it at {place}"


logger = logging.getLogger(__name__)


def accept(download: Download, published: str) -> None:
    """Give a complete download its name; delete it if it is wrong.

    Raises:
        InputError: it is no ZIP archive, or has another checksum.
    """
    try:
        verify(download.part, download.file, published)
    except InputError:
        download.discard()
        raise
    os.replace(download.part, download.file)
    download.state.unlink(missing_ok=True)
    sync_folder(download.file.parent)


def verify(path: Path, file: Path, published: str) -> None:
    """Compare an archive with the published checksum, else with the recorded one; record it if there is none.

    Args:
        path: The bytes.
        file: Name of the archive; its checksum lies next to it.
        published: SHA-256 in hexadecimal digits; empty: none is published.

    Raises:
        InputError: it is no ZIP archive, or has another checksum.
    """
    if not zipfile.is_zipfile(path):
        raise InputError(f"{file.name} is no ZIP archive: its address may have changed, or it was sent by a login page")
    record = file.with_name(f"{file.name}.sha256")  # as `sha256sum` writes it
    recorded = record.read_text("utf-8").split()[:1] if record.is_file() else []
    with path.open("rb") as stream:
        found = hashlib.file_digest(stream, "sha256").hexdigest()
    expected = published or "".join(recorded)
    if expected and found != expected:
        remedy = "" if published else f". If its authors have replaced it, delete {record}"
        source = "published" if published else "of the first download"
        raise InputError(f"{file.name} has SHA-256 {found}, the one {source} is {expected}: fetch it again{remedy}")
    if not recorded:
        replace_text(record, f"{found}  {file.name}\n")
        note = "as published" if published else "recorded for later downloads, none is published"
        logger.info("%s: SHA-256 %s, %s", file.name, found, note)
