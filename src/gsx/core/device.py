"""What computes."""

import functools
import platform
import time
from pathlib import Path

import torch
from torch import Tensor

PROCESSORS = Path("/proc/cpuinfo")
"""Where Linux says which processors there are."""
OF_ITS_KIND = ("vendor_id", "cpu family", "model", "model name", "flags", "CPU implementer", "CPU part", "Features")
"""Of what is said there: what does not change from moment to moment, on x86 and on ARM."""


def device_name(device: torch.device) -> str:
    """Name of a GPU, or of the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return told_of_processor().get("model name") or platform.processor() or platform.machine()


@functools.cache
def told_of_processor() -> dict[str, str]:
    """What the system says of the first processor, by name; nothing where it is not Linux."""
    try:
        first = PROCESSORS.read_text(errors="replace").split("\n\n")[0]
    except OSError:
        return {}
    pairs = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}


def processor_kind() -> tuple[str, ...]:
    """What code that is compiled for this processor is for: on others it may hold instructions that they lack."""
    told = told_of_processor()
    return platform.machine(), platform.processor(), *(told.get(name, "") for name in OF_ITS_KIND)


def uploaded(values: Tensor, device: torch.device, dtype: torch.dtype | None = None) -> Tensor:
    """The values on a device, without waiting for what it is doing; differentiable.

    Copies to a GPU that nobody waits for have to come from memory that is pinned.
    """
    if device.type == "cuda" and values.device.type == "cpu" and not values.requires_grad:
        values = values.pin_memory()
    return values.to(device, dtype or values.dtype, non_blocking=True)


def clock(device: torch.device) -> float:
    """Seconds, after the device has done all it was asked to."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def machine_stamp(device: torch.device) -> tuple[object, ...]:
    """What decides, beside code and settings, on the last bits of a result: torch, threads, device."""
    kind = device_name(device) if device.type == "cuda" else processor_kind()
    return torch.__version__, torch.get_num_threads(), kind


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether a device has units for matrix products of bfloat16, which are faster than those of float32."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    told: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # nothing where torch cannot tell
    return device.type == "cpu" and any(told.get(name, False) for name in ("amx_bf16", "avx512_bf16"))
