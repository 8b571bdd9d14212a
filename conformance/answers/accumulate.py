# SPDX-License-Identifier: MIT
"""Stage accumulate: the right answers of a port."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, reach
from conformance.answers.warp import interpolate, within_frame
from conformance.tolerance import BOUNDS
from stss_ref.accumulate import box, slowness
from stss_ref.constants import EARLIER_SHARES

Plane = NDArray[Any]


def expect_accumulate(inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic) -> dict[str, Expected]:
    """The mean of the images; where rounding decides whether a motion leads into the frame, the mean without this one is as right.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
    """
    image = inputs["image"]
    low, high = extremes = box(image)
    parts = [_part(inputs, k, extremes, arithmetic) for k in range(len(inputs["earlier"]))]
    wrong = sum(wrong for _, _, wrong, _ in parts)
    peak = np.maximum(np.abs(low), np.abs(high))
    rounding = BOUNDS["accumulate"].roundings * (arithmetic.unit * peak + arithmetic.tiny)
    mixed = np.logical_or.reduce([inside | unsure for _, inside, _, unsure in parts])
    allowed = np.where(mixed, wrong + rounding, arithmetic.flushed(image))

    def shown(flips: tuple[bool, ...]) -> Plane:
        total = sum(
            np.where(inside ^ (unsure & flip), apart, 0) for flip, (apart, inside, _, unsure) in zip(flips, parts, strict=True)
        )
        return image + total

    want, *others = map(shown, product((False, True), repeat=len(parts)))
    is_sure = not any(unsure.any() for *_, unsure in parts)
    return {"shown": Expected(want, allowed, () if is_sure else tuple(others))}


def _part(
    inputs: dict[str, NDArray[Any]], k: int, extremes: tuple[Plane, Plane], arithmetic: Arithmetic
) -> tuple[Plane, Plane, Plane, Plane]:
    """Of an earlier image: its change of the image, whether its motion leads into the frame, the error, whether rounding decides that."""
    motion, (low, high) = inputs["motions"][k], extremes
    # Twice a number is exact, but one too small may have become 0 before.
    rounding_of_motion = np.where(motion == 0, 0, 2 * arithmetic.flushed(motion))
    moved, off = (plane.repeat(2, axis=0).repeat(2, axis=1) for plane in (2 * motion, rounding_of_motion))
    at = reach(moved, arithmetic, off)
    inside, unsure = (mask[..., None] for mask in within_frame(at))
    history, wrong = interpolate(inputs["earlier"][k], at, arithmetic)
    clamped = np.clip(history, low, high)
    # The part that the box cuts off is no error.
    wrong = np.maximum(clamped - np.clip(history - wrong, low, high), np.clip(history + wrong, low, high) - clamped)
    share = EARLIER_SHARES[k] * slowness(motion).repeat(2, axis=0).repeat(2, axis=1)
    apart = clamped - inputs["image"]
    wrong = (wrong + BOUNDS["slowness"].roundings * arithmetic.unit * np.abs(apart)) * share
    return apart * share, inside, np.where(inside | unsure, wrong, 0), unsure
