# SPDX-License-Identifier: MIT
"""Options of computing frames, by which the user trades accuracy, time and memory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stss_cl.options import PRECISIONS, SKIPS, Precision, Skip
from stss_ground.arguments import require_choice, require_kind
from stss_ground.errors import InputError


@dataclass(frozen=True)
class ComputeOptions:
    """The options that ``stss.open_backend`` takes besides the weights.

    Attributes:
        device: part of an OpenCL device's name; None: ``$STSS_DEVICE``, or the fastest that passed its self-test.
        precision: one of ``stss_cl.options.PRECISIONS``; the reference takes ``float32`` only.
        memory_limit: bytes for the buffers of the OpenCL backend; larger frames go in strips, with the same bits.
        skip: one of ``stss_cl.options.SKIPS``, for the OpenCL backend; the reference computes everything.
        accumulate: mix each image with those of the two display frames before it (stage ``accumulate``); None: where the weights are made
            for aliased input.

    Raises:
        InputError: ``precision`` or ``skip`` is none of these, the limit no number of bytes, or ``accumulate`` neither True nor False.
    """

    device: str | None = None
    precision: Precision = "float32"
    memory_limit: int | None = None
    skip: Skip = "exact"
    accumulate: bool | None = None

    def __post_init__(self) -> None:
        """Refuse a precision or a way to skip that no backend has."""
        for name, value, choices in (("precision", self.precision, PRECISIONS), ("skip", self.skip, SKIPS)):
            require_choice(name, value, choices)
        if self.device is not None:
            require_kind("device", self.device, str, "part of a device's name, or None")
        if self.accumulate is not None:
            require_kind("accumulate", self.accumulate, (bool, np.bool_), "True, False or None")
        if self.memory_limit is not None:
            require_kind("memory_limit", self.memory_limit, (int, np.integer), "a number of bytes, or None")
        if self.memory_limit is not None and self.memory_limit < 1:
            raise InputError(f"memory_limit: expected bytes > 0, got {self.memory_limit}")

    @property
    def name(self) -> str:
        """Precision and skipping as tables show them."""
        return f"{self.precision} {self.skip}"
