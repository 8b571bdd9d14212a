# SPDX-License-Identifier: MIT
"""Right answers of the whole network in a few windows of a frame whose whole would take minutes in float64."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.network import expect_with_weights
from conformance.answers.port_arithmetic import Arithmetic
from conformance.protocol.reference_copy import load, put
from stss_ref.resample import lerp_along, pad_to_8
from stss_ref.weights import Weights

Inputs = dict[str, NDArray[Any]]
REACH = 128
"""Input pixels, at most, from an output pixel to what it depends on, in multiples of 8: 37 of the encoder, 40 of erm, 30 of the decoder."""
SIDE = 32
"""Rows and columns of a window; input pixels."""
PART = 96
"""Rows and columns that give the bound: numbers are of one kind everywhere."""


def expect_windows(inputs: Inputs, weights: Weights, arithmetic: Arithmetic) -> Iterator[tuple[tuple[slice, slice], Expected]]:
    """The right image of stage ``network`` in the last rows: at its left, in its middle and at its right.

    Args:
        inputs: of the stage, float64, larger than ``PART`` both ways.
        weights: float32.
        arithmetic: of the port.

    Yields:
        Rows and columns of the image, and what is right there.
    """
    height, width = inputs["mask"].shape
    part = {name: _cut(array, slice(PART), slice(PART), name) for name, array in inputs.items()}
    bound = expect_with_weights("network", part, weights, arithmetic)["image"]
    padded = {name: pad_to_8(array[..., None])[..., 0] if name == "mask" else pad_to_8(array) for name, array in inputs.items()}
    whole = padded["mask"].shape
    rows = slice(height - SIDE, height)
    for left in (0, (width - SIDE) // 2, width - SIDE):
        columns = slice(left, left + SIDE)
        high, wide = (
            slice(max(0, s.start - REACH) // 8 * 8, min(n, -(-(s.stop + REACH) // 8) * 8))
            for s, n in zip((rows, columns), whole, strict=True)
        )
        first = high.start, wide.start
        port = load(
            "window",
            put(
                "resample.upsample_corners",
                _corners_of(first, whole, (high.stop - high.start, wide.stop - wide.start)),
            ),
        )
        got = port.run("network", {name: _cut(array, high, wide, name) for name, array in padded.items()}, weights)["image"]
        own = tuple(slice(2 * (s.start - at), 2 * (s.stop - at)) for s, at in zip((rows, columns), first, strict=True))
        place = slice(2 * rows.start, 2 * rows.stop), slice(2 * columns.start, 2 * columns.stop)
        yield place, replace(bound, want=got[own])


def _cut(array: NDArray[Any], rows: slice, columns: slice, name: str) -> NDArray[Any]:
    return array[rows, columns] if name == "mask" else array[..., rows, columns, :]


def _corners_of(first: tuple[int, int], whole: tuple[int, ...], size: tuple[int, ...]) -> Any:
    """`stss_ref.resample.upsample_corners` of a part of a frame: it reads where the whole does."""

    def upsample_corners(x: NDArray[Any]) -> NDArray[Any]:
        for axis in (0, 1):
            held = x.shape[axis]
            n, begin = whole[axis] * held // size[axis], first[axis] * held // size[axis]
            at = (np.arange(2 * held) + 2 * begin) * ((n - 1) / (2 * n - 1)) - begin
            x = lerp_along(x, np.clip(at, 0, held - 1), axis)
        return x

    return upsample_corners
