"""What computes."""

import platform

import torch


def device_name(device: torch.device) -> str:
    """Name of a GPU, or of the processor."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()


def machine_stamp(device: torch.device) -> tuple[str, int, str]:
    """What decides, beside code and settings, on the last bits of a result: torch, threads, device."""
    return torch.__version__, torch.get_num_threads(), device_name(device)
