"""The loops of the compiled path, in plain torch: what `torch.compile` turns into one fused loop each.

Every function works on B blocks of K entries and the P pixels of a tile: front to back in L lanes (see lanes.py), by
segments without, where pixels lie side by side. The loop over the K entries is unrolled, but where light is found
alone; sums over a tile's pixels are the only reductions in the others. Rules are constants of the compiled code.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any

import torch
from torch import Tensor

from gsx.core.gaussians.bands import sum_of_products
from gsx.core.shapes import Float, Int
from gsx.engine.compile_cache import flat
from gsx.engine.compiling import WHOLE_LOOPS, compiled_once, with_last

TABLE = 6
"""Columns of a splat's table before its channels: mean x, mean y, u0, u1, u2, ln opacity."""
ROW = 7
"""Columns of a row before its channels: five of its exponent, ln opacity, and where alpha is clamped."""
EXP_DEGREE = 7
"""Degree of the polynomial for exp on a quarter (eighth, ...) of its range: relative error < 3e-7 but for rounding."""
EXP_TOP = 0.02
"""Exponents are at most 0 but for rounding."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Everything that compiled code depends on."""

    tile_size: int
    """Makes the number of pixels a constant of the code."""
    chunk: int
    channels: int
    alpha_min: float
    alpha_max: float
    stop: float
    evaluation: torch.dtype
    absolute: bool
    device: str
    powers: tuple[float, ...]
    """Coefficients of `exp_polynomial`, lowest first."""
    squarings: int

    @property
    def least(self) -> float:
        """ln alpha_min."""
        return math.log(self.alpha_min)


# -- alphas --------------------------------------------------------------------------------------------------------


@functools.lru_cache
def exp_polynomial(least: float) -> tuple[tuple[float, ...], int]:
    """Coefficients of p and a number q of squarings with exp(x) = p(x)^(2^q) on [least, EXP_TOP].

    Least squares of the relative error at Chebyshev nodes, in float64, of x / 2^q, whose powers are of one size: those
    of x are not where alpha_min is tiny. Exponents below `least` are cut off anyway, so no range reduction is needed:
    this is twice as fast as a library's exp.
    """
    low, squarings = least - 0.05, 0
    while (EXP_TOP - low) / 2**squarings > 1.5:
        squarings += 1
    nodes = torch.cos(torch.pi * (torch.arange(64, dtype=torch.float64) + 0.5) / 64)
    x = (low + (EXP_TOP - low) * (nodes + 1) / 2) / 2**squarings
    powers = x[:, None] ** torch.arange(EXP_DEGREE + 1)
    fit = torch.linalg.lstsq(powers / x.exp()[:, None], torch.ones(64, 1, dtype=torch.float64), driver="gelsd")
    return tuple(c / 2.0 ** (squarings * i) for i, c in enumerate(fit.solution[:, 0].tolist())), squarings


def cut_exp(x: Tensor, rules: Rules) -> Tensor:
    """exp(x) where x >= ln alpha_min, else 0."""
    if x.dtype != torch.float32:
        return torch.where(x >= rules.least, torch.exp(x), 0.0)
    *others, highest = rules.powers
    value = highest * x + others[-1]
    for coefficient in reversed(others[:-1]):
        value = value * x + coefficient
    for _ in range(rules.squarings):
        value = value * value
    return torch.where(x >= rules.least, value, 0.0)


def log_alpha(row: Float[Tensor, "F B 1 *L"], x: Float[Tensor, "P *one"], y: Float[Tensor, "P *one"]) -> Tensor:
    """Returns ln alpha of one entry at every pixel, [B P *L]; the columns of a row are those of `make_rows`."""
    u0, u1, k0, u2, k1, log_opacity = row[: ROW - 1]
    s, r = u0 * x + (u1 * y + k0), u2 * y + k1
    return log_opacity - r * r - s * s


def gaussian(row: Tensor, x: Tensor, y: Tensor, rules: Rules) -> Tensor:
    """o exp(-s^2 - r^2), zero below alpha_min, before the clamp at alpha_max; [B P *L]."""
    row, x, y = row.to(rules.evaluation), x.to(rules.evaluation), y.to(rules.evaluation)
    return cut_exp(log_alpha(row, x, y), rules)


def clamped(value: Tensor, row: Float[Tensor, "F B 1 *L"]) -> Tensor:
    """min(value, highest), as a selection: cheaper than a minimum that honours NaN."""
    highest = row[ROW - 1].to(value.dtype)
    return torch.where(value > highest, highest, value)


def passing(
    row: Float[Tensor, "F B 1 *L"], x: Float[Tensor, "P *one"], y: Float[Tensor, "P *one"], rules: Rules
) -> Tensor:
    """1 - alpha of one entry at every pixel, [B P *L]."""
    return 1 - clamped(gaussian(row, x, y, rules), row).to(row.dtype)


def entries(rows: Float[Tensor, "B K F *L"]) -> list[Float[Tensor, "F B 1 *L"]]:
    """The rows of each of the K entries."""
    return list(rows.movedim(0, 2)[:, :, :, None].unbind(0))


# -- loops ---------------------------------------------------------------------------------------------------------


def blended(
    rows: Float[Tensor, "B K F *L"],
    x: Float[Tensor, "P *one"],
    y: Float[Tensor, "P *one"],
    before: Float[Tensor, "B P *L"],
    sums: Sequence[Any],
    rules: Rules,
) -> tuple[Float[Tensor, "B P *L"], list[Tensor]]:
    """(transmittance behind each block, `sums`, numbers or tensors, with what it adds to the channels and, last, the
    coverage).

    Transmittance goes on falling below the stop value, so that a pixel that has ended stays ended.
    """
    t, total = before, list(sums)
    for row in entries(rows):
        alpha = clamped(gaussian(row, x, y, rules), row).to(t.dtype)
        weight = alpha * t
        t = t - weight
        weight = torch.where(t >= rules.stop, weight, 0.0)
        total = [total[c] + weight * row[ROW + c] for c in range(rules.channels)] + [total[-1] + weight]
    return t, total


def blend(
    rows: Float[Tensor, "B K F *L"],
    x: Float[Tensor, "P *one"],
    y: Float[Tensor, "P *one"],
    before: Float[Tensor, "B P *L"],
    after: Float[Tensor, "B P *L"],
    accumulated: list[Float[Tensor, "B P *L"]],
    rules: Rules,
) -> None:
    """Blend one block of every group into `accumulated`, the channels and, last, the coverage.

    `before` is the transmittance in front of the block, `after` receives that behind it.
    """
    t, sums = blended(rows, x, y, before, accumulated, rules)
    after.copy_(t)
    for target, value in zip(accumulated, sums, strict=True):
        target.copy_(value)


def fade(
    rows: Float[Tensor, "B K F *L"], x: Float[Tensor, "P *one"], y: Float[Tensor, "P *one"], rules: Rules
) -> Float[Tensor, "B P *L"]:
    """Share of the light that passes each block, without regard to where pixels end."""
    passed = None
    for row in entries(rows):
        share = passing(row, x, y, rules)
        passed = share if passed is None else passed * share
    assert passed is not None
    return passed


def transmit(
    rows: Float[Tensor, "B K F L"],
    x: Float[Tensor, "P one"],
    y: Float[Tensor, "P one"],
    passed: Float[Tensor, "B P L"],
    rules: Rules,
) -> None:
    """Leave of `passed` what passes one more block of every group. Its entries are not unrolled: light alone depends on
    no order, and code for one of them compiles sooner."""
    row = rows.movedim(2, 0)[..., None, :]  # [F B K 1 L], where others have [F B 1 L] of each entry
    passed.copy_(passed * passing(row, x, y, rules).prod(1))


def seen_from_front(
    lights: Sequence[Float[Tensor, "*B P"]],
    gradient: Sequence[Float[Tensor, "*B P"]],
    before: Float[Tensor, "*B P"],
    rules: Rules,
) -> Float[Tensor, "*B P"]:
    """What shows by `lights`, channels and coverage, as seen from where the transmittance is `before`, weighted by the
    gradient of the picture."""
    shine = sum_of_products(lights, gradient)
    return torch.where(before >= max(rules.stop, torch.finfo(before.dtype).tiny), shine / before, 0.0)


def slopes(
    rows: Float[Tensor, "B K F *L"],
    x: Float[Tensor, "P *one"],
    y: Float[Tensor, "P *one"],
    before: Float[Tensor, "B P *L"],
    behind: Float[Tensor, "B P *L"],
    gradient: list[Float[Tensor, "B P *L"]],
    rules: Rules,
) -> tuple[list[Float[Tensor, "B P *L"]], list[Float[Tensor, "B P *L"]], Float[Tensor, "B P *L"]]:
    """d loss / d ln alpha of each entry at every pixel, the blending weight of each, and what `behind` is in front of
    the block.

    `behind` is the picture behind the block as seen from there, weighted by the gradient; with it the slope is weight
    (channels . gradient - behind): no division, and no difference of large sums. Multiplied front to back, last: the
    compiler makes faster code of that order.
    """
    kept, t = [], before
    for row in entries(rows):
        raw = gaussian(row, x, y, rules).to(t.dtype)
        alpha = clamped(raw, row)
        following = t - alpha * t
        going = following >= rules.stop
        kept.append((row, torch.where(going, raw, 0.0), torch.where(going, alpha, 0.0), t))
        t = following
    gains, rest = [], behind
    for row, _, alpha, _ in reversed(kept):
        shade = gradient[-1]
        for c in range(rules.channels):
            shade = shade + row[ROW + c] * gradient[c]
        gains.append(shade - rest)
        rest = rest + alpha * gains[-1]
    out = [raw * t * gain for (_, raw, _, t), gain in zip(kept, reversed(gains), strict=True)]
    return out, [alpha * t for *_, alpha, t in kept], rest


def sums_of(
    rows: Float[Tensor, "B K F *L"],
    slope: Float[Tensor, "B K P *L"],
    weight: Float[Tensor, "B K P *L"],
    x: Float[Tensor, "P *one"],
    y: Float[Tensor, "P *one"],
    products: Float[Tensor, "3 P *one"],
    gradient: list[Float[Tensor, "B P *L"]],
    rules: Rules,
) -> Float[Tensor, "B K V *L"]:
    """Sums over a tile's pixels of slope d and weight for every entry.

    The V columns: d, d x, d y, d x^2, d x y, d y^2, weight times gradient per channel and, if asked, the absolute
    gradient of the mean per axis.
    """
    sums = [slope.sum(2), *((slope * b).sum(2) for b in (x, y, *products.unbind(0)))]
    sums += [(weight * g[:, None]).sum(2) for g in gradient[:-1]]
    if rules.absolute:
        sums += absolute_moments(rows, slope, x, y)
    return torch.stack(sums, 2)


def gradients(
    rows: Float[Tensor, "B K F *L"],
    x: Float[Tensor, "P *one"],
    y: Float[Tensor, "P *one"],
    products: Float[Tensor, "3 P *one"],
    before: Float[Tensor, "B P *L"],
    behind: Float[Tensor, "B P *L"],
    gradient: list[Float[Tensor, "B P *L"]],
    out: Float[Tensor, "B K *L V"],
    rules: Rules,
) -> None:
    """What `entry_gradients` makes of sums of what `slopes` finds, into `out`; `behind` is moved in front of the
    blocks. All are loops of one call: calls cost, and there are hundreds in a step.

    Slopes and weights lie in one tensor: so the compiler sums both in one loop, and sums in parallel keep a core busy.
    """
    by_entry, weights, rest = slopes(rows, x, y, before, behind, gradient, rules)
    behind.copy_(rest)
    slope, weight = torch.stack([*by_entry, *weights], 1).chunk(2, 1)
    out.copy_(entry_gradients(rows, sums_of(rows, slope, weight, x, y, products, gradient, rules), rules))


def absolute_moments(
    rows: Float[Tensor, "B K F *L"], slope: Float[Tensor, "B K P *L"], x: Tensor, y: Tensor
) -> list[Float[Tensor, "B K *L"]]:
    """Sums over pixels of |d loss / d mean| per axis: minus the slope of ln alpha along x and y."""
    u0, u1, k0, u2, k1 = (column[:, :, None] for column in rows[:, :, :5].unbind(2))
    s, r = u0 * x + u1 * y + k0, u2 * y + k1
    by_x, by_y = 2 * u0 * s, 2 * (u1 * s + u2 * r)
    return [(slope * by_x).abs().sum(2), (slope * by_y).abs().sum(2)]


# -- tables in and out ---------------------------------------------------------------------------------------------


def make_rows(
    table: Float[Tensor, "N F"], places: Int[Tensor, "S K *L"], centre: Float[Tensor, "S 2 1 *L"], rules: Rules
) -> Float[Tensor, "S K F *L"]:
    """Gathers what blending reads of every entry.

    Columns: u0, u1, k0, u2, k1 of ln alpha = ln o - (u0 x + u1 y + k0)^2 - (u2 y + k1)^2 in tile-centred coordinates;
    ln o; the largest alpha; the channels; the mean. `table`: mean x, mean y, u0, u1, u2, ln o, channels of every splat.
    """
    columns = [table[places, f] for f in range(table.shape[1])]
    x, y = columns[0] - centre[:, 0], columns[1] - centre[:, 1]
    u0, u1, u2, log_opacity = columns[2:TABLE]
    highest = rules.alpha_max * (places < table.shape[0] - 1).to(table.dtype)
    k0, k1 = -(u0 * x + u1 * y), -u2 * y
    return torch.stack([u0, u1, k0, u2, k1, log_opacity, highest, *columns[TABLE:], x, y], 2)


def entry_gradients(
    rows: Float[Tensor, "S K F *L"], moments: Float[Tensor, "S K V *L"], rules: Rules
) -> Float[Tensor, "S K *L V"]:
    """Gradient of (mean x, mean y, u0, u1, u2, ln o, channels ...) for every entry from its moments, numbers of an
    entry side by side."""
    columns = rows.unbind(2)
    (x, y), u0, u1, u2 = columns[-2:], columns[0], columns[1], columns[3]
    k0, k1 = -(u0 * x + u1 * y), -u2 * y
    one, mx, my, mxx, mxy, myy, *others = moments.unbind(2)
    by_k0, by_k1 = -2 * (u0 * mx + u1 * my + k0 * one), -2 * (u2 * my + k1 * one)
    by_u0 = -2 * (u0 * mxx + u1 * mxy + k0 * mx) - x * by_k0
    by_u1 = -2 * (u0 * mxy + u1 * myy + k0 * my) - y * by_k0
    by_u2 = -2 * (u2 * myy + k1 * my) - y * by_k1
    return torch.stack([-u0 * by_k0, -u1 * by_k0 - u2 * by_k1, by_u0, by_u1, by_u2, one, *others], -1)


# -- compilation ---------------------------------------------------------------------------------------------------

SHARING = {"transmit": 30, "blend": 30, "gradients": 25}
"""Of the loops over blocks: operations after which the compiler shares an intermediate value instead of repeating it.

Found by trying: other numbers cut a loop into several that talk through memory (`gradients` at 30 or 36: ten times as
slow) or take longer to compile (at 120: twice as long, for code that is no faster).
"""

SHARED_AFTER = 50
"""The same of all others: with more of them slopes by segments find weights twice."""
SUMS = {"gradients", "entry_sums"}
"""Loops whose code differs where absolute gradients are asked for."""
OF_A_TILE = {"x", "y", "products"}
"""Arguments whose number of rows does not vary: that of all others is a number of blocks, splats or tiles."""


def thresholds() -> list[str]:
    """The compiler's options that say when a value is shared: CPUs have one of their own since torch 2.12."""
    names = ("realize_opcount_threshold", "realize_cpu_opcount_threshold")
    return [name for name in names if name in torch._inductor.list_options()]


@dataclass(frozen=True, kw_only=True)
class Kernels:
    """The compiled loops of one set of rules."""

    transmit: Callable[..., None]
    blend: Callable[..., None]
    gradients: Callable[..., None]
    make_rows: Callable[..., Tensor]


@functools.lru_cache
def kernels(rules: Rules) -> Kernels:
    """Compiled loops for these rules; each compiles at its first call, for any number of blocks."""
    loops = (transmit, blend, gradients, make_rows)
    return Kernels(**{loop.__name__: compiled(loop, rules) for loop in loops})


def compiled(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
    """`loop` of these rules through torch.compile."""
    if loop.__name__ not in SUMS:
        rules = replace(rules, absolute=False)
    options: dict[str, Any] = WHOLE_LOOPS | dict.fromkeys(thresholds(), SHARING.get(loop.__name__, SHARED_AFTER))
    # loops over blocks: no conditions on symbols, which are the number of blocks, the same in all arguments, and where
    # in storage a view begins, which enters no code; every other size, dtypes, strides and devices are checked one by
    # one, and 32-bit indices suffice (RasterSettings.compiled_values)
    unchecked = {"SHAPE_ENV"} if loop.__name__ in SHARING else set()
    # what is checked then is not asserted once more by the code itself, which costs a quarter of a call
    options |= {"size_asserts": False}
    names = [name for name in signature(loop).parameters if name != "rules"]

    def varying(arguments: tuple[Tensor | list[Tensor], ...]) -> list[tuple[Tensor, int]]:
        given = flat(value for name, value in zip(names, arguments, strict=True) if name not in OF_A_TILE)
        return [(tensor, 0) for tensor in given]

    return compiled_once(with_last(loop, rules), varying, options, unchecked, fullgraph=True)
