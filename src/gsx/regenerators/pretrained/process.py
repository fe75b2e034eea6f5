"""Pretrained networks in a process of their own: the side of the process that trains."""

import os
import subprocess
import sys
import weakref
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from gsx.core.errors import InputError
from gsx.regenerators.pretrained.tiles import Picture
from gsx.regenerators.pretrained.worker import Message, receive, send

PROGRAM = "from gsx.regenerators.pretrained.worker import serve; serve()"
PATIENCE = 1.0
"""Time for a process to end by itself, s."""


class NetworkProcess:
    """A process that runs networks; it is started by the first picture and ends with this object or process."""

    def __init__(self, vulkan: bool) -> None:
        self.vulkan = vulkan
        self.process: subprocess.Popen[bytes] | None = None

    def run(self, file: Path, image: Picture) -> Picture:
        """Runs the network of a file on a picture.

        Raises:
            InputError: the file is no network, or its library fails or ends the process.
        """
        request = {"file": str(file), "threads": torch.get_num_threads(), "vulkan": self.vulkan}
        reply = self.exchange(self.process or self.start(), request, image)
        if reply is None:
            raise InputError(self.obituary(file))
        fields, result = reply
        if "error" in fields:
            raise InputError(f"{file}: {fields['error']}")
        return result

    def exchange(self, process: subprocess.Popen[bytes], request: dict[str, Any], image: Picture) -> Message | None:
        """Sends a request and returns its reply; None: the process has ended."""
        try:
            with suppress(BrokenPipeError):
                send(process.stdin, request, image)  # type: ignore[arg-type]
                return receive(process.stdout)  # type: ignore[arg-type]
        except BaseException:  # an interruption: the next reply would be that of this request
            self.process = None
            end(process)
            raise
        return None

    def start(self) -> subprocess.Popen[bytes]:
        """Starts the process; it runs in a session of its own, as Ctrl-C is for this one alone."""
        quiet = {} if os.environ.get("GSX_DEBUG") else {"stderr": subprocess.DEVNULL}
        process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            **quiet,  # type: ignore[call-overload]
        )
        self.process = process
        weakref.finalize(self, end, process)
        return process

    def obituary(self, file: Path) -> str:
        """Describes how the process ended, and forgets it."""
        assert self.process is not None
        code = end(self.process)
        self.process = None
        return (
            f"{file}: the library that runs it ended unexpectedly (exit code {code}). Give another network, or a "
            "smaller tile if memory is short."
        )


def end(process: subprocess.Popen[bytes]) -> int:
    """Closes the input of a process, which ends it between two pictures, and returns its exit code."""
    with suppress(OSError):
        process.stdin.close()  # type: ignore[union-attr]
    process.stdout.close()  # type: ignore[union-attr]
    try:
        return process.wait(PATIENCE)
    except subprocess.TimeoutExpired:  # within a picture, which may take minutes
        process.kill()
        return process.wait()
