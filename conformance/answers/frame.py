# SPDX-License-Identifier: MIT
"""Stage ``frame``: count the decisions before the network that rounding may turn."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.holes import expect_holes
from conformance.answers.motion_chain import expect_motion_chain
from conformance.answers.occlusion_warp import expect_occlusion_warp
from conformance.answers.port_arithmetic import Arithmetic
from stss_ref.constants import HoleTest


def undecided_before(inputs: dict[str, NDArray[Any]], test: HoleTest, arithmetic: Arithmetic) -> int:
    """Number of decisions before the network (motion, holes, splat) that are within rounding of their threshold.

    Each may change the whole image, so a frame that has one is not judged, but counted.

    Args:
        inputs: of stage ``frame``, float64.
        test: of static surfaces.
        arithmetic: of the port.
    """
    steps = [int(step) for step in inputs["steps"]]
    count = 0
    for i, step in enumerate(steps):
        if step == 0:
            continue
        chain = expect_motion_chain({"motions": inputs["motions"][:step]}, arithmetic)["motion"]
        motion, allowed = chain.want, np.asarray(chain.allowed)
        off = np.where(allowed > arithmetic.tiny, allowed, 0)
        planes = {
            "stencil_previous": inputs["stencils"][i + 1], "stencil": inputs["stencils"][0],
            "normal_previous": inputs["normals"][i + 1], "normal": inputs["normals"][0],
            "position_previous": inputs["positions"][i + 1], "position": inputs["positions"][0],
            "nov": inputs["nov"], "depth": inputs["gbuffer"][..., 3], "paper": np.array([test == "paper"], np.int32),
        }  # fmt: skip
        valid = expect_holes({"motion": motion, **planes}, arithmetic, off)["valid"]
        count += chain.undecided + valid.undecided
        if i == 0:
            color = inputs["colors"][0]
            given = {"color": color, "warped": color, "motion": motion, "depth": inputs["gbuffer"][..., 3], "valid": valid.want}
            count += expect_occlusion_warp(given, arithmetic, off=off)["occlusion_motion"].undecided
    return count
