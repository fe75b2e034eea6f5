"""What computes."""

import platform

import torch
from torch import Tensor


def device_name(device: torch.device) -> str:
    """Name of a GPU, or of the processor."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()


def uploaded(values: Tensor, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """The values on a device, without waiting for what it is doing; differentiable.

    Copies to a GPU that nobody waits for have to come from memory that is pinned.
    """
    if device.type == "cuda" and values.device.type == "cpu" and not values.requires_grad:
        values = values.pin_memory()
    return values.to(device, dtype or values.dtype, non_blocking=True)


def machine_stamp(device: torch.device) -> tuple[str, int, str]:
    """What decides, beside code and settings, on the last bits of a result: torch, threads, device."""
    return torch.__version__, torch.get_num_threads(), device_name(device)


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether a device has units for matrix products of bfloat16, which are faster than those of float32."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    told: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # nothing where torch cannot tell
    return device.type == "cpu" and any(told.get(name, False) for name in ("amx_bf16", "avx512_bf16"))
