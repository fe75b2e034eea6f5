"""What the machine can do at best, measured; and what a rasterizer at least must do, counted."""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gsx.core.shapes import Float
from measuring.watches import Watch, timed

CHAIN = 16
"""Dependent steps of the compiled loops: enough to hide reading and writing."""
FLOAT = 4
"""Bytes."""
JOINED: dict[str, Any] = {"cpp.enable_floating_point_contract_flag": "fast"}
"""Option of the compiler: a x + b is one operation."""

# -- counts --------------------------------------------------------------------------------------------------------

FORWARD_FLOPS = {
    "s = u0 x + u1 y + k0": 4,
    "r = u2 y + k1": 2,
    "log o - s^2 - r^2": 4,
    "min(alpha_max, alpha), alpha >= alpha_min": 2,
    "w = alpha T, T - w": 2,
    "light + w c, three channels and coverage": 8,
}
"""Floating point operations of one alpha evaluation besides its exponential, a multiply-add being two."""
BACKWARD_FLOPS = {
    "alpha and w again": 14,
    "c.g": 8,
    "light behind": 2,
    "slope = w c.g - behind alpha / (1 - alpha)": 5,
    "by s and r": 4,
    "sums over pixels: u0, u1, k0, u2, k1, log o": 9,
    "sums over pixels: three channels and coverage": 8,
}
"""The same of its gradient; the exponential is evaluated again."""


def forward_bytes(splats: int, pairs: int, pixels: int, channels: int = 3) -> int:
    """Least memory traffic of a forward pass that sorts pairs: every value moves once each way between its stages.

    A splat is 11 + C numbers and becomes a record of 6 + C (mean, factor, opacity, channels), written once. A pair is a
    tile and a row, 8 bytes: written, read and written by sorting, read by blending, with its splat's record. A pixel
    is C + 1 numbers, written.
    """
    record = 6 + channels
    return (
        FLOAT * splats * (11 + channels + record) + pairs * (4 * 8 + FLOAT * record) + FLOAT * pixels * (channels + 1)
    )


def backward_bytes(splats: int, pairs: int, pixels: int, channels: int = 3) -> int:
    """The same of the backward pass.

    A pair's row and record are read again, its gradient (6 + C) is written, and read when summed by splat. A splat's
    sums are written and read, its inputs read, their gradients written. A pixel's picture and gradient are read.
    """
    record = 6 + channels
    by_pair = pairs * (4 + 3 * FLOAT * record)
    return by_pair + FLOAT * splats * 2 * (record + 11 + channels) + FLOAT * pixels * 2 * (channels + 1)


# -- measurements --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Limit:
    """A measured rate."""

    name: str
    rate: float
    """Per second."""
    unit: str


@dataclass(frozen=True)
class Sizes:
    """How much the measurements work on."""

    cached: int
    """Numbers that stay in the cache."""
    large: int
    """Numbers that do not."""
    matrix: int
    """Edge of the matrices that are multiplied."""
    seconds: float
    """Time spent on each measurement."""


def sizes_of(device: torch.device, quick: bool) -> Sizes:
    """Enough to fill the device; `quick`: next to nothing."""
    if quick:
        return Sizes(cached=1 << 12, large=1 << 14, matrix=64, seconds=0.01)
    if device.type == "cuda":
        return Sizes(cached=1 << 22, large=1 << 28, matrix=8192, seconds=1.0)
    return Sizes(cached=1 << 18, large=1 << 25, matrix=1536, seconds=1.0)


def best_rate(action: Callable[[], object], amount: float, device: torch.device, seconds: float) -> float:
    """`amount` per second in the fastest of repeated calls: a limit is what the machine does undisturbed."""

    def job(watch: Watch) -> None:
        watch.begin()
        action()
        watch.lap("all")

    timed(job, device)
    begun = time.perf_counter()
    times: list[float] = []
    while time.perf_counter() - begun < seconds or len(times) < 3:
        times.append(timed(job, device)["all"])
    return 1e3 * amount / min(times)


def exponentials(x: Float[Tensor, "E"]) -> Float[Tensor, "E"]:
    """CHAIN exponentials of every element."""
    for _ in range(CHAIN):
        x = torch.exp(-x)
    return x


def multiply_adds(x: Float[Tensor, "E"], a: Float[Tensor, ""], b: Float[Tensor, ""]) -> Float[Tensor, "E"]:
    """Eight independent chains of CHAIN multiply-adds on every element, and their sum."""
    chains = [x + i for i in range(8)]
    for _ in range(CHAIN):
        chains = [chain * a + b for chain in chains]
    return functools.reduce(torch.add, chains)


def measured_limits(device: torch.device, sizes: Sizes, compiler: bool) -> list[Limit]:
    """Rates of exponentials, arithmetic and memory traffic, all in float32 and with torch's current threads."""
    limits = [*library_rates(device, sizes), *bandwidths(device, sizes)]
    return limits + (compiled_rates(device, sizes) if compiler else [])


def library_rates(device: torch.device, sizes: Sizes) -> list[Limit]:
    """Of torch's own kernels."""
    n, m = sizes.cached, sizes.matrix
    x, y, z = (torch.rand(n, device=device) for _ in range(3))
    wide, out = torch.rand(sizes.large, device=device), torch.empty(sizes.large, device=device)
    left, right = torch.rand(m, m, device=device), torch.rand(m, m, device=device)

    def rate(action: Callable[[], object], amount: float) -> float:
        return best_rate(action, amount, device, sizes.seconds)

    return [
        Limit("exp, in cache", rate(lambda: torch.exp(x, out=y), n), "exp/s"),
        Limit("exp, from memory", rate(lambda: torch.exp(wide, out=out), sizes.large), "exp/s"),
        Limit("addcmul, in cache", rate(lambda: torch.addcmul(z, x, y, out=z), 2 * n), "flop/s"),
        Limit("matrix product", rate(lambda: left @ right, 2 * m**3), "flop/s"),
    ]


def bandwidths(device: torch.device, sizes: Sizes) -> list[Limit]:
    """Of memory, bytes read and written; what a write may first read is not counted."""
    n = sizes.large
    a, b, c = (torch.rand(n, device=device) for _ in range(3))

    def rate(action: Callable[[], object], arrays: int) -> float:
        return best_rate(action, FLOAT * arrays * n, device, sizes.seconds)

    return [
        Limit("copy", rate(lambda: a.copy_(b), 2), "B/s"),
        Limit("triad a = b + s c", rate(lambda: torch.add(b, c, alpha=0.5, out=a), 3), "B/s"),
    ]


def compiled_rates(device: torch.device, sizes: Sizes) -> list[Limit]:
    """Of loops that torch.compile makes, with multiply and add joined where the processor can."""
    n = sizes.large // CHAIN
    x, a, b = torch.rand(n, device=device), torch.tensor(0.99, device=device), torch.tensor(0.01, device=device)
    exp, fma = (torch.compile(loop, options=JOINED) for loop in (exponentials, multiply_adds))
    flops = 2 * 8 * CHAIN * n
    return [
        Limit("exp, compiled", best_rate(lambda: exp(x), CHAIN * n, device, sizes.seconds), "exp/s"),
        Limit("multiply-add, compiled", best_rate(lambda: fma(x, a, b), flops, device, sizes.seconds), "flop/s"),
    ]


def best(limits: list[Limit], unit: str) -> float:
    """The highest rate in a unit."""
    return max(limit.rate for limit in limits if limit.unit == unit)


def evaluation_limit(limits: list[Limit], flops: int) -> float:
    """Alpha evaluations per second if each costs one exponential and then `flops`, at the best measured rates."""
    return 1 / (1 / best(limits, "exp/s") + flops / best(limits, "flop/s"))
