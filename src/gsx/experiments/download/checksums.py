"""SHA-256 of archives: the published one, or the one of the first download on this machine."""

import hashlib
import logging
import os
import zipfile
from pathlib import Path

from gsx.core.errors import InputError
from gsx.core.files import replace_text, sync_folder
from gsx.experiments.download.receive import Download

logger = logging.getLogger(__name__)


def sum_file(file: Path) -> Path:
    """Return the file that keeps an archive's checksum, in the format of `sha256sum`."""
    return file.with_name(f"{file.name}.sha256")


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
    record = sum_file(file)
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
