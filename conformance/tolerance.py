# SPDX-License-Identifier: MIT
"""The table of bounds of stages. A tolerance of another test stands at that test, with its reason.

``allowed = roundings * u * scale + floor``, ``u = eps / 2`` the unit roundoff of the arithmetic. ``scale`` is an array or number that
the test computes in float64: the largest |input| for an interpolation, the stage run on absolute values for a sum, so that the bound
grows with the data and with nothing else. Errors are reported as error / allowed, never bare.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

UNIT = {"float64": 2.0**-53, "float32": 2.0**-24, "float16": 2.0**-11, "bfloat16": 2.0**-8}
"""Unit roundoff: the largest relative error of one correctly rounded operation."""


@dataclass(frozen=True)
class Bound:
    """One row: how many roundings an output may have met, an absolute floor, and why."""

    roundings: float
    floor: float
    why: str


BOUNDS = {
    # the suite's, for a port; docs/conformance.md derives each row
    "fraction": Bound(
        1, 0, "m - floor(m), which rounds for m between -1 and 0 only; scale: the fraction; exact where it is held"
    ),
    "sum": Bound(2, 0, "two motions added, once; exact where the arithmetic holds the sum, so that one rounding is seen as 1/2"),
    "bilinear": Bound(
        10, 0, "inner lerp: difference of at most 2 peaks, product, sum: 5; the outer one doubles it; scale: the taps"
    ),
    "offset": Bound(
        11, 0, "a difference at each tap, rounded once, then as bilinear; scale: the taps' differences; 0 where all are 0"
    ),
    "length": Bound(8, 0, "sum of three squares and a root, once each way; scale: the length"),
    "bias": Bound(8, 0, "three products and their sum; scale: on absolute values"),
    "dot": Bound(4, 0, "three products and their sum; scale: on absolute values"),
    "own": Bound(8, 0, "up to three sums, a quotient or a product with one; scale: the largest sample"),
    "like": Bound(
        110,
        0,
        "weights 36, twice: colours 3, normals 5 or distance 0, sum 2, power 4 times and 3, quotient 5; brightness 7, four times: sum, "
        "root 6; products 5, quotient 5",
    ),
    "share": Bound(
        130,
        0,
        "weights 36, twice; sums of 25 lights, twice; products 2, quotient 5, and the light's own 1; scale: the largest light",
    ),
    "layer": Bound(2, 0, "gamma_n: n = products in one sum, and these for bias and activation; scale: weights (backward error)"),
    "layer.float16": Bound(3, 0, "activation, weight and result stored once each in float16; sums as in float32"),
    "layer.bfloat16": Bound(3, 0, "as layer.float16, in bfloat16"),
    "layer.winograd": Bound(12, 0, "rms amplification of F(4x4,3x3) on 0, +-1, +-2: 10.8 (tests/meta/test_bounds.py)"),
    "gate": Bound(4, 0, "1 / (1 + exp(-x)) or (1 + tanh(x / 2)) / 2: absolutely, times what the gate is to close"),
    "spread": Bound(8, 0, "times the rms of the reference's answer to random changes of that size, or twice its largest"),
    "rms": Bound(
        1 / 6, 0, "rounding is a random walk, sqrt(n) below gamma_n, and a layer has n >= 36; scale: rms of the change by gamma_n"
    ),
    "rms.winograd": Bound(1, 0, "its transformed weights round once for all pixels: no random walk"),
    "rms.stored": Bound(1, 0, "of 3 roundings, each of up to u, the rms is u; changes of up to 3 u have sqrt(3) u"),
    "sums.square": Bound(2, 0, "mean of at least 1000 squared errors, each over its largest variance, n S^2 u^2 / 3"),
    "sums.signed": Bound(8, 0, "sum of N such errors over sqrt(N): standard deviations of errors of random sign"),
    "sums.quotient": Bound(6, 0, "erm's product with a weight, 1, and its quotient by the same, 2.5 ulp of up to 2 u"),
    "quarter": Bound(1, 0, "fraction -+ 1/4, below 2, rounded once; scale: 1 pixel, times slope and contrast, as motion"),
    "slowness": Bound(
        8, 0, "two products and their sum 2, a quotient 5, a product 1; scale: a reading's distance from the image"
    ),
    "accumulate": Bound(
        3,
        0,
        "a quarter and an eighth of differences of at most 2 peaks, their sum, and one; besides the readings'; scale: the box",
    ),
    "detail": Bound(
        96, 0, "a place 36: luma 4, product, 12 sums twice, quotient, weights 3 of the contrast; four, halved; 4; first colour 20"
    ),
    "image": Bound(16, 0, "upsampled colour: 10; pixel shuffle and its sum; the sigmoids' own; scale: largest output"),
    # of `stss conform --onnx`, for an operator, besides gamma_n of its sums
    "graph.division": Bound(
        4, 0, "OpenCL's 2.5 ulp of a quotient and 3 of a root, an ulp being at most 2 u; and the operands once"
    ),
    "graph.normalise": Bound(8, 0, "sum, root, quotient, difference, product, sum, or folded into weights; scale: on magnitudes"),
    "graph.coordinate": Bound(4, 0, "sum, quotient, difference and the scale's own; scale: the coordinate + 1, times slope"),
    "graph.lerp": Bound(6, 0, "weight, its complement, two products, a sum; and one of storing between axes; scale: the taps"),
    # agreement of two implementations in one dtype: each may err by the bound, hence twice the roundings of one
    "warp.warped": Bound(
        6 + (6 + 4), 0, "3 lerps of 2 roundings each; the oracle's x and y rounded to u |position|, times contrast <= 2 peak"
    ),
    "erm.attend": Bound(
        2 * (2 * 32 + 3 * 25 + 4), 0, "32-term dot products, 25-term sums of products, one quotient; scale: on |inputs|"
    ),
    "metric.sum": Bound(2 * 64, 0, "means of up to 2**32 terms by pairwise summation: 32 roundings and the terms' own"),
    "stage.cl": Bound(0, 2e-5, "required of the whole network; no stage may lose more"),
    # the OpenCL backend's
    "network.cl.float32": Bound(0, 2e-5, "required with Winograd; measured 5e-7 (PoCL 3.0, x86-64)"),
    "network.cl.float32-direct": Bound(0, 5e-6, "required without; measured 6e-7 (PoCL 3.0, x86-64)"),
    "network.cl.half": Bound(
        0, 4e-3, "measured 5e-4 (PoCL 3.0, x86-64): activations of order 1 stored with u = 2**-11, eightfold for depth"
    ),
    "network.cl.bfloat16": Bound(
        0, 3.2e-2, "activations of order 1 stored with u = 2**-8, eightfold for depth, as half; emulated on Zen 3: 6e-3"
    ),
    # the reference's
    "network.float64": Bound(0, 1e-11, "required: float64 reference data; 30 layers of at most 1152-term sums lose less"),
    "network.float32": Bound(0, 2e-6, "required: float32; the authors' own float32 run departs by 8e-7"),
    "network.cl": Bound(0, 2e-5, "required: OpenCL in float32 against the reference in float64"),
    "network.peer": Bound(0, 2e-5, "float32 by another engine; OpenVINO 2026.4 departs by 5e-6 at 960 x 544 (Zen 4)"),
    "warp.published": Bound(0, 1e-5, "required: ExtraNet's published float32 colours in [0, 1]"),
}


def ratio(row: str, got: NDArray[Any], want: NDArray[Any], scale: NDArray[Any] | float = 0.0) -> float:
    """Largest ``|got - want| / allowed`` by the row of ``BOUNDS``; infinite if the shapes differ or either holds NaN.

    Args:
        row: name in ``BOUNDS``.
        got: the numbers to judge; their dtype is the arithmetic.
        want: the numbers to compare with.
        scale: see the module.
    """
    bound = BOUNDS[row]
    if got.shape != want.shape:
        return np.inf
    allowed = bound.roundings * UNIT[got.dtype.name] * np.asarray(scale, np.float64) + bound.floor
    return worst(np.abs(got.astype(np.float64) - want), allowed)


def worst(error: NDArray[Any], allowed: NDArray[Any]) -> float:
    """Largest ``error / allowed``; 0 / 0 is 0, NaN is infinite."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = np.where(error == 0, 0.0, error / allowed)
    return float(np.where(np.isnan(ratios), np.inf, ratios).max(initial=0.0))
