"""How long the threads of a loop wait for each other before they give up their core."""

import os

SPINS = "GOMP_SPINCOUNT"
"""GNU OpenMP's turns of waiting, by default 300,000: several times as long as a scheduler lets anyone wait."""
TURNS = "2000"
"""Ours (benchmarks/shared_cores.py)."""
CHOSEN = (SPINS, "OMP_WAIT_POLICY")
"""Variables by which users choose for themselves."""


def wait_briefly() -> None:
    """For the rest of this process, and for those that it starts; before torch is imported, which reads it.

    A training step has hundreds of short loops, and each ends when all of its threads have. Where another program wants
    one of the cores, a thread that waits keeps it from the one it waits for.
    """
    if not any(name in os.environ for name in CHOSEN):
        os.environ[SPINS] = TURNS
