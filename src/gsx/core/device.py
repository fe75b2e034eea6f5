"""Copies to a device, and time on it."""

import time

import torch
from torch import Tensor


def uploaded(values: Tensor, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """Returns the values on a device, without waiting for what it is doing; differentiable."""
    if device.type == "cuda" and values.device.type == "cpu" and not values.requires_grad:
        values = values.pin_memory()  # copies that nobody waits for come from pinned memory
    return values.to(device, dtype or values.dtype, non_blocking=True)


def clock(device: torch.device) -> float:
    """Returns seconds, after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
