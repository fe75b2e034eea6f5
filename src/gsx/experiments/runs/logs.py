"""Output of gsx's log: on standard error, and in a run's log.txt."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsx.engine.processes import speaks


class Plain(logging.Formatter):
    """Messages as they are; warnings and errors with their level."""

    def format(self, record: logging.LogRecord) -> str:
        """Return a message in one line."""
        mark = f"{record.levelname.lower()}: " if record.levelno > logging.INFO else ""
        return mark + record.getMessage()


def set_up_logging() -> None:
    """Show plain messages of gsx on standard error."""
    root = logging.getLogger("gsx")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.handlers = [tolerant(logging.StreamHandler(sys.stderr), Plain())] if speaks() else [logging.NullHandler()]


@contextmanager
def logged_to(folder: Path) -> Iterator[None]:
    """Also write messages to the run's log.txt."""
    if not speaks():
        yield
        return
    file = logging.FileHandler(folder / "log.txt", encoding="utf-8", errors="backslashreplace")
    handler = tolerant(file, logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
    root = logging.getLogger("gsx")
    if root.level == logging.NOTSET:  # called from Python without set_up_logging
        root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()


@contextmanager
def quiet(level: int = logging.INFO) -> Iterator[None]:
    """Hold back messages up to a level inside the context."""
    before = logging.root.manager.disable
    logging.disable(max(before, level))
    try:
        yield
    finally:
        logging.disable(before)


def tolerant(handler: logging.Handler, formatter: logging.Formatter) -> logging.Handler:
    """Return the handler; it ignores a full disk or a closed terminal, which raise errors elsewhere."""
    handler.setFormatter(formatter)
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    return handler
