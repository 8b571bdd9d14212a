# SPDX-License-Identifier: MIT
"""The network in PyTorch's own functions, for comparison in the benchmark. It shares only the graph and the tensors with ours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stss_cl.graph import GRAPH, evaluate
from stss_ground.optional import require
from stss_ref.erm import LEAST_SUM, WINDOW
from stss_ref.weights import Layer, Weights


class TorchNetwork:
    """STSSNet on tensors (N, C, H, W); H, W multiples of 8. The methods are those of `stss_cl.graph.Operations`.

    A gate is one more channel of its feature's convolution, and the ERM's window is 25 slices: the same numbers, faster.

    Args:
        weights: the 92 tensors.
        options: for the tensors, of ``torch.Tensor.to``: device, dtype, memory format of weights (O, C, k, k): else ``channels_last``.
    """

    def __init__(self, weights: Weights, **options: Any):
        self._torch = require("torch")
        self._f = self._torch.nn.functional
        tensors: dict[str, Any] = {name: self._torch.tensor(array) for name, array in weights.items()}
        for name in [name for name in tensors if ".conv_feature." in name]:
            layer, kind = name.split(".conv_feature.")
            tensors[f"{layer}.{kind}"] = self._torch.cat([tensors[name], tensors[f"{layer}.conv_mask.0.{kind}"]])
        layout = options.pop("memory_format", self._torch.channels_last)
        self._tensors = {n: t.to(memory_format=layout, **options) if t.ndim == 4 else t.to(**options) for n, t in tensors.items()}

    def __call__(self, color: Any, gbuffer: Any, mask: Any, history: Any) -> Any:
        """Compute the image (1, 3, 2H, 2W) from color (1, 6, H, W), gbuffer (1, 9, H, W), mask (1, 1, H, W), history (3, 4, H, W)."""
        residual = self._f.pixel_shuffle(evaluate(self, color, gbuffer, mask, history)[GRAPH[-1].name], 2)
        return residual + self._f.interpolate(color[:, :3], scale_factor=2, mode="bilinear", align_corners=False)

    def convolve(self, x: Any, layer: Layer) -> Any:
        """A layer with its gate and its ReLU."""
        weight, bias = self._tensors[f"{layer.name}.weight"], self._tensors[f"{layer.name}.bias"]
        y = self._f.conv2d(x, weight, bias, layer.stride, layer.kernel // 2)
        if layer.gated:
            y = y[:, :-1] * y[:, -1:].sigmoid()
        return self._f.relu(y, inplace=True) if layer.relu else y

    def upsample(self, x: Any) -> Any:
        """Twice the size, corners aligned."""
        return self._f.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)

    def reduce(self, x: Any) -> Any:
        """An eighth of the size."""
        return self._f.interpolate(x, scale_factor=0.125, mode="bilinear", align_corners=False)

    def attend(self, light: Any, material: Any, mask: Any) -> Any:
        """The ERM's means over its window."""
        height, width = light.shape[-2:]
        query = self._f.normalize(material)
        key, value = (self._f.pad(x, (WINDOW // 2,) * 4) for x in (query * mask, light * mask))
        total = weight_sum = 0.0
        for v in range(WINDOW):
            for u in range(WINDOW):
                weight = (key[..., v : v + height, u : u + width] * query).sum(1, keepdim=True).relu()
                total = total + weight * value[..., v : v + height, u : u + width]
                weight_sum = weight_sum + weight
        return total / self._torch.clamp(weight_sum, min=LEAST_SUM)

    def multiply(self, x: Any, y: Any) -> Any:
        """The product."""
        return x * y

    def join(self, values: Sequence[Any]) -> Any:
        """Concatenate along the channels."""
        return self._torch.cat([*values], 1) if len(values) > 1 else values[0]

    def join_images(self, x: Any) -> Any:
        """(3, C, H, W) to (1, 3 C, H, W)."""
        return x.reshape(1, -1, *x.shape[-2:])
