# SPDX-License-Identifier: MIT
"""Correct ports with other arithmetic: a suite that fails one of them demands bits that the protocol does not promise.

All run in float32 but ``half`` and ``half_flush``, which store in float16.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import cache, partial, wraps
from inspect import signature
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

import stss_ref.conv as plain
from conformance.answers.windows import NetworkPart, pad_inputs, place_of, places
from conformance.cases import large_inputs
from conformance.protocol.layers import PADDED
from conformance.protocol.reference_copy import Plant, Variant, load, put, returns, wrap
from conformance.protocol.stages import STAGES, check_inputs
from stss_ref import erm, occlusion_warp, resample, reshade, rrm, sample, warp

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


def fused_lerp(a: Array, b: Array, t: Array) -> Array:
    """`stss_ref.sample.lerp` by a fused multiply-add."""
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


def in_half(function: Callable[..., Array]) -> Callable[..., Array]:
    """``function`` with its result stored in half precision."""
    return wraps(function)(lambda *arguments, **options: to_half(function(*arguments, **options)))


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


def other_likeness(base_color: Array, own_base_color: Array, normal: Array, own_normal: Array, away: Array) -> Array:
    apart = np.abs(base_color - own_base_color)[..., ::-1].sum(axis=-1)
    unlike = 2 * ((normal - own_normal)[..., ::-1] ** 2).sum(axis=-1) + ((apart + 1) + away / 4)
    return np.reciprocal(unlike * unlike * unlike * unlike)


def flush_to_0(x: Array, dtype: str = "float32") -> Array:
    """0 for what is no normal number of ``dtype``, as on a device that has none."""
    return np.where(np.abs(x) < np.finfo(dtype).tiny, x.dtype.type(0), x)


def turned(function: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Columns before rows."""
    return wraps(function)(lambda x: np.ascontiguousarray(function(x.swapaxes(0, 1)).swapaxes(0, 1)))


def down_first(four: Sequence[Array], at: sample.Taps) -> Array:
    """`stss_ref.sample.between`, rows before columns: one colour stays one colour, and whole pixels whole."""
    nw, ne, sw, se = four
    fx, fy = at.fx[..., None], at.fy[..., None]
    left, right = nw + (sw - nw) * fy, ne + (se - ne) * fy
    return left + (right - left) * fx


def fractions_in_double(at: sample.Place, motion: Array) -> sample.Place:
    moved = np.where(at.finite[..., None], motion, 0).astype(np.float64)
    fraction = moved - np.floor(moved)
    return at._replace(fx=fraction[..., 0], fy=fraction[..., 1])


def other_cosine(normal: Array, n: Array) -> Array:
    return (normal * n)[..., ::-1].sum(axis=-1) / (np.sqrt((n * n)[..., ::-1].sum(axis=-1)) + n.dtype.type(1e-5))


_POINTS_2 = tuple(Fraction(p) for p in (0, 1, -1))
_POINTS_4 = tuple(Fraction(p) for p in (0, 1, -1, 2, -2))
_POINTS_4_NEAR = tuple(Fraction(p, 8) for p in (0, 5, -5, 12, -12))
WINOGRAD = {"winograd_2": (2, _POINTS_2), "winograd_4": (4, _POINTS_4), "winograd_4_near": (4, _POINTS_4_NEAR)}


def _conv(function: Callable[..., Array], *rest: Any) -> Plant:
    return put("conv.conv", partial(function, *rest))


_RESAMPLED = (resample.upsample_corners, resample.upsample_centres, resample.downsample_8)
PLANTS: dict[str, tuple[Plant, ...]] = {
    "as_is": (),
    "in_order": (_conv(convolved, add_in_order),),
    "pairwise": (_conv(convolved, add_pairwise),),
    "fma": (
        _conv(convolved, add_fused),
        put("sample.lerp", fused_lerp),
        put("conv.sigmoid", lambda x: (1 + np.tanh(x / 2)) / 2),
    ),
    "orders": (
        *(put(f"resample.{f.__name__}", turned(f)) for f in _RESAMPLED),
        put("sample.between", down_first),
        put("conv.sigmoid", lambda x: 1 / (1 + np.exp(-x))),
        put("holes.bias", lambda nov, depth, of: of.depth * depth + (of.grazing + (of.facing - of.grazing) * np.abs(nov))),
        put("holes.squared", lambda v: v[..., 0] ** 2 + (v[..., 1] ** 2 + v[..., 2] ** 2)),
        put("holes.cosine", other_cosine),
        put("reshade.likeness", other_likeness),
        wrap("erm.window", lambda right, x: reversed([*right(x)])),
        put("erm.likeness", lambda key, query: np.maximum((key * query)[..., ::-1].sum(axis=-1, keepdims=True), 0)),
        put("erm.divide", lambda total, weights: total * np.reciprocal(np.maximum(weights, weights.dtype.type(1e-6)))),
        put(
            "erm.normalise",
            lambda x: x * np.reciprocal(np.maximum(np.sqrt((x * x).sum(axis=-1, keepdims=True)), x.dtype.type(1e-12))),
        ),
    ),
    "double": (
        returns("sample.follow", fractions_in_double),
        returns("sample.between", lambda image, four: image.astype(four[0].dtype)),
    ),
    "flush": (),
    **{name: (_conv(winograd, *how),) for name, how in WINOGRAD.items()},
    "half": (
        put("conv.gated", in_half(plain.gated)),
        put("conv.conv_chain", half_chain),
        put("rrm.concat_masked", in_half(rrm.concat_masked)),
        *(put(f"resample.{f.__name__}", in_half(f)) for f in (*_RESAMPLED, resample.pixel_shuffle)),
        put("erm.attend", half_attend),
        put("warp.warp", half_warp),
        put("occlusion_warp.occlusion_warp", half_occlusion_warp),
        put("reshade.reshade", in_half(reshade.reshade)),
        returns("accumulate.accumulate", to_half),
    ),
}
HOW: dict[str, dict[str, Any]] = {
    **{name: {"winograd": True} for name in WINOGRAD},
    "flush": {"entry": flush_to_0},
    "half": {"entry": to_half, "dtype": "float16"},
    "half_flush": {"entry": lambda x: flush_to_0(to_half(x), "float16"), "dtype": "float16"},
}
PLANTS["half_flush"] = (*PLANTS["half"], returns("motion_chain.chain_on", to_half))
_OF_NETWORK = {
    "history": "history.history_embedding",
    **{stage: f"{stage}.{stage}" for stage in ("encoder", "erm", "decoder", "network")},
}
"""Its stages, and their functions."""
PORTS = tuple(PLANTS)
"""Their names."""


def port(name: str) -> Variant:
    """The one of this name."""
    return load(name, *PLANTS[name], **HOW.get(name, {}))


def port_in_windows(name: str) -> Variant:
    """The same, but that it computes frames of a user's size where they are judged alone, by its own functions: the whole takes minutes."""
    in_windows = [wrap(function, partial(_in_windows, stage, PLANTS[name])) for stage, function in _OF_NETWORK.items()]
    return load(name, *PLANTS[name], *in_windows, **HOW.get(name, {}))


def _in_windows(stage: str, plants: Sequence[Plant], right: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
    """A stage of the network in the windows of a frame of a user's size, elsewhere 0; other sizes by ``right``."""
    inputs = signature(right).bind(*arguments, **keywords).arguments
    weights = inputs.pop("weights")
    sizes = check_inputs(stage, inputs)
    height, width = sizes["H"], sizes["W"]
    if (height, width) not in large_inputs.USER_SIZES.values():
        return right(*arguments, **keywords)
    inputs, whole = pad_inputs(inputs) if stage in PADDED else inputs, (-(-height // 8) * 8, -(-width // 8) * 8)
    part, given, specs = NetworkPart(stage, weights, whole, plants), STAGES[stage].inputs, STAGES[stage].outputs
    outputs = {name: np.zeros(spec.shape(sizes), np.float32) for name, spec in specs.items()}
    for window in places(height, width):
        around = part.around(window)
        got = part.run({name: array[place_of(given[name], around)] for name, array in inputs.items()}, window)
        for name, array in got.items():
            outputs[name][place_of(specs[name], window)] = array
    return tuple(outputs.values()) if len(outputs) > 1 else outputs.popitem()[1]
