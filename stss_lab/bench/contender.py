# SPDX-License-Identifier: MIT
"""Contenders of the benchmark, and the workload that they are made for.

A contender is made for one size and has three steps: ``prepare`` brings the inputs into its layout, ``run`` computes and is timed,
``image`` brings the result back. Calling a peer with arrays does all three.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from stss_ref.arrays import Array, Image, Plane
from stss_ref.frame import NetworkInputs
from stss_ref.resample import pad_to_8
from stss_ref.weights import Weights


@dataclass(frozen=True)
class Setup:
    """The setup of a contender: weights, size, device and threads.

    Attributes:
        weights: the 92 tensors.
        height, width: H, W of the inputs; any size, pixels.
        device: part of the name of the OpenCL device, for contenders that use one; None: the default.
        threads: most threads of a contender on the CPU, if the engine has such a setting.
        dark: whether colours are so small that they, or products of them, are subnormal.
    """

    weights: Weights
    height: int
    width: int
    device: str | None
    threads: int
    dark: bool = False


class Contender(Protocol):
    """One way to compute the network or whole frames, which the benchmark times.

    Attributes:
        details: facts that the numbers depend on: package, precision, layout.

    If ``run`` computes several frames, ``frames`` is their number; the time of one is reported.
    """

    details: dict[str, str]

    def prepare(self, inputs: Any) -> None:
        """Take inputs (H, W, C) float32: ``NetworkInputs``, or ``FrameInputs`` if the contender computes whole frames."""

    def run(self) -> None:
        """Compute the image of the prepared inputs; returns when it is complete."""

    def image(self) -> Image | None:
        """The result of the last ``run``, (2H, 2W, 3) float32; None if it is not that of the network or of stage ``frame``."""
        ...


class Peer(ABC):
    """The network by another engine: a `Contender` that takes channels first, padded to multiples of 8."""

    details: dict[str, str]

    def __init__(self, setup: Setup):
        self.setup = setup

    def __call__(self, color: Image, gbuffer: Image, mask: Plane, history: Array) -> Image:
        """Stage ``network`` on arrays with channels last, like ``stss_ref.network.network``."""
        self.prepare(NetworkInputs(color, gbuffer, mask, history))
        self.run()
        return self.image()

    def prepare(self, inputs: NetworkInputs) -> None:
        """See `Contender`."""
        mask = inputs.mask[..., None]
        self._bind({
            "color": _channels_first(inputs.color[None]),
            "gbuffer": _channels_first(inputs.gbuffer[None]),
            "mask": _channels_first(mask[None]),
            "history": _channels_first(inputs.history),
        })  # fmt: skip

    @abstractmethod
    def _bind(self, inputs: dict[str, Array]) -> None:
        """Take padded inputs (N, C, H, W)."""

    @abstractmethod
    def run(self) -> None:
        """See `Contender`."""

    def image(self) -> Image:
        """See `Contender`."""
        image = np.moveaxis(self._result()[0], 0, -1)
        return np.ascontiguousarray(image[: 2 * self.setup.height, : 2 * self.setup.width], np.float32)

    @abstractmethod
    def _result(self) -> Array:
        """The image of the padded inputs, (1, 3, 2H8, 2W8); H8, W8 = H, W rounded up to multiples of 8."""


def _channels_first(x: Array) -> Array:
    return np.ascontiguousarray(np.moveaxis(pad_to_8(x), -1, -3))
