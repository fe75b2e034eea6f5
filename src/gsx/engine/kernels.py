"""The loops of the compiled path, in plain torch: `torch.compile` turns each into one fused loop.

Every function works on B blocks of K entries and the P pixels of a tile: front to back in L lanes (lanes.py), or
without lanes and with pixels contiguous (segments.py). The loop over the K entries is unrolled, except in `transmit`;
elsewhere sums over a tile's pixels are the only reductions. Rules are constants of the compiled code.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any, TypeAlias

import torch
from torch import Tensor

from gsx.core.gaussians.bands import sum_of_products
from gsx.core.shapes import Float, Int
from gsx.engine.compile_cache import flat
from gsx.engine.compiling import WHOLE_LOOPS, compiled_once, with_last

TABLE = 6
"""Columns of a splat's table before its channels: mean x, mean y, u0, u1, u2, ln opacity."""
ROW = 7
"""Columns of a row before its channels: five of its exponent, ln opacity, and the largest alpha."""
EXP_DEGREE = 7
"""Degree of the polynomial for exp on a quarter (eighth, ...) of its range: relative error < 3e-7 before rounding."""
EXP_TOP = 0.02
"""Upper end of the polynomial's range: exponents exceed 0 by rounding only."""

Rows: TypeAlias = Float[Tensor, "B K F *L"]
"""Columns of every entry, as `make_rows` returns them."""
Entry: TypeAlias = Float[Tensor, "F B 1 *L"]
"""Columns of one entry of every block."""
Axis: TypeAlias = Float[Tensor, "P *one"]
"""One coordinate of a tile's pixels, px from its middle."""
Light: TypeAlias = Float[Tensor, "B P *L"]
"""A number at every pixel of each block."""
Lights: TypeAlias = list[Light]
"""One for each channel, or entry."""
Slopes: TypeAlias = Float[Tensor, "B K P *L"]
"""A number of every entry at every pixel."""
Axes: TypeAlias = Float[Tensor, "3 P *one"]
"""x^2, x y, y^2 of a tile's pixels."""


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Constants of the compiled code."""

    tile_size: int
    """Sets the number of pixels."""
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
    """Returns coefficients of p and a number q of squarings with exp(x) = p(x)^(2^q) on [least, EXP_TOP].

    Least squares of the relative error at Chebyshev nodes, in float64, of x / 2^q: powers of x itself differ too much
    in size where alpha_min is tiny. Exponents below `least` are cut off, so no range reduction is needed: twice as fast
    as a library's exp.
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
    """Returns exp(x) where x >= ln alpha_min, else 0."""
    if x.dtype != torch.float32:
        return torch.where(x >= rules.least, torch.exp(x), 0.0)
    *others, highest = rules.powers
    value = highest * x + others[-1]
    for coefficient in reversed(others[:-1]):
        value = value * x + coefficient
    for _ in range(rules.squarings):
        value = value * value
    return torch.where(x >= rules.least, value, 0.0)


def gaussian(row: Entry, x: Axis, y: Axis, rules: Rules) -> Light:
    """Returns o exp(-s^2 - r^2) of one entry at every pixel, zero below alpha_min, before the clamp at alpha_max."""
    row, x, y = row.to(rules.evaluation), x.to(rules.evaluation), y.to(rules.evaluation)
    u0, u1, k0, u2, k1, log_opacity = row[: ROW - 1]
    s, r = u0 * x + (u1 * y + k0), u2 * y + k1
    return cut_exp(log_opacity - r * r - s * s, rules)


def clamped(value: Light, row: Entry) -> Light:
    """Returns min(value, largest alpha) by a selection: cheaper than a minimum that honours NaN."""
    highest = row[ROW - 1].to(value.dtype)
    return torch.where(value > highest, highest, value)


def passing(row: Entry, x: Axis, y: Axis, rules: Rules) -> Light:
    """Returns 1 - alpha of one entry at every pixel."""
    return 1 - clamped(gaussian(row, x, y, rules), row).to(row.dtype)


def entries(rows: Rows) -> list[Entry]:
    """Splits rows into the K entries."""
    return list(rows.movedim(0, 2)[:, :, :, None].unbind(0))


# -- loops ---------------------------------------------------------------------------------------------------------


def blended(
    rows: Rows, x: Axis, y: Axis, before: Light, sums: Sequence[Any], rules: Rules
) -> tuple[Light, list[Tensor]]:
    """Returns (transmittance behind each block, `sums` plus its channels and, last, its coverage).

    Transmittance keeps falling below the stop value, so that a pixel that has ended stays ended.
    """
    t, total = before, list(sums)
    for row in entries(rows):
        alpha = clamped(gaussian(row, x, y, rules), row).to(t.dtype)
        weight = alpha * t
        t = t - weight
        weight = torch.where(t >= rules.stop, weight, 0.0)
        total = [total[c] + weight * row[ROW + c] for c in range(rules.channels)] + [total[-1] + weight]
    return t, total


def blend(rows: Rows, x: Axis, y: Axis, before: Light, after: Light, accumulated: Lights, rules: Rules) -> None:
    """Blends one block of every group into `accumulated`: the channels and, last, the coverage.

    `before` is the transmittance in front of the block; `after` receives that behind it.
    """
    t, sums = blended(rows, x, y, before, accumulated, rules)
    after.copy_(t)
    for target, value in zip(accumulated, sums, strict=True):
        target.copy_(value)


def fade(rows: Rows, x: Axis, y: Axis, rules: Rules) -> Light:
    """Returns the share of the light that passes each block, regardless of where pixels end."""
    first, *others = entries(rows)
    passed = passing(first, x, y, rules)
    for row in others:
        passed = passed * passing(row, x, y, rules)
    return passed


def transmit(rows: Rows, x: Axis, y: Axis, passed: Light, rules: Rules) -> None:
    """Multiplies `passed` by the transmittance of one more block of every group.

    Its entries are not unrolled: light alone depends on no order, and such code compiles sooner.
    """
    row = rows.movedim(2, 0)[..., None, :]  # [F B K 1 L], where others have [F B 1 L] of each entry
    passed.copy_(passed * passing(row, x, y, rules).prod(1))


def weighted_picture(lights: Sequence[Tensor], gradient: Sequence[Tensor], before: Tensor, rules: Rules) -> Tensor:
    """Returns lights . gradient / before: the gradient-weighted picture of `lights` for unit transmittance in front.

    `lights`: channels and coverage; `before`: transmittance in front of them. All [*B P].
    """
    shine = sum_of_products(lights, gradient)
    return torch.where(before >= max(rules.stop, torch.finfo(before.dtype).tiny), shine / before, 0.0)


def slopes(
    rows: Rows, x: Axis, y: Axis, before: Light, behind: Light, gradient: Lights, rules: Rules
) -> tuple[Lights, Lights, Light]:
    """Returns (d loss / d ln alpha of each entry, its blending weight, `behind` moved in front of the block).

    `behind` is the gradient-weighted picture behind the block (`weighted_picture`); with it the slope is weight
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
    rows: Rows, slope: Slopes, weight: Slopes, x: Axis, y: Axis, products: Axes, gradient: Lights, rules: Rules
) -> Float[Tensor, "B K V *L"]:
    """Sums slope d and weight of every entry over a tile's pixels.

    The V columns: d, d x, d y, d x^2, d x y, d y^2, weight times gradient per channel and, if `rules.absolute`, the
    absolute gradient of the mean per axis.
    """
    sums = [slope.sum(2), *((slope * b).sum(2) for b in (x, y, *products.unbind(0)))]
    sums += [(weight * g[:, None]).sum(2) for g in gradient[:-1]]
    if rules.absolute:
        sums += absolute_moments(rows, slope, x, y)
    return torch.stack(sums, 2)


def gradients(
    rows: Rows,
    x: Axis,
    y: Axis,
    products: Axes,
    before: Light,
    behind: Light,
    gradient: Lights,
    out: Float[Tensor, "B K *L V"],
    rules: Rules,
) -> None:
    """Writes the gradients of entries to `out` and moves `behind` in front of the blocks.

    One call for all loops: calls cost, and a step makes hundreds. Slopes and weights lie in one tensor: so the compiler
    sums both in one loop, and parallel sums keep a core busy.
    """
    by_entry, weights, rest = slopes(rows, x, y, before, behind, gradient, rules)
    behind.copy_(rest)
    slope, weight = torch.stack([*by_entry, *weights], 1).chunk(2, 1)
    out.copy_(entry_gradients(rows, sums_of(rows, slope, weight, x, y, products, gradient, rules), rules))


def absolute_moments(rows: Rows, slope: Slopes, x: Axis, y: Axis) -> list[Float[Tensor, "B K *L"]]:
    """Sums |d loss / d mean| over pixels, per axis: minus the slope of ln alpha along x and y."""
    u0, u1, k0, u2, k1 = (column[:, :, None] for column in rows[:, :, :5].unbind(2))
    s, r = u0 * x + u1 * y + k0, u2 * y + k1
    by_x, by_y = 2 * u0 * s, 2 * (u1 * s + u2 * r)
    return [(slope * by_x).abs().sum(2), (slope * by_y).abs().sum(2)]


# -- tables in and out ---------------------------------------------------------------------------------------------


def make_rows(
    table: Float[Tensor, "N F"], places: Int[Tensor, "S K *L"], centre: Float[Tensor, "S 2 1 *L"], rules: Rules
) -> Float[Tensor, "S K F *L"]:
    """Gathers the columns of every entry from the table of splats, whose last row draws nothing.

    Columns: u0, u1, k0, u2, k1 of ln alpha = ln o - (u0 x + u1 y + k0)^2 - (u2 y + k1)^2 in tile-centred coordinates;
    ln o; the largest alpha; the channels; the mean. `table`: mean x, mean y, u0, u1, u2, ln o, channels.
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
    """Returns the gradient of (mean x, mean y, u0, u1, u2, ln o, channels ...) of every entry from its moments."""
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
"""Operations after which the compiler shares an intermediate value instead of repeating it, by loop over blocks.

Measured: other numbers cut a loop into several that exchange data through memory (`gradients` at 30 or 36: ten times as
slow) or take longer to compile (at 120: twice as long, for code that is no faster).
"""

SHARED_AFTER = 50
"""The same for all other loops: above it, slopes of segments compute weights twice."""
SUMS = {"gradients", "entry_sums"}
"""Loops whose code differs with `Rules.absolute`."""
OF_A_TILE = {"x", "y", "products"}
"""Arguments with a fixed number of rows: that of all others is a number of blocks, splats or tiles."""


def thresholds() -> list[str]:
    """Lists the compiler's options that set when a value is shared: CPUs have their own since torch 2.12."""
    names = ("realize_opcount_threshold", "realize_cpu_opcount_threshold")
    return [name for name in names if name in torch._inductor.list_options()]


def compiled_loop(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
    """Returns `loop` by these rules through torch.compile; it compiles at its first call, for any number of blocks."""
    return compile_loop(loop, rules if loop.__name__ in SUMS else replace(rules, absolute=False))


@functools.cache
def compile_loop(loop: Callable[..., Any], rules: Rules) -> Callable[..., Any]:
    """Compiles `loop` once by these rules."""
    options: dict[str, Any] = WHOLE_LOOPS | dict.fromkeys(thresholds(), SHARING.get(loop.__name__, SHARED_AFTER))
    # loops over blocks: no conditions on symbols, which are the number of blocks, the same in all arguments, and where
    # in storage a view begins, which enters no code; every other size, dtypes, strides and devices are checked one by
    # one, and 32-bit indices suffice (RasterSettings.compiled_values)
    unchecked = {"SHAPE_ENV"} if loop.__name__ in SHARING else set()
    # the code need not assert again what is checked before: that costs a quarter of a call
    options |= {"size_asserts": False}
    names = [name for name in signature(loop).parameters if name != "rules"]

    def varying(arguments: tuple[Tensor | list[Tensor], ...]) -> list[tuple[Tensor, int]]:
        tensors = flat(value for name, value in zip(names, arguments, strict=True) if name not in OF_A_TILE)
        return [(tensor, 0) for tensor in tensors]

    return compiled_once(with_last(loop, rules), varying, options, unchecked, fullgraph=True)
