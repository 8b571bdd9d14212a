# SPDX-License-Identifier: MIT
"""Correct ports with other arithmetic: a suite that fails one of them asks for bits that nobody promised.

``for port in ports()``, or one by name, for a command line: ``:fma`` of this module. All run in float32 but ``half``, which
stores in float16.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

import stss_ref.conv as plain
from conformance.mistakes.variants import Change, Variant, load
from stss_ref import erm, occlusion_warp, resample, rrm, sample, warp

Array = NDArray[Any]
Sum = Callable[[Array, Array, Array], Array]
"""From factors (T, P) and (T, O) and a bias (O,) to the sums (P, O) of their T products."""

CHUNK = 2**18
"""Products at a time: what stays in a cache."""


def convolved(add: Sum, x: Array, weight: Array, bias: Array, stride: int = 1) -> Array:
    """`stss_ref.conv.conv`, its products in the order channel (last first), column, row, handed to ``add``."""
    outputs, channels, size, _ = weight.shape
    r = size // 2
    windows = sliding_window_view(np.pad(x, ((r, r), (r, r), (0, 0))), (size, size), axis=(0, 1))[::stride, ::stride]
    rows, columns = windows.shape[:2]
    factors = windows[:, :, ::-1].transpose(2, 4, 3, 0, 1).reshape(channels * size * size, rows * columns)
    weights = weight[:, ::-1].transpose(1, 3, 2, 0).reshape(len(factors), outputs)
    step = max(1, CHUNK // weights.size)
    parts = [add(factors[:, first : first + step], weights, bias) for first in range(0, rows * columns, step)]
    return np.concatenate(parts).reshape(rows, columns, outputs)


def add_in_order(factors: Array, weights: Array, bias: Array) -> Array:
    """Bias first, then every product after the other."""
    products = np.empty((len(factors) + 1, factors.shape[1], len(bias)), factors.dtype)
    products[0] = bias
    np.multiply(factors[:, :, None], weights[:, None], out=products[1:])
    # Along any axis but the last one NumPy adds in order.
    return np.add.reduce(products, axis=0)


def add_pairwise(factors: Array, weights: Array, bias: Array) -> Array:
    """Halves added to each other until one is left, then the bias."""
    products = factors[:, :, None] * weights[:, None]
    while len(products) > 1:
        half = len(products) // 2
        products = np.concatenate([products[:half] + products[half : 2 * half], products[2 * half :]])
    return products[0] + bias


def add_fused(factors: Array, weights: Array, bias: Array) -> Array:
    """Fused multiply-adds into one sum for each tap, as unrolled loops have them; the sums at the end."""
    taps = 9 if len(factors) % 9 == 0 else 1
    a, b = (f.astype(np.float64).reshape(-1, taps, f.shape[1]) for f in (factors, weights))
    sums = np.zeros((taps, a.shape[2], b.shape[2]), np.float32)
    sums[0] = bias
    exact = np.empty(sums.shape)
    for x, w in zip(a, b, strict=True):
        np.multiply(x[:, :, None], w[:, None], out=exact)
        exact += sums
        sums[...] = exact
    return np.add.reduce(sums, axis=0)


def multiply_add(a: Array, b: Array, c: Array) -> Array:
    """``a b + c``, rounded once (but for the rounding to float64, which hardly ever shows)."""
    return (a.astype(np.float64) * b + c).astype(c.dtype)


def fused_between(four: Sequence[Array], at: sample.Taps) -> Array:
    """`stss_ref.sample.between` by fused multiply-adds."""
    nw, ne, sw, se = four
    fx, fy = at.fx[..., None], at.fy[..., None]
    top, bottom = multiply_add(ne - nw, fx, nw), multiply_add(se - sw, fx, sw)
    return multiply_add(bottom - top, fy, top)


def fused_lerp_along(x: Array, at: Array, axis: int) -> Array:
    """`stss_ref.resample._lerp_along` by fused multiply-adds."""
    low = np.floor(at).astype(np.intp)
    high = np.minimum(low + 1, x.shape[axis] - 1)
    t = (at - low).astype(x.dtype).reshape([-1 if i == axis else 1 for i in range(x.ndim)])
    a, b = np.take(x, low, axis), np.take(x, high, axis)
    return multiply_add(b - a, t, a)


@cache
def cook_toom(outputs: int, points: tuple[Fraction, ...]) -> tuple[Array, Array, Array]:
    """Matrices A', G, B' of F(outputs, 3) on these points and infinity: ``y = A' (G w * B' d)``, exact in float64."""
    n = outputs + 2
    a, g, b = (np.zeros(shape) for shape in ((outputs, n), (n, 3), (n, n)))
    for j, p in enumerate(points):
        others = [q for q in points if q != p]
        scale = np.prod([p - q for q in others])
        a[:, j] = [float(p**i) for i in range(outputs)]
        g[j] = [float(p**k / scale) for k in range(3)]
        b[j, : n - 1] = _coefficients(others)
    a[-1, -1] = g[-1, -1] = 1
    b[-1] = _coefficients(list(points))
    return a, g, b


def _coefficients(roots: list[Fraction]) -> list[float]:
    """Of the polynomial with these roots, lowest first."""
    polynomial = [Fraction(1)]
    for root in roots:
        shifted, scaled = [Fraction(0), *polynomial], [*(-root * c for c in polynomial), Fraction(0)]
        polynomial = [s + t for s, t in zip(shifted, scaled, strict=True)]
    return [float(c) for c in polynomial]


def winograd(outputs: int, points: tuple[Fraction, ...], x: Array, weight: Array, bias: Array, stride: int = 1) -> Array:
    """`stss_ref.conv.conv` by F(m x m, 3 x 3) where it applies; weights transformed in float64, all else in float32."""
    if stride != 1 or weight.shape[2] != 3:
        return plain.conv(x, weight, bias, stride)
    m, n = outputs, outputs + 2
    (height, width, channels), o = x.shape, len(weight)
    rows, columns = -(-height // m), -(-width // m)
    a, g, b = cook_toom(outputs, points)
    u = np.einsum("ik,ockl,jl->ijco", g, weight.astype(np.float64), g, optimize=True).astype(x.dtype)
    a, b = a.astype(x.dtype), b.astype(x.dtype)

    padded = np.pad(x, ((1, rows * m + 1 - height), (1, columns * m + 1 - width), (0, 0)))
    tiles = sliding_window_view(padded, (n, n), axis=(0, 1))[::m, ::m].transpose(3, 4, 0, 1, 2)
    v = (b @ tiles.reshape(n, -1)).reshape(n, n, -1)
    products = np.matmul(np.matmul(b, v).reshape(n, n, -1, channels), u)
    y = np.matmul(a, (a @ products.reshape(n, -1)).reshape(m, n, -1))
    image = y.reshape(m, m, rows, columns, o).transpose(2, 0, 3, 1, 4).reshape(rows * m, columns * m, o)
    return image[:height, :width] + bias


def to_half(x: Array) -> Array:
    """Stored as float16, read again as float32."""
    with np.errstate(over="ignore"):
        return x.astype(np.float16).astype(np.float32)


def stored(function: Callable[..., Array]) -> Callable[..., Array]:
    """``function`` with its result stored in half precision."""
    return lambda *arguments, **options: to_half(function(*arguments, **options))


def half_chain(x: Array, weights: Any, name: str, layers: tuple[int, ...], *, last_relu: bool = True) -> Array:
    """`stss_ref.conv.conv_chain`, every layer's activations stored."""
    for i, stride in enumerate(layers):
        x = plain.conv_named(x, weights, f"{name}.{2 * i}", stride)
        x = to_half(plain.relu(x) if last_relu or i < len(layers) - 1 else x)
    return x


def half_attend(*arguments: Array) -> Array:
    return to_half(erm.attend(*map(to_half, arguments)))


def half_warp(color: Array, motion: Array) -> tuple[Array, Array]:
    warped, inside = warp.warp(color, motion)
    return to_half(warped), inside


def half_occlusion_warp(*arguments: Array, **more: Array) -> tuple[Array, Array]:
    motion, image = occlusion_warp.occlusion_warp(*arguments, **more)
    return motion, to_half(image)


def flush_to_0(x: Array) -> Array:
    """0 for what is no normal number, as on a device that has none."""
    return np.where(np.abs(x) < np.finfo(x.dtype).tiny, x.dtype.type(0), x)


def turned(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Columns before rows."""
    return lambda x: np.ascontiguousarray(function(x.swapaxes(0, 1)).swapaxes(0, 1))


def down_first(four: Sequence[Array], at: sample.Taps) -> Array:
    """`stss_ref.sample.between`, rows before columns: one colour stays one colour, and whole pixels whole."""
    nw, ne, sw, se = four
    fx, fy = at.fx[..., None], at.fy[..., None]
    left, right = nw + (sw - nw) * fy, ne + (se - ne) * fy
    return left + (right - left) * fx


_TANH: list[Change] = [("conv.py", "return np.where(x >= 0, 1, small) / (1 + small)", "return (1 + np.tanh(x / 2)) / 2")]
_BIAS = "limits.facing * facing + limits.grazing * (1 - facing) + limits.depth * depth"
_OTHER_BIAS = "limits.depth * depth + (limits.grazing + (limits.facing - limits.grazing) * facing)"
_SQUARED = "return (vectors * vectors).sum(axis=-1)"
_OTHER_SQUARED = "return vectors[..., 0] ** 2 + (vectors[..., 1] ** 2 + vectors[..., 2] ** 2)"
_ORDERS: list[Change] = [
    ("conv.py", "return np.where(x >= 0, 1, small) / (1 + small)", "return 1 / (1 + np.exp(-x))"),
    ("holes.py", _BIAS, _OTHER_BIAS),
    ("holes.py", _SQUARED, _OTHER_SQUARED),
    ("holes.py", "(normal * n).sum", "(normal * n)[..., ::-1].sum"),
    ("holes.py", "(n * n).sum", "(n * n)[..., ::-1].sum"),
    ("erm.py", "for v in range(WINDOW):", "for v in reversed(range(WINDOW)):"),
    ("erm.py", "for u in range(WINDOW):", "for u in reversed(range(WINDOW)):"),
    ("erm.py", "(key[there] * query).sum", "(key[there] * query)[..., ::-1].sum"),
    ("erm.py", "return total / np.maximum(weight_sum, ", "return total * np.reciprocal(np.maximum(weight_sum, "),
    ("erm.py", "weight_sum.dtype.type(1e-6))", "weight_sum.dtype.type(1e-6)))"),
    ("erm.py", "return x / np.maximum(", "return x * np.reciprocal(np.maximum("),
    ("erm.py", "x.dtype.type(1e-12))", "x.dtype.type(1e-12)))"),
]


_DOUBLE: list[Change] = [
    ("sample.py", "fraction = moved - whole", "fraction = moved.astype(np.float64) - whole"),
    ("sample.py", "return top + (bottom - top) * fy", "return (top + (bottom - top) * fy).astype(nw.dtype)"),
]
_POINTS_2 = tuple(Fraction(p) for p in (0, 1, -1))
_POINTS_4 = tuple(Fraction(p) for p in (0, 1, -1, 2, -2))
_POINTS_4_NEAR = tuple(Fraction(p, 8) for p in (0, 5, -5, 12, -12))


def _conv(function: Callable[..., Array]) -> dict[str, Callable[..., Any]]:
    return {"conv.conv": function}


_HALF = {
    "conv.gated": stored(plain.gated),
    "conv.conv_chain": half_chain,
    "rrm.concat_masked": stored(rrm.concat_masked),
    "resample.downsample_8": stored(resample.downsample_8),
    "resample.upsample_corners": stored(resample.upsample_corners),
    "resample.upsample_centres": stored(resample.upsample_centres),
    "resample.pixel_shuffle": stored(resample.pixel_shuffle),
    "erm.attend": half_attend,
    "warp.warp": half_warp,
    "occlusion_warp.occlusion_warp": half_occlusion_warp,
}
_FMA = {**_conv(partial(convolved, add_fused)), "sample.between": fused_between, "resample._lerp_along": fused_lerp_along}
_TURNED = {
    f"resample.{f.__name__}": turned(f) for f in (resample.upsample_corners, resample.upsample_centres, resample.downsample_8)
}

PORTS: dict[str, dict[str, Any]] = {
    "as_is": {},
    "in_order": {"functions": _conv(partial(convolved, add_in_order))},
    "pairwise": {"functions": _conv(partial(convolved, add_pairwise))},
    "fma": {"functions": _FMA, "changes": _TANH},
    "orders": {"functions": {**_TURNED, "sample.between": down_first}, "changes": _ORDERS},
    "double": {"changes": _DOUBLE},
    "flush": {"entry": flush_to_0},
    "winograd_2": {"functions": _conv(partial(winograd, 2, _POINTS_2)), "winograd": True},
    "winograd_4": {"functions": _conv(partial(winograd, 4, _POINTS_4)), "winograd": True},
    "winograd_4_near": {"functions": _conv(partial(winograd, 4, _POINTS_4_NEAR)), "winograd": True},
    "half": {"functions": _HALF, "entry": to_half, "dtype": "float16"},
}
"""By name, what `conformance.mistakes.variants.load` makes of the reference."""


def ports() -> Iterator[Variant]:
    """All of them."""
    return map(port, PORTS)


def port(name: str) -> Variant:
    """The one of this name."""
    return load(name, **PORTS[name])


def __getattr__(name: str) -> Callable[[], Variant]:
    if name in PORTS:
        return partial(port, name)
    raise AttributeError(name)
