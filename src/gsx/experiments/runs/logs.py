"""Messages of gsx's log for people: on standard error, and in a run's log.txt."""

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsx.engine.processes import speaks


class Plain(logging.Formatter):
    """Messages as they are, warnings marked."""

    def format(self, record: logging.LogRecord) -> str:
        """Returns a message in one line."""
        mark = f"{record.levelname.lower()}: " if record.levelno > logging.INFO else ""
        return mark + record.getMessage()


def set_up_logging() -> None:
    """Shows plain messages of gsx on standard error."""
    root = logging.getLogger("gsx")
    root.setLevel(logging.INFO)
    root.propagate = False
    root.handlers = [quiet(logging.StreamHandler(sys.stderr), Plain())] if speaks() else [logging.NullHandler()]


@contextmanager
def logged_to(folder: Path) -> Iterator[None]:
    """Also writes messages to the run's log.txt."""
    if not speaks():
        yield
        return
    handler = quiet(
        logging.FileHandler(folder / "log.txt", encoding="utf-8", errors="backslashreplace"),
        logging.Formatter("%(asctime)s %(levelname)s %(message)s"),
    )
    root = logging.getLogger("gsx")
    if root.level == logging.NOTSET:  # from Python, where nobody has set up messages
        root.setLevel(logging.INFO)
    root.addHandler(handler)
    try:
        yield
    finally:
        root.removeHandler(handler)
        handler.close()


def quiet(handler: logging.Handler, formatter: logging.Formatter) -> logging.Handler:
    """Returns a handler that says nothing of a full disk or a closed terminal: an error elsewhere does."""
    handler.setFormatter(formatter)
    handler.handleError = lambda record: None  # type: ignore[method-assign]
    return handler
