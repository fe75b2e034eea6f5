"""Processor and GPU: names, and stamps of all that compiled code and the last bits of results depend on."""

import functools
import platform
from pathlib import Path

import torch

PROCESSORS = Path("/proc/cpuinfo")
"""Linux describes its processors there."""
OF_ITS_KIND = ("vendor_id", "cpu family", "model", "model name", "flags", "CPU implementer", "CPU part", "Features")
"""Fields of that description that stay the same from moment to moment, on x86 and on ARM."""


def device_name(device: torch.device) -> str:
    """Names a GPU, or the processor."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return processor_fields().get("model name") or platform.processor() or platform.machine()


@functools.cache
def processor_fields() -> dict[str, str]:
    """Reads Linux's description of the first processor, by field; empty on other systems."""
    try:
        first = PROCESSORS.read_text(errors="replace").split("\n\n")[0]
    except OSError:
        return {}
    pairs = (line.partition(":") for line in first.splitlines())
    return {name.strip(): value.strip() for name, _, value in pairs}


def processor_kind() -> tuple[str, ...]:
    """Identifies the processors that run code compiled on this one; others may lack its instructions."""
    fields = processor_fields()
    return platform.machine(), platform.processor(), *(fields.get(name, "") for name in OF_ITS_KIND)


def machine_stamp(device: torch.device) -> tuple[object, ...]:
    """Identifies torch, threads and device: besides code and settings, the last bits of a result depend on them."""
    kind = device_name(device) if device.type == "cuda" else processor_kind()
    return torch.__version__, torch.get_num_threads(), kind


def multiplies_bfloat16(device: torch.device) -> bool:
    """Checks whether a device has units for matrix products of bfloat16, which are faster than those of float32."""
    if device.type == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    abilities: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # empty: unknown
    return device.type == "cpu" and any(abilities.get(name, False) for name in ("amx_bf16", "avx512_bf16"))
