# SPDX-License-Identifier: MIT
"""What a port is to the suite: an object with these four members. Nothing needs to be imported to be one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from numpy.typing import NDArray

from stss_ref.weights import Weights

AnyArray = NDArray[Any]
"""Array of floats, of a mask (uint8, 0 or 1) or of integers."""
Arrays = Mapping[str, AnyArray]
"""Inputs by the names of the stage table."""
Outputs = dict[str, AnyArray]
"""Outputs likewise."""


class PortError(RuntimeError):
    """A port failed or broke the protocol; the message names it, the stage, and what was expected and found."""


@dataclass(frozen=True)
class Unsupported:
    """In the place of outputs: the port lacks the stage."""

    stage: str


@dataclass(frozen=True)
class Case:
    """One stage to be run once.

    Attributes:
        stage: its name in ``conformance.protocol.stages.STAGES``.
        inputs: what that row names.
        weights: the network's tensors, float32; None for a stage that takes none.
    """

    stage: str
    inputs: Arrays = field(repr=False)
    weights: Weights | None = field(default=None, repr=False)


class Port(Protocol):
    """An implementation of stages, judged from outside.

    Arrays are C-contiguous; floats are float32 (for a float16 port they are rounded to float16 beforehand), masks uint8.

    Attributes:
        name: stands in reports.
        dtype: ``float32`` or ``float16``: the port's arithmetic, which picks the row of the tolerance table.
    """

    name: str
    dtype: str

    def stages(self) -> frozenset[str]:
        """What it implements; the rest is skipped by name, visibly."""
        ...

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Outputs of one of its ``stages()``, by the names of the stage table."""
        ...
