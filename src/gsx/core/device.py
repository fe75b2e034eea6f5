"""Copies to a device, and its clock."""

import time

import torch
from torch import Tensor


def upload(values: Tensor, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Copies values to a device without waiting for it; differentiable."""
    if device.type == "cuda" and values.device.type == "cpu" and not values.requires_grad:
        values = values.pin_memory()  # asynchronous copies need pinned memory
    return values.to(device, dtype or values.dtype, non_blocking=True)


def clock(device: torch.device) -> float:
    """Waits for the device and returns seconds."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
