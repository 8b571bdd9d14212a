# SPDX-License-Identifier: MIT
"""ExtraNet with its authors' own weights: ``Model/medieval.pth.tar`` of github.com/fuxihao66/ExtraNet, which names no licence.

It is fetched to be measured and never copied. The module is written from the paper and the tensors' names. They trained on one scene of
Unreal; a frame of ours is converted as by their loader and their inference: linear colour by base colour (0 where that is 0),
``log(1 + x)``; depth 0 and normal -1 in the sky. The sky, and surfaces without base colour, keep the warped colour, where theirs is given.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from pickle import UnpicklingError
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from stss.frames.buffers import Buffers
from stss.frames.display_frame import DisplayFrame, frame_inputs
from stss.images.color import Transfer
from stss_ground.errors import InputError
from stss_ref.arrays import Image, Mask
from stss_ref.frame import prepare
from training.network import Gated, enlarge


def _normed(*channels: int, stride: int = 1) -> nn.Sequential:
    """As `training.rivals.networks.chain`, each convolution followed by a batch's norm."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(pairwise(channels)):
        layers += [nn.Conv2d(inputs, outputs, 3, 1 if i else stride, 1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


class _Down(nn.Module):
    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.downsample, self.conv1, self.conv2 = Gated(inputs, inputs, 2), Gated(inputs, outputs), Gated(outputs, outputs)
        self.bn1, self.bn2 = nn.BatchNorm2d(outputs), nn.BatchNorm2d(outputs)

    def forward(self, x: Tensor) -> Tensor:
        x = self.bn1(self.conv1(self.downsample(x))).relu()
        return self.bn2(self.conv2(x)).relu()


class _Up(nn.Module):
    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = nn.Module()
        self.conv.add_module("double_conv", _normed(inputs, inputs // 2, outputs))

    def forward(self, skip: Tensor, x: Tensor) -> Tensor:
        return cast(nn.Sequential, self.conv.double_conv)(torch.cat([skip, enlarge(x)], 1))


class AuthorsExtraNet(nn.Module):
    """Their network, with the names of their tensors; for use, not for training."""

    def __init__(self):
        super().__init__()
        self.convHis1 = _normed(4, 24, 24, 24, stride=2)
        self.convHis2 = _normed(24, 32, 32, 32, stride=2)
        self.convHis3 = _normed(32, 32, 32, 32, stride=2)
        self.lowlevelGated = Gated(96, 32)
        self.conv1, self.bn1 = Gated(18, 24), nn.BatchNorm2d(24)
        self.conv2, self.bn2 = Gated(24, 24), nn.BatchNorm2d(24)
        self.down1, self.down2, self.down3 = _Down(24, 24), _Down(24, 32), _Down(32, 32)
        self.up1, self.up2, self.up3 = _Up(96, 32), _Up(56, 24), _Up(48, 24)
        self.outc = nn.Conv2d(24, 3, 1)

    def forward(self, color: Tensor, mask: Tensor, features: Tensor, history: Tensor) -> Tensor:
        """The frame's light, ``log(1 + x)``, (1, 3, H, W). H and W are multiples of 8.

        Args:
            color: (1, 6, H, W) the newest frame as it was warped, and with its holes filled.
            mask: (1, 1, H, W) 0 in holes.
            features: (1, 6, H, W) normal 3, depth, roughness, metallic.
            history: (3, 4, H, W) three earlier frames, warped, each with its mask, oldest first.
        """
        embedded = self.convHis3(self.convHis2(self.convHis1(history)))
        feature = self.lowlevelGated(embedded.flatten(0, 1)[None])
        x1 = self.bn1(self.conv1(torch.cat([color, color * mask, features], 1))).relu()
        x1 = self.bn2(self.conv2(x1)).relu()
        x2 = self.down1(x1)
        x3 = self.down2(x2)
        x = self.up1(x3, torch.cat([self.down3(x3), feature], 1))
        return self.outc(self.up3(x1, self.up2(x2, x))) + color[:, :3]


def load_authors(path: Path) -> AuthorsExtraNet:
    """Load their checkpoint, without executing it.

    Raises:
        InputError: the file can't be read or holds other tensors.
    """
    network = AuthorsExtraNet()
    try:
        network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True)["state_dict"])
    except (OSError, RuntimeError, KeyError, ValueError, UnpicklingError) as error:
        raise InputError(f"{path}: expected medieval.pth.tar of fuxihao66/ExtraNet ({str(error).splitlines()[0]})") from error
    return network.eval().requires_grad_(False)


def extrapolate(
    network: Callable[[Tensor, Tensor, Tensor, Tensor], Tensor],
    window: Sequence[DisplayFrame],
    steps: tuple[int, int, int],
    read: Callable[[int], Buffers],
    curve: Transfer,
) -> Image:
    """The small EF (H, W, 3), display-referred.

    Args:
        network: an `AuthorsExtraNet`.
        window, steps: see `stss.frames.backends.Backend.compute`.
        read: a frame's buffers, by its number.
        curve: to what a screen shows.
    """
    there = {frame.number: read(frame.number) for frame in (window[-1], *(window[-1 - step] for step in steps))}
    now, inputs = there[window[-1].number], frame_inputs(window, steps)
    light = np.stack([divide(there[window[-1 - step].number]) for step in steps])
    prepared = prepare(replace(inputs, colors=light))
    sky = ~np.isfinite(now.depth) | (now.depth >= 1e9)
    planes: Mapping[str, Image] = {
        "color": np.log1p(np.concatenate([prepared.color[..., 3:], prepared.color[..., :3]], axis=-1)),
        "mask": prepared.mask[..., None],
        "features": np.concatenate([np.where(sky[..., None], -1, now.normal), _depth(now.depth, sky), *_surface(now)], axis=-1),
    }
    history = prepared.history.copy()
    history[..., :3] = np.log1p(history[..., :3])
    height, width = sky.shape
    edges = ((0, 0), (0, -height % 8), (0, -width % 8), (0, 0))
    planes_in = [np.pad(plane[None], edges, mode="edge") for plane in planes.values()] + [np.pad(history, edges, mode="edge")]
    with torch.inference_mode():
        output = network(*(torch.from_numpy(np.moveaxis(x, -1, 1).astype(np.float32)) for x in planes_in))[0].numpy()
    color = np.expm1(np.moveaxis(output, 0, -1)[:height, :width]).clip(0) * now.base_color
    unlit = sky | (now.base_color == 0).all(axis=-1)
    warped = curve.encode(np.where(unlit[..., None], 0, color).astype(np.float32))
    return np.where(unlit[..., None], prepare(inputs).color[..., :3], warped)


def divide(buffers: Buffers) -> Image:
    """(H, W, 3) linear colour by base colour; 0 where that is 0."""
    assert buffers.color is not None
    base = buffers.base_color
    return np.where(base > 0, buffers.color / np.where(base > 0, base, 1), 0).astype(np.float32)


def _depth(depth: Image, sky: Mask) -> Image:
    """(H, W, 1) from 0 to 1 over the frame, the sky as near as nothing is."""
    near = np.where(sky, 0, depth)
    return ((near - near.min()) / (near.max() - near.min() + 1e-6))[..., None]


def _surface(buffers: Buffers) -> tuple[Image, Image]:
    return buffers.roughness[..., None], buffers.metallic[..., None]
