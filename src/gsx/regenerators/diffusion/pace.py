"""How far long work is."""

import logging
import time

logger = logging.getLogger(__name__)

PATIENCE = 10.0
"""Seconds between two lines of progress."""


class Pace:
    """Says how far a batch of work is, and how long it will take."""

    def __init__(self, name: str, whole: int) -> None:
        self.name, self.whole, self.done = name, whole, 0
        self.begun = self.told = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Since the work began."""
        return time.perf_counter() - self.begun

    def more(self, count: int) -> None:
        """So many more are done."""
        self.done += count
        now = time.perf_counter()
        if now - self.told > PATIENCE and self.done < self.whole:
            each = (now - self.begun) / self.done
            left = each * (self.whole - self.done)
            logger.info("%s: %d of %d, %.1f s each, %.0f s left", self.name, self.done, self.whole, each, left)
            self.told = now
