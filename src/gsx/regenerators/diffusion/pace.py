"""Progress of long work in the log."""

import logging
import time

logger = logging.getLogger(__name__)

LOG_SECONDS = 10.0  # between two lines of progress


class Pace:
    """Progress of a batch of work, with an estimate of the time that is left."""

    def __init__(self, name: str, total: int) -> None:
        self.name, self.total, self.done = name, total, 0
        self.start = self.logged = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds since the work began."""
        return time.perf_counter() - self.start

    def advance(self, count: int) -> None:
        """Count finished work, and log it from time to time."""
        self.done += count
        now = time.perf_counter()
        if now - self.logged > LOG_SECONDS and self.done < self.total:
            each = (now - self.start) / self.done
            left = each * (self.total - self.done)
            logger.info("%s: %d of %d, %.1f s each, %.0f s left", self.name, self.done, self.total, each, left)
            self.logged = now
