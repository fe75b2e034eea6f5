"""Where something was timed: times hold for nothing else."""

import os
import platform
from typing import Any

import torch

from gsx.engine.machine import device_name


def machine(device: torch.device) -> dict[str, Any]:
    """The device and what runs on it."""
    return {
        "platform": platform.platform(),
        "device": device_name(device),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
