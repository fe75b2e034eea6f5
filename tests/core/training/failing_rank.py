"""`gsx` whose process $WHO goes wrong at step 5 in the way of $KIND."""

import os
import signal
import sys

import torch

from gsx.cli.dispatch import main
from gsx.core.errors import InputError
from gsx.core.training import trainer

whole = trainer.view_loss


def broken(run, number, *rest):
    if number == 5 and run.ranks.rank == int(os.environ["WHO"]):
        kind = os.environ["KIND"]
        if kind == "input":
            raise InputError("a photograph cannot be read: mend it")
        if kind == "stop":
            signal.raise_signal(signal.SIGINT)
        if kind == "killed":
            signal.raise_signal(signal.SIGKILL)
        if kind == "drift":
            with torch.no_grad():
                run.backbone.table["means"][0] += 1
    return whole(run, number, *rest)


def fail() -> None:
    """From now on."""
    trainer.view_loss = broken


if __name__ == "__main__":
    fail()
    sys.exit(main())
