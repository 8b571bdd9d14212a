# SPDX-License-Identifier: MIT
"""Stage rrm: the right answers of a port."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.expected import Expected, exact
from conformance.answers.port_arithmetic import Arithmetic
from stss_ref.rrm import rrm


def expect_rrm(inputs: dict[str, NDArray[Any]], _: Arithmetic) -> dict[str, Expected]:
    """The right mask, without an allowed error, since the stage computes no number."""
    y, x, height, width = (int(n) for n in inputs["rectangle"])
    return {"valid": exact(rrm(inputs["valid"], (y, x, height, width)).astype(np.uint8))}
