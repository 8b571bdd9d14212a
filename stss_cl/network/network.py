# SPDX-License-Identifier: MIT
"""The network on an OpenCL device: order of launches, lifetime of buffers."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyopencl.array as cla

from stss_cl.device.buffers import Outgoing, Plain, incoming, on_device
from stss_cl.device.discovery import Device, open_device
from stss_cl.network.layers import Layers
from stss_cl.options import PRECISIONS, Precision
from stss_ground.arguments import require_choice, require_kind
from stss_ref.arrays import Array, require_dtype, require_finite, require_shape
from stss_ref.weights import Weights


class Network:
    """STSSNet (spec 7), ready for one set of weights; buffers are made once for each size and reused.

    Args:
        weights: the 92 tensors.
        device: to run on; None = ``stss_cl.device.discovery.open_device()``.
        precision: see ``stss_cl.options.PRECISIONS``.
        memory_limit: bytes that the buffers may take, as ``stss_cl.network.strips.bytes_for`` counts them; larger frames are
            computed in strips, with the same bits. None = half of the device's memory.

    Raises:
        InputError: an argument is of a wrong type, or a precision is unknown.
        DeviceError: there is no device, or it cannot be opened.
    """

    def __init__(
        self, weights: Weights, device: Device | None = None, precision: Precision = "float32", memory_limit: int | None = None
    ):
        require_kind("weights", weights, (Weights, Mapping), "the 92 tensors")
        require_choice("precision", precision, PRECISIONS)
        if device is not None:
            require_kind("device", device, Device, "one from open_device, or None")
        if memory_limit is not None:
            require_kind("memory_limit", memory_limit, (int, np.integer), "a number of bytes, or None")
        self.device = open_device() if device is None else device
        self.precision: Precision = precision
        self._weights, self._memory_limit = weights, memory_limit
        self._layers: Layers | None = None

    def __call__(self, color: Plain, gbuffer: Plain, mask: Plain, history: Plain) -> Any:
        """Compute the image at twice the size.

        Source: spec 7; ``stss_ref.network.network`` gives units and ranges. All four arguments are float32 and C-contiguous: NumPy
        arrays, or ``pyopencl.array`` of this device's context.

        Args:
            color: (H, W, 6) the two colours, display-referred, in [0, 1].
            gbuffer: (H, W, 9) normal 3, depth, roughness, metallic, base colour 3.
            mask: (H, W) 1 = the warped colour can be trusted, 0 = hole.
            history: (3, H, W, 4) oldest, middle, newest: colour and mask.

        Returns:
            image: (2H, 2W, 3) float32, an array of the kind given; not clipped.

        Raises:
            ArrayError: shapes or dtypes differ, or an input is not finite (a NaN would spread over whole tiles). The history's values are
                checked only if the weights read them.
        """
        height, width = check(color, gbuffer, mask, history)
        layers = self.layers(height, width)
        tensors = {"color": color, "gbuffer": gbuffer, "mask": mask, "history": history}
        inputs = {name: array for name, array in tensors.items() if layers.reads_history or name != "history"}
        buffers = {
            name: on_device(self.device, name, array) if isinstance(array, cla.Array) else incoming(self.device, array)
            for name, array in inputs.items()
        }
        image = Outgoing(self.device, (2 * height, 2 * width, 3), on_device=isinstance(color, cla.Array))
        for strip in layers.strips:
            layers.place(strip)
            layers.pack(buffers["color"], buffers["gbuffer"], buffers["mask"], buffers.get("history"))
            layers.run(image.data)
        result = image.finish()
        if not layers.all_finite():
            for name, array in inputs.items():
                require_finite(name, array.get() if isinstance(array, cla.Array) else array)
        return result

    def layers(self, height: int, width: int) -> Layers:
        """Buffers and launches for one size, from the last call if it was of that size."""
        if self._layers is None or self._layers.size != (height, width):
            self._layers = None  # frees the old buffers before new ones are made
            self._layers = Layers(self.device, self._weights, (height, width), self.precision, self._memory_limit)
        return self._layers

    def timings(self) -> dict[str, float]:
        """Seconds of each stage's launches, run one at a time, for the size of the last call."""
        if self._layers is None:
            return {}
        height, width = self._layers.size
        image = Outgoing(self.device, (2 * height, 2 * width, 3), on_device=True)
        seconds: dict[str, float] = {}
        for launch in self._layers.ready(image.data):
            self.device.queue.finish()
            start = time.perf_counter()
            launch.enqueue(self.device.queue)
            self.device.queue.finish()
            seconds[launch.stage] = seconds.get(launch.stage, 0.0) + time.perf_counter() - start
        return seconds


def check(color: Plain, gbuffer: Plain, mask: Plain, history: Plain) -> tuple[int, int]:
    """Check shapes and dtypes; returns H and W."""
    require_shape("color", color, (None, None, 6))
    height, width = color.shape[:2]
    shapes = {"gbuffer": (height, width, 9), "mask": (height, width), "history": (3, height, width, 4)}
    for name, array in {"color": color, "gbuffer": gbuffer, "mask": mask, "history": history}.items():
        require_shape(name, array, shapes.get(name, array.shape))
        require_dtype(name, array, np.dtype(np.float32))
    return height, width


STAGES = frozenset({"history", "encoder", "erm", "decoder", "network"})
"""The stages that ``NetworkStages`` runs."""


class NetworkStages:
    """Single stages of the network by the names of the port protocol (docs/ports.md); buffers are reused while the size stays.

    Arguments as of ``Network``.
    """

    def __init__(self, weights: Weights, device: Device | None = None, precision: Precision = "float32"):
        self._network, self._weights = Network(weights, device, precision), weights
        self._layers: Layers | None = None

    def run_stage(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """Run one of ``STAGES``."""
        if stage == "network":
            return {"image": self._network(*(inputs[name] for name in ("color", "gbuffer", "mask", "history")))}
        return self._layers_for(stage, inputs).run_stage(stage, inputs)

    def layers_of(self, stage: str, inputs: Mapping[str, Array]) -> dict[str, Array]:
        """The results of a stage's layers, by name; none if the frame is computed in strips."""
        return self._layers_for(stage, inputs).layers_of(stage, inputs)

    def _layers_for(self, stage: str, inputs: Mapping[str, Array]) -> Layers:
        like = {"history": "history", "erm": "gbuffer"}.get(stage, "color")
        height, width = inputs[like].shape[-3:-1]
        if self._layers is None or self._layers.size != (height, width):
            self._layers = None  # frees the old buffers before new ones are made
            network = self._network
            # A single stage is computed whole, even parts that no other stage reads.
            self._layers = Layers(network.device, self._weights, (height, width), network.precision, every=True)
        return self._layers
