# SPDX-License-Identifier: MIT
"""The kinds of arithmetic that `stss stress` compares: the reference in float32, and the OpenCL backend in each of its precisions."""

from __future__ import annotations

from typing import Any

import numpy as np

from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.stages import reference
from stss_ref.arrays import Array
from stss_ref.weights import Weights

NETWORK = ("history", "encoder", "erm", "decoder", "network")
"""The stages with weights, in the order of the tables."""
IMAGE = ("warp", "motion_chain", "occlusion_warp", "holes")
"""The image-space stages."""
LARGEST = np.float32(65504)
"""Half's largest number; larger values are stored as this."""


def features_of(inputs: Arrays, weights: Weights) -> dict[str, Array]:
    """The reference's features on the way to the image, in the dtype of the inputs."""
    frame = {name: inputs[name] for name in ("color", "gbuffer", "mask")}
    x: dict[str, Any] = reference("encoder", frame, weights)
    x |= reference("history", {"history": inputs["history"]}, weights)
    x |= reference("erm", {"x4": x["x4"], "gbuffer": inputs["gbuffer"], "mask": inputs["mask"]}, weights)
    features = {name: x[name] for name in ("reshaded", "feature", "x1", "x2", "x3")}
    return x | reference("decoder", {**features, "color": inputs["color"]}, weights)


class ReferenceEngine:
    """``stss_ref`` in float32.

    Attributes:
        name: its name in the tables.
        dtype: ``float32``, ``float16`` or ``bfloat16``: the type that its numbers are rounded to, which gives the unit of its errors.
    """

    name = "ref"
    dtype = "float32"

    def stages(self) -> tuple[str, ...]:
        """The stages that it computes; image-space stages have no precisions."""
        return (*NETWORK, *IMAGE)

    def run(self, stage: str, inputs: Arrays, weights: Weights) -> Outputs:
        """Compute a stage for float32 inputs; outputs have the names of the stage table."""
        with np.errstate(over="ignore", invalid="ignore"):
            return reference(stage, inputs, weights)

    def features(self, inputs: Arrays, weights: Weights) -> dict[str, Array]:
        """``x1``, ``x2``, ``x3``, ``x4``, ``feature``, ``reshaded`` and ``image`` of stage ``network``, each with all errors before it."""
        return features_of(inputs, weights)


class OpenCLEngine:
    """``stss_cl`` in one precision, on one device; keeps the network of the last weights."""

    def __init__(self, device: Any, precision: str):
        self.name = {"float32": "cl", "float32-direct": "cl direct", "half": "cl half", "bfloat16": "cl bfloat16"}[precision]
        self.dtype = {"half": "float16", "bfloat16": "bfloat16"}.get(precision, "float32")
        self._device, self._precision = device, precision
        self._weights: Weights | None = None
        self._network: Any = None

    def stages(self) -> tuple[str, ...]:
        """See `ReferenceEngine`."""
        return (*NETWORK, *IMAGE) if self._precision == "float32" else NETWORK

    def run(self, stage: str, inputs: Arrays, weights: Weights) -> Outputs:
        """See `ReferenceEngine`."""
        from stss_cl.image_space.stages import ImageStages

        if stage in IMAGE:
            return ImageStages(self._device).run_stage(stage, inputs)
        network = self._for(weights)
        if self.dtype == "float16":  # as the layer before would have stored them
            inputs = {name: np.clip(array, -LARGEST, LARGEST) for name, array in inputs.items()}
        if stage == "network":
            return {"image": network(*(inputs[name] for name in ("color", "gbuffer", "mask", "history")))}
        like = {"history": "history", "encoder": "color", "erm": "gbuffer", "decoder": "color"}[stage]
        height, width = inputs[like].shape[-3:-1]
        return self._layers(height, width).run_stage(stage, inputs)

    def features(self, inputs: Arrays, weights: Weights) -> dict[str, Array]:
        """See `ReferenceEngine`."""
        from stss_cl.device.buffers import read

        self._for(weights)
        layers = self._layers(*inputs["mask"].shape)
        image, buffers = layers.run_stage("network", inputs), layers.features
        places = {"x1": ("x1", 0, 24), "x2": ("x2", 0, 24), "x3": ("x3", 0, 32), "x4": ("x4", 0, 32)}
        places |= {"feature": ("reshaded", 64, 32), "reshaded": ("reshaded", 0, 64)}
        return {n: read(self._device, buffers[buffer], first, count) for n, (buffer, first, count) in places.items()} | image

    def _layers(self, height: int, width: int) -> Any:
        """The layers of the last weights, including those that the image does not need."""
        from stss_cl.network.layers import Layers

        return Layers(self._device, self._weights, (height, width), self._precision, every=True)  # pyrefly: ignore[bad-argument-type]

    def _for(self, weights: Weights) -> Any:
        from stss_cl.network.network import Network

        if self._weights is not weights:
            self._network = None  # frees the old buffers first
            self._network = Network(weights, self._device, self._precision)  # pyrefly: ignore[bad-argument-type]
            self._weights = weights
        return self._network


Engine = ReferenceEngine | OpenCLEngine
"""One way to compute a stage."""
