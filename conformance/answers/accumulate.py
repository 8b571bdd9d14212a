# SPDX-License-Identifier: MIT
"""Stage accumulate: the right answers of a port."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected
from conformance.answers.port_arithmetic import Arithmetic, reach
from conformance.answers.warp import interpolate, within_frame
from conformance.tolerance import BOUNDS
from stss_ref.accumulate import box
from stss_ref.constants import EARLIER_SHARE
from stss_ref.sample import lerp


def expect_accumulate(inputs: dict[str, NDArray[Any]], arithmetic: Arithmetic) -> dict[str, Expected]:
    """The mean of the two images; where rounding decides whether the motion leads into the frame, ``image`` is as right.

    Args:
        inputs: of the stage, float64.
        arithmetic: of the port.
    """
    image, motion = inputs["image"], inputs["motion"]
    # Twice a number is exact, but one too small may have become 0 before.
    rounding_of_motion = np.where(motion == 0, 0, 2 * arithmetic.flushed(motion))
    moved, off = (plane.repeat(2, axis=0).repeat(2, axis=1) for plane in (2 * motion, rounding_of_motion))
    at = reach(moved, arithmetic, off)
    inside, unsure = (mask[..., None] for mask in within_frame(at))
    low, high = box(image)
    history, wrong = interpolate(inputs["before"], at, arithmetic)
    clamped = np.clip(history, low, high)
    # What the box cuts off is no error.
    wrong = np.maximum(clamped - np.clip(history - wrong, low, high), np.clip(history + wrong, low, high) - clamped)
    peak = np.maximum(np.abs(low), np.abs(high))
    rounding = BOUNDS["accumulate"].roundings * (arithmetic.unit * peak + arithmetic.tiny)
    mean, copy = lerp(image, clamped, EARLIER_SHARE), arithmetic.flushed(image)
    allowed = np.where(inside | unsure, EARLIER_SHARE * wrong + rounding, copy)
    want = np.where(inside, mean, image)
    others = (np.where(unsure, np.where(inside, image, mean), want),) if unsure.any() else ()
    return {"shown": Expected(want, allowed, others)}
