# SPDX-License-Identifier: MIT
"""The network in PyTorch's own functions, the yardstick of the benchmark. It shares only the tensors' names with ``stss_ref``."""

from __future__ import annotations

from typing import Any

from stss_ground.optional import require
from stss_ref.weights import Weights


class TorchNetwork:
    """STSSNet on tensors (N, C, H, W); H, W multiples of 8.

    A gate is one more channel of its feature's convolution, and the ERM's window is 25 slices: the same numbers, faster.

    Args:
        weights: the 92 tensors.
        options: for the tensors, of ``torch.Tensor.to``: device, dtype. Weights (O, C, k, k) are ``channels_last``.
    """

    def __init__(self, weights: Weights, **options: Any):
        self._torch = require("torch")
        self._f = self._torch.nn.functional
        tensors: dict[str, Any] = {name: self._torch.tensor(array) for name, array in weights.items()}
        for name in [name for name in tensors if ".conv_feature." in name]:
            layer, kind = name.split(".conv_feature.")
            tensors[f"{layer}.{kind}"] = self._torch.cat([tensors[name], tensors[f"{layer}.conv_mask.0.{kind}"]])
        layout = self._torch.channels_last
        self._tensors = {n: t.to(memory_format=layout, **options) if t.ndim == 4 else t.to(**options) for n, t in tensors.items()}

    def __call__(self, color: Any, gbuffer: Any, mask: Any, history: Any) -> Any:
        """Compute the image (1, 3, 2H, 2W) from color (1, 6, H, W), gbuffer (1, 9, H, W), mask (1, 1, H, W), history (3, 4, H, W)."""
        f = self._f
        x = self._torch.cat([color, color * mask, gbuffer], 1)
        x1 = f.relu(self._gated(f.relu(self._gated(x, "conv1")), "conv2"))
        x2 = self._down(x1, "down1")
        x3 = self._down(x2, "down2")
        x4 = self._down(x3, "down3")
        u = self._torch.cat([self._erm(x4, gbuffer, mask), self._history(history)], 1)
        for name, skip in (("up1", x3), ("up2", x2), ("up3", x1)):
            u = f.interpolate(u, scale_factor=2, mode="bilinear", align_corners=True)
            u = self._chain(self._torch.cat([skip, u], 1), f"{name}.conv.double_conv", (1, 1))
        residual = f.pixel_shuffle(self._conv(u, "outc"), 2)
        return residual + f.interpolate(color[:, :3], scale_factor=2, mode="bilinear", align_corners=False)

    def _history(self, x: Any) -> Any:
        for name in ("convHis1", "convHis2", "convHis3"):
            x = self._chain(x, name, (2, 1, 1))
        return self._gated(x.reshape(1, 96, *x.shape[-2:]), "lowlevelGated")

    def _erm(self, x4: Any, gbuffer: Any, mask: Any) -> Any:
        f, m = (self._f.interpolate(x, scale_factor=0.125, mode="bilinear", align_corners=False) for x in (gbuffer, mask))
        light = self._chain(self._torch.cat([x4, f], 1), "latentEncoder", (1, 1, 1), last_relu=False) * m
        material = self._f.normalize(self._chain(f, "KEncoder", (1, 1, 1), last_relu=False))
        return self._attend(material, material * m, light)

    def _attend(self, query: Any, key: Any, value: Any) -> Any:
        height, width = query.shape[-2:]
        key, value = (self._f.pad(x, (2, 2, 2, 2)) for x in (key, value))
        total = weight_sum = 0.0
        for v in range(5):
            for u in range(5):
                weight = (key[..., v : v + height, u : u + width] * query).sum(1, keepdim=True).relu()
                total = total + weight * value[..., v : v + height, u : u + width]
                weight_sum = weight_sum + weight
        return total / self._torch.clamp(weight_sum, min=1e-6)

    def _down(self, x: Any, name: str) -> Any:
        x = self._gated(x, f"{name}.downsample", 2)
        return self._f.relu(self._gated(self._f.relu(self._gated(x, f"{name}.conv1")), f"{name}.conv2"))

    def _gated(self, x: Any, name: str, stride: int = 1) -> Any:
        y = self._conv(x, name, stride)
        return y[:, :-1] * y[:, -1:].sigmoid()

    def _chain(self, x: Any, name: str, layers: tuple[int, ...], *, last_relu: bool = True) -> Any:
        for i, stride in enumerate(layers):
            x = self._conv(x, f"{name}.{2 * i}", stride)
            if last_relu or i < len(layers) - 1:
                x = self._f.relu(x, inplace=True)
        return x

    def _conv(self, x: Any, name: str, stride: int = 1) -> Any:
        weight = self._tensors[f"{name}.weight"]
        return self._f.conv2d(x, weight, self._tensors[f"{name}.bias"], stride, weight.shape[-1] // 2)
