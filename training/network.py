# SPDX-License-Identifier: MIT
"""STSSNet as a trainable module. Its parameters have the names of the specification's 92 tensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import ClassVar, Literal, cast

import numpy as np
import torch
from torch import Tensor, nn

from stss_cl.graph import GRAPH, Node, divisor_of, evaluate, nodes
from stss_cl.liveness import find_live
from stss_ref.constants import HoleFill
from stss_ref.weights import LAYERS, TENSORS, Layer, SecondColor, Weights, check

Without = Literal["", "history", "deep"]
"""The parts that are not computed: none; the history, whose features are then the same everywhere (`hold_history`); or all
below half size, which `training.prune` made constant."""


HISTORY = "lowlevelGated"
"""The layer whose result is the history's feature."""

FEATURES = {"reshaded": "reshaded", "feature": HISTORY, "up1": "up1.conv.double_conv.2", "up2": "up2.conv.double_conv.2"}
"""Results that `Heads` read: by the names of heads, their names in the graph."""


def _shallow() -> Iterator[Layer]:
    """The layers from half size on, with their inputs of it."""
    for layer in LAYERS:
        if layer.component == "backbone" and layer.divisor <= 2:
            yield replace(layer, reads=tuple(name for name in layer.reads if divisor_of(name) <= 2))


GRAPHS: Mapping[Without, Sequence[Node]] = {
    "": GRAPH,
    "history": tuple(nodes({layer.name: layer for layer in LAYERS if layer.component != "history"})),
    "deep": tuple(nodes({layer.name: layer for layer in _shallow()})),
}
"""The nodes that are computed; without ``history``, its feature is known."""


class Rectifier(nn.Module):
    """ReLU, or a leaky ReLU during training: see `leak`."""

    def __init__(self):
        super().__init__()
        self.slope = 0.0

    def forward(self, x: Tensor) -> Tensor:
        """``max(x, 0) + slope min(x, 0)``."""
        return nn.functional.leaky_relu(x, self.slope) if self.slope else nn.functional.relu(x)


class Gated(nn.Module):
    """``conv(x) * sigmoid(gate(x))`` (spec 7, ``G``), computed as one convolution.

    The gate's kernel is there once for each channel. Then all that follows goes channel by channel, back and forth, which is faster
    than one gate for all, whose gradient is a sum over the channels. Without gradients (`eval`) the one gate is faster.
    """

    def __init__(self, inputs: int, outputs: int, stride: int = 1):
        super().__init__()
        self.stride = stride
        self.conv_feature = nn.Conv2d(inputs, outputs, 3, stride, 1)
        self.conv_mask = nn.Sequential(nn.Conv2d(inputs, 1, 3, stride, 1))

    def forward(self, x: Tensor) -> Tensor:
        """(N, outputs, H / stride, W / stride)."""
        feature, gate = self.conv_feature, cast(nn.Conv2d, self.conv_mask[0])
        channels = feature.out_channels
        gates = channels if self.training else 1
        weight = torch.cat([feature.weight, gate.weight.expand(gates, -1, -1, -1)])
        bias = torch.cat([_bias(feature), _bias(gate).expand(gates)])
        y, logits = nn.functional.conv2d(x, weight, bias, self.stride, 1).split((channels, gates), 1)
        return y * logits.sigmoid()


def _bias(convolution: nn.Conv2d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias


def enlarge(x: Tensor) -> Tensor:
    """Twice the size, bilinear with corners aligned, (N, C, 2H, 2W). In training by matrices: the gradient of PyTorch's own is slow."""
    if not x.requires_grad:
        return nn.functional.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
    n, channels, height, width = x.shape
    down, across = _enlarging(height, x), _enlarging(width, x)
    rows = down @ x.permute(0, 2, 3, 1).reshape(n, height, width * channels)
    pixels = across @ rows.reshape(n * 2 * height, width, channels)
    return pixels.reshape(n, 2 * height, 2 * width, channels).permute(0, 3, 1, 2)


def _enlarging(length: int, like: Tensor) -> Tensor:
    """(2 length, length): each row weighs the two nearest of ``length``; in bfloat16 rounded so that a row still sums to 1."""
    place = torch.arange(2 * length, dtype=torch.float32, device=like.device) * ((length - 1) / (2 * length - 1))
    rows = (1 - (place[:, None] - torch.arange(length, device=like.device)).abs()).relu()
    return (rows.mul(256).round() / 256 if like.dtype == torch.bfloat16 else rows).to(like.dtype)


class Network(nn.Module):
    """STSSNet on batches. H and W are multiples of 8. Its layers and their inputs are those of `stss_cl.graph`.

    Source: spec 7, 8; paper, Fig. 5.

    Args:
        without: the part that is left out.
        second_color: see `stss_ref.frame.prepare`; which of both is read where a batch has both.
    """

    def __init__(self, without: Without = "", second_color: SecondColor = "newest"):
        super().__init__()
        self.without: Without = without
        self.second_color: SecondColor = second_color
        for layer in LAYERS:
            sizes = layer.inputs, layer.outputs
            module = (
                Gated(*sizes, layer.stride) if layer.gated else nn.Conv2d(*sizes, layer.kernel, layer.stride, layer.kernel // 2)
            )
            _place(self, layer.name, module)
        self.rectifier = Rectifier()

    def forward(self, color: Tensor, gbuffer: Tensor, mask: Tensor, history: Tensor) -> Tensor:
        """Image (N, 3, 2H, 2W); arguments as for `residual`."""
        return self.residual(color, gbuffer, mask, history)[0] + base(color)

    def residual(self, color: Tensor, gbuffer: Tensor, mask: Tensor, history: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The image less its `base`, (N, 3, 2H, 2W), and the features that `Heads` read.

        Args:
            color: (N, 6, H, W), or (N, 9, H, W) of a `training.augment.Batch`.
            gbuffer: (N, 9, H, W).
            mask: (N, 1, H, W).
            history: (N, 3, 4, H, W).
        """
        if color.shape[1] > 6:
            color = color[:, :6] if self.second_color == "newest" else torch.cat([color[:, :3], color[:, 6:]], 1)
        results_before = {HISTORY: self.embed(history)} if self.without == "history" else {}
        results = evaluate(self, color, gbuffer, mask, history.flatten(0, 1), GRAPHS[self.without], results_before)
        features = {feature: results[name] for feature, name in FEATURES.items() if name in results}
        return nn.functional.pixel_shuffle(results[GRAPH[-1].name], 2), features

    def embed(self, history: Tensor) -> Tensor:
        """The feature of a history that is not read, (N, 32, H/8, W/8): the same everywhere."""
        gated = cast(Gated, self.get_submodule(HISTORY))
        bias, gate = _bias(gated.conv_feature), _bias(cast(nn.Conv2d, gated.conv_mask[0]))
        n, _, _, height, width = history.shape
        return (bias * gate.sigmoid()).view(1, -1, 1, 1).expand(n, -1, height // 8, width // 8)

    def convolve(self, x: Tensor, layer: Layer) -> Tensor:
        """A layer with its gate and its ReLU; the kernels of inputs that are left out are left out, too."""
        convolution = self.get_submodule(layer.name)
        if isinstance(convolution, nn.Conv2d) and x.shape[1] < convolution.in_channels:
            y = nn.functional.conv2d(x, convolution.weight[:, : x.shape[1]], convolution.bias, padding=layer.kernel // 2)
        else:
            y = convolution(x)
        return self.rectifier(y) if layer.relu else y

    def upsample(self, x: Tensor) -> Tensor:
        """Twice the size, corners aligned."""
        return enlarge(x)

    def reduce(self, x: Tensor) -> Tensor:
        """An eighth of the size."""
        return nn.functional.interpolate(x, scale_factor=0.125, mode="bilinear", align_corners=False)

    def attend(self, light: Tensor, material: Tensor, mask: Tensor) -> Tensor:
        """The ERM's result (N, 64, H/8, W/8) (spec 8)."""
        query = nn.functional.normalize(material, eps=1e-12)
        return _attend(query, query * mask, light * mask)

    def multiply(self, x: Tensor, y: Tensor) -> Tensor:
        """The product."""
        return x * y

    def join(self, values: Sequence[Tensor]) -> Tensor:
        """Concatenate along the channels."""
        return torch.cat([*values], 1) if len(values) > 1 else values[0]

    def join_images(self, x: Tensor) -> Tensor:
        """(3 N, C, H, W) to (N, 3 C, H, W)."""
        return x.unflatten(0, (-1, 3)).flatten(1, 2)


def _place(network: nn.Module, name: str, layer: nn.Module) -> None:
    """Make ``layer`` the submodule ``name`` of ``network``, so that its tensors have the specification's names."""
    *above, last = name.split(".")
    for part in above:
        if not hasattr(network, part):
            network.add_module(part, nn.Module())
        network = network.get_submodule(part)
    network.add_module(last, layer)


def base(color: Tensor) -> Tensor:
    """The image without the residual: the first three channels of the colour (N, 6, H, W) at twice the size."""
    return nn.functional.interpolate(color[:, :3], scale_factor=2, mode="bilinear", align_corners=False)


def _attend(query: Tensor, key: Tensor, value: Tensor) -> Tensor:
    """Means of ``value`` (N, C, H, W) over 5 x 5 pixels; of all pairs of pixels, far ones blanked: the fastest way for small pictures."""
    n, _, height, width = query.shape
    query, key, value = (x.flatten(2).transpose(1, 2) for x in (query, key, value))
    weight = (query @ key.transpose(1, 2)).relu() * _near(height, width, query)
    total = weight.to(value.dtype) @ value
    return (total / weight.sum(2, keepdim=True).clamp(min=1e-6)).transpose(1, 2).reshape(n, -1, height, width)


def _near(height: int, width: int, like: Tensor) -> Tensor:
    """1 for each two of height x width pixels that are at most 2 apart in either direction, (H W, H W)."""
    place = torch.arange(height * width, device=like.device)
    y, x = place // width, place % width
    far = torch.maximum((y[:, None] - y).abs(), (x[:, None] - x).abs())
    return (far <= 2).to(like.dtype)


class Heads(nn.ModuleDict):
    """Layers that compute a colour from each deep feature, only in the first half of a training run; they are not part of the network.

    The shallow path learns first, and the deep features are noise to it then: its ReLUs shut them out, and with them the wider view,
    the history and the ERM. If the deep features must predict the truth themselves (Lee et al. 2015, Deeply-Supervised Nets), they
    are useful by the time the shallow path needs them.
    """

    CHANNELS: ClassVar = {"reshaded": 64, "feature": 32, "up1": 32, "up2": 24}

    def __init__(self):
        super().__init__({name: nn.Conv2d(channels, 3, 1) for name, channels in self.CHANNELS.items()})

    def forward(self, features: dict[str, Tensor]) -> list[Tensor]:
        """Pictures (N, 3, h, w), each at its feature's size."""
        return [self[name](feature) for name, feature in features.items()]


def leak(network: nn.Module, slope: float) -> None:
    """Let every ReLU of ``network`` multiply negative numbers by ``slope`` instead of 0.

    A unit that is 0 everywhere gets no gradient and stays 0: with small batches, and with Adam's full-sized steps along noise, two
    thirds of the decoder's first layer died. A leaky unit recovers. The slope falls to 0 during the run, so that the network trained in
    the end is the specification's.
    """
    for module in network.modules():
        if isinstance(module, Rectifier):
            module.slope = slope


def load_weights(network: Network, weights: Weights) -> None:
    """Copy the specification's 92 tensors into ``network``, which gets their second colour, too, and leaves out what they do not read."""
    network.load_state_dict({name: torch.from_numpy(np.array(tensor)) for name, tensor in weights.items()})
    network.second_color = weights.second_color
    if "down2.conv2" not in find_live(weights).layers:
        network.without = "deep"


def to_weights(tensors: dict[str, Tensor], second: SecondColor = "newest", hole_fill: HoleFill = "occlusion_warp") -> Weights:
    """The tensors of a state dict as the specification's 92 arrays, checked; second colour and hole fill as in training."""
    arrays = {name: tensors[name].detach().float().cpu().contiguous().numpy() for name in TENSORS}
    return check(Weights(arrays, second, hole_fill=hole_fill))
