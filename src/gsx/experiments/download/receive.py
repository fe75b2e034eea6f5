"""One file from a server. A cut connection continues where it stopped, in this call or in a later one."""

import logging
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from http.client import HTTPException, HTTPResponse
from pathlib import Path
from urllib.error import HTTPError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

from gsx import __version__
from gsx.core.errors import InputError
from gsx.core.files import read_json, write_json
from gsx.experiments.runs.progress import Countdown

logger = logging.getLogger(__name__)

PIECE = 1 << 18
"""Bytes read at a time."""
SILENCE = 30.0
"""Seconds without a byte after which a connection counts as cut."""
PAUSES = (1.0, 3.0, 10.0, 30.0)
"""Seconds before an attempt, by the number of attempts in a row before it that made no progress."""


def amount(size: float) -> str:
    """Return a number of bytes in MB or GB (10^6, 10^9)."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


class Interrupted(InputError):
    """No answer from a server, or one that may be better later."""


@dataclass(frozen=True)
class Offer:
    """A version of a file, and a position in it."""

    url: str
    size: int
    """Bytes of the whole file; -1: unknown."""
    tag: str
    """ETag or time of last change, for If-Range; empty: the server states neither."""
    start: int = 0
    """First byte of a server's answer, or number of bytes that are here."""

    def range(self) -> dict[str, str]:
        """Return the headers that ask for the rest of the file, if it has not changed."""
        if not self.start:
            return {}
        return {"Range": f"bytes={self.start}-"} | ({"If-Range": self.tag} if self.tag else {})


def offer_of(response: HTTPResponse, url: str) -> Offer:
    """Read an answer's headers; InputError: they do not state the size."""
    headers = response.headers
    etag = headers["ETag"] or ""
    tag = (headers["Last-Modified"] or "") if etag.startswith("W/") else etag or headers["Last-Modified"] or ""
    if response.status == 206 and (part := re.fullmatch(r"bytes (\d+)-\d+/(\d+)", headers["Content-Range"] or "")):
        return Offer(url, int(part[2]), tag, int(part[1]))
    if response.status != 200 or not (headers["Content-Length"] or "").isdecimal():
        raise InputError(f"{url}: the server does not state the size of the file: fetch it with a browser")
    return Offer(url, int(headers["Content-Length"]), tag)


def opened(url: str, headers: dict[str, str]) -> HTTPResponse:
    """Send a request; raise Interrupted without an answer, InputError for a refusal."""
    always = {"User-Agent": f"gsx/{__version__}", "Accept-Encoding": "identity"}
    try:
        return urlopen(Request(url, headers=always | headers), timeout=SILENCE)
    except HTTPError as error:
        kind = Interrupted if error.code >= 500 or error.code in (408, 429) else InputError
        raise kind(f"{url}: the server answers {error.code} {error.reason}: the address may have changed") from None
    except (OSError, HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise Interrupted(
            f"{urlsplit(url).hostname} cannot be reached ({reason}): connect this machine to the network and repeat "
            "the command; what was received is kept"
        ) from None


def pieces(response: HTTPResponse) -> Iterator[bytes]:
    """Yield the bytes of an answer until its end, or until the connection is cut."""
    with suppress(OSError, HTTPException):
        while piece := response.read(PIECE):
            yield piece


class Download:
    """A file on its way: `FILE.part` holds its first bytes, `FILE.part.json` the version that they are of."""

    def __init__(self, url: str, file: Path) -> None:
        self.url, self.file = url, file
        self.part = file.with_name(f"{file.name}.part")
        self.state = file.with_name(f"{file.name}.part.json")

    def here(self) -> Offer:
        """Return the version of the bytes that are here, and their number."""
        with suppress(OSError, ValueError, TypeError):
            offer = Offer(**read_json(self.state), start=self.part.stat().st_size)
            if offer.url == self.url:
                return offer
        return Offer(self.url, -1, "")

    def complete(self) -> bool:
        """Return whether all bytes are here."""
        return self.here().start == self.here().size

    def discard(self) -> None:
        """Delete the bytes that are here."""
        self.part.unlink(missing_ok=True)
        self.state.unlink(missing_ok=True)

    def run(self) -> Path:
        """Receive all bytes and return their file, `FILE.part`.

        Raises:
            InputError: no network, a refusal, too little space, or no progress in several attempts.
            OSError: the disk is full. What was received stays for the next call in both cases.
        """
        idle, progress = 0, self.complete() or self.attempt(first=True)
        while not self.complete():
            idle = 0 if progress else idle + 1
            if idle > len(PAUSES):
                raise InputError(
                    f"{self.url}: no progress in {idle} attempts, {amount(self.here().start)} are here: repeat the "
                    "command later, it continues where the server allows it"
                )
            time.sleep(PAUSES[max(0, idle - 1)])
            progress = self.attempt(first=False)
        return self.part

    def attempt(self, first: bool) -> bool:
        """Receive until the end or a cut; return whether that made progress. `first`: raise without an answer."""
        here = self.here()
        try:
            with opened(self.url, here.range()) as response:
                offer = offer_of(response, self.url)
                if offer in (here, replace(offer, start=0)):
                    self.write(response, offer, here.start)
                else:
                    self.discard()
        except Interrupted:
            if first:
                raise
            return False
        return offer.start == here.start < self.here().start

    def write(self, response: HTTPResponse, offer: Offer, before: int) -> None:
        """Append an answer to the `before` bytes that are here, or replace them."""
        left, done = offer.size - offer.start, offer.start
        refuse_small_disk(self.file.parent, offer.size - before, self.file.name)
        again = "the server cannot continue, or the file has changed: from the start, " if before > done else ""
        logger.info(
            "%s: %s%s%s", self.file.name, again, amount(offer.size), f", {amount(done)} are here" if done else ""
        )
        progress = Countdown("fetching", left)
        with self.part.open("ab" if done else "wb") as stream:
            write_json(self.state, {"url": offer.url, "size": offer.size, "tag": offer.tag})
            for piece in pieces(response):
                stream.write(piece)
                done += len(piece)
                progress.advance(len(piece), f"{amount(done)} of {amount(offer.size)}")
        progress.line.end()


def refuse_small_disk(folder: Path, size: int, name: str) -> None:
    """Raise InputError if a folder's disk has less free space than `size` bytes."""
    if (free := shutil.disk_usage(folder).free) < size:
        raise InputError(
            f"{name} needs {amount(size)}, {folder} has {amount(free)} free: free some space, or choose --to FOLDER"
        )
