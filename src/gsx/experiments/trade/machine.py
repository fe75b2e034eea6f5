"""Where something was timed: times hold for nothing else."""

import os
import platform
from typing import Any

import torch


def machine(device: torch.device) -> dict[str, Any]:
    """The device and what runs on it."""
    cuda = device.type == "cuda"
    return {
        "platform": platform.platform(),
        "device": torch.cuda.get_device_name(device) if cuda else platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
    }
