# SPDX-License-Identifier: MIT
"""Pack weights in the form that kernels read: channels padded to multiples of 8, outputs last, transformed for Winograd."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stss_cl.device.buffers import from_bfloat16, to_bfloat16
from stss_cl.device.grid import ceil8
from stss_cl.device.matrix_units import HELD, PARTS, arrange
from stss_cl.liveness import is_tiny
from stss_ref.weights import Tensors

POINTS = {4: (0.625, -0.625, 1.5, -1.5, 0.0), 2: (1.0, -1.0, 0.0)}
"""The points of F(4x4, 3x3) and F(2x2, 3x3), besides infinity. All constants are exact in float32, and the errors of F(4x4, 3x3) are 2
to 3 times smaller than with 0, +-1, +-2."""


def winograd_matrix(side: int) -> NDArray[np.float64]:
    """``G`` (side + 2, 3) at stride 1: row j is ``[1, x_j, x_j^2] / prod_{k != j} (x_j - x_k)``, the last one ``[0, 0, 1]``."""
    points = POINTS[side]
    rows = [np.array([1.0, x, x * x]) / np.prod([x - other for other in points if other != x]) for x in points]
    return np.array([*rows, [0.0, 0.0, 1.0]])


EVERY_SECOND = np.array([[1.0, 0, 0], [1, 0, 1], [0, 0, 1], [0, 1, 0], [0, 1, 0]])
"""``G`` at stride 2, for tiles of 2: the outer taps by F(2, 2) on 0, 1 and infinity; the middle tap is for the inputs between."""


@dataclass(frozen=True)
class PackedLayer:
    """One layer's tensors, float32.

    ``direct`` (k, k, IN, OUT), ``gate_direct`` (k, k, IN, 1) or None, ``bias`` (OUT), ``gate_bias``. Inputs after the first ``used``
    are padding.
    """

    direct: NDArray[np.float32]
    gate_direct: NDArray[np.float32] | None
    bias: NDArray[np.float32]
    gate_bias: float
    used: int


def pack(weights: Tensors, name: str, inputs: tuple[tuple[int, int], ...]) -> PackedLayer:
    """Pack the layer ``name``.

    Args:
        weights: the 92 tensors.
        name: module path; gated if ``name.conv_feature.weight`` is there.
        inputs: channels of each input, and channels of the buffer that holds it.

    Returns:
        The packed tensors; outputs padded to a multiple of 8 by zeros.
    """
    gated = f"{name}.conv_feature.weight" in weights
    feature = f"{name}.conv_feature" if gated else name
    weight = _spread(weights[f"{feature}.weight"], inputs)
    outputs = weight.shape[0]
    weight = np.pad(weight, ((0, ceil8(outputs) - outputs), (0, 0), (0, 0), (0, 0)))
    bias = np.pad(weights[f"{feature}.bias"], (0, ceil8(outputs) - outputs))
    gate = _spread(weights[f"{name}.conv_mask.0.weight"], inputs) if gated else None
    return PackedLayer(
        direct=_direct(weight),
        gate_direct=None if gate is None else _direct(gate),
        bias=bias.astype(np.float32),
        gate_bias=float(weights[f"{name}.conv_mask.0.bias"][0]) if gated else 0.0,
        used=sum(size for _, size in inputs[:-1]) + inputs[-1][0],
    )


def pack_outc(weights: Tensors) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The 1 x 1 convolution outc as kernels/decoder.clh reads it: (24, 16) and (16), output channel 4c + 2i + j at 8i + 3j + c."""
    weight, bias = np.zeros((24, 16), np.float32), np.zeros(16, np.float32)
    places = [8 * i + 3 * j + c for c in range(3) for i in range(2) for j in range(2)]
    outc = weights["outc.weight"][:, :, 0, 0].T  # no rows if the layer before it is left out
    weight[: len(outc), places], bias[places] = outc, weights["outc.bias"]
    return weight, bias


def amx_outc(weight: NDArray[np.float32]) -> NDArray[np.uint16]:
    """`pack_outc`'s weights as conv_amx.cl reads them: (2, 16, 16, 2), rounded to bfloat16, and the remainders of that rounding."""
    rows = np.pad(weight, ((0, 32 - len(weight)), (0, 0)))
    upper = to_bfloat16(rows)
    both = np.stack([upper, to_bfloat16(rows - from_bfloat16(upper))])
    return np.ascontiguousarray(both.reshape(2, 16, 2, 16).swapaxes(2, 3))


def _spread(weight: NDArray[Any], inputs: tuple[tuple[int, int], ...]) -> NDArray[Any]:
    """Spread the inputs' channels: each input at the start of its buffer's channels, zeros behind it."""
    spread = np.zeros((weight.shape[0], sum(size for _, size in inputs), *weight.shape[2:]), weight.dtype)
    source = target = 0
    for channels, size in inputs:
        spread[:, target : target + channels] = weight[:, source : source + channels]
        source, target = source + channels, target + size
    return spread


def _direct(weight: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(weight.transpose(2, 3, 1, 0), np.float32)


def in_lanes(packed: PackedLayer, vector: int) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
    """The outputs' kernels, padded to whole vectors, and the gate's kernel unless it is in the first lane behind the outputs."""
    outputs = packed.direct.shape[-1]
    empty = -outputs % vector
    if not empty:
        return packed.direct, packed.gate_direct
    behind = [] if packed.gate_direct is None else [packed.gate_direct]
    lanes = np.concatenate([packed.direct, *behind], axis=-1)
    return np.pad(lanes, ((0, 0), (0, 0), (0, 0), (0, outputs + empty - lanes.shape[-1]))), None


def pair_inputs(transformed: NDArray[np.float32], outputs: int) -> NDArray[np.float32]:
    """Rearrange a result of `winograd` of one block: the last 8 ``outputs`` of two inputs share a vector (``-D PAIRED``)."""
    whole, last = transformed[..., : outputs - 8], transformed[..., outputs - 8 : outputs]
    one, two = slice(0, None, 2), slice(1, None, 2)
    both = np.stack([last[:, :, one], last[:, :, two]], axis=-1).reshape(*last[:, :, one].shape[:-1], 16)
    return np.concatenate([whole[:, :, one], whole[:, :, two], both], axis=-1)


def winograd(kernels: NDArray[np.float32], side: int, block: int, stride: int = 1) -> NDArray[np.float32]:
    """Kernels of 3 x 3 as winograd.cl reads them, transformed in float64.

    Args:
        kernels: (3, 3, IN, OUT), as in `PackedLayer`.
        side: of a tile; 2 at stride 2.
        block: outputs that are read together, a divisor of OUT.
        stride: 1 or 2.

    Returns:
        ((side + 2)^2, OUT / block, IN, block), at stride 2 (25, ...): in the order in which the kernel reads.
    """
    g = winograd_matrix(side) if stride == 1 else EVERY_SECOND
    rows = np.tensordot(g, kernels.astype(np.float64), (1, 0))
    transformed = np.tensordot(g, rows, (1, 1)).swapaxes(0, 1)
    transformed[is_tiny(transformed)] = 0  # where taps cancel
    blocks = transformed.reshape(len(g) ** 2, kernels.shape[2], -1, block).swapaxes(1, 2)
    return np.ascontiguousarray(blocks, np.float32)


def amx_tiles(packed: PackedLayer, first: int) -> NDArray[np.uint16]:
    """Kernels of 3 x 3 and their gate as conv_amx.cl reads them, in bfloat16.

    Args:
        packed: the layer.
        first: channels of its first input.

    Returns:
        (steps, PARTS, 16, 16, 2): of one input after the other the rows of taps, each filled up to whole steps of 32 values; of 24 channels
        each tap is a step.
    """
    gate = [] if packed.gate_direct is None else [packed.gate_direct]
    weight = np.concatenate([packed.direct, *gate], axis=-1)
    weight = np.pad(weight, (*3 * [(0, 0)], (0, -weight.shape[-1] % 16)))
    tiles: list[NDArray[np.float32]] = []
    for part in (weight[:, :, :first], weight[:, :, first:]):
        taps = np.pad(part, (*2 * [(0, 0)], (0, 8 if part.shape[2] == 24 else 0), (0, 0)))
        rows = taps.reshape(3, -1, part.shape[-1])
        steps = np.pad(rows, ((0, 0), (0, -rows.shape[1] % 32), (0, 0))).reshape(-1, 16, 2, part.shape[-1] // 16, 16)
        tiles.append(steps.transpose(0, 3, 1, 4, 2))
    return to_bfloat16(np.concatenate(tiles))


def amx_bias(packed: PackedLayer) -> NDArray[np.float32]:
    """The biases of the outputs and of the gate behind them, filled up to whole tiles."""
    bias = packed.bias if packed.gate_direct is None else np.append(packed.bias, np.float32(packed.gate_bias))
    return np.pad(bias, (0, -len(bias) % 16))


def fragments(packed: PackedLayer, eights: int, block: int) -> NDArray[np.float16]:
    """Kernels of 3 x 3 and their gate as conv_mma.cl reads them, in half.

    Args:
        packed: the layer; its channels are multiples of 8.
        eights: of input channels that are in local memory at once.
        block: outputs of a work-group.

    Returns:
        (OUT / block, chunks, steps, matrices, 16 * PARTS * HELD): for each product what `arrange` makes. The inner dimension runs over
        channels within taps within chunks, 16 to a step. A matrix has eight outputs; the last one has the gate in each part, and zeros.
    """
    _, _, inner, outputs = packed.direct.shape
    weight = packed.direct.reshape(9, inner, outputs // block, block // (PARTS * HELD), PARTS, HELD)
    weight = np.pad(weight, [(0, 0), (0, -inner % 8), *4 * [(0, 0)]])
    if packed.gate_direct is not None:
        gate = np.zeros((*weight.shape[:3], 1, *weight.shape[4:]), weight.dtype)
        gate[..., 0] = packed.gate_direct.reshape(9, inner, 1, 1, 1)
        weight = np.concatenate([weight, gate], axis=3)
    # Tap, chunk, channel, block, matrix, part, value -> block, chunk, tap and channel, ...
    weight = weight.reshape(9, -1, 8 * eights, *weight.shape[2:]).transpose(3, 1, 0, 2, 4, 5, 6)
    weight = weight.reshape(*weight.shape[:2], 9 * eights * 8, *weight.shape[4:])
    weight = np.pad(weight, [(0, 0), (0, 0), (0, 9 * eights % 2 * 8), *3 * [(0, 0)]])
    steps = weight.reshape(*weight.shape[:2], -1, 16, *weight.shape[3:])
    return np.ascontiguousarray(arrange(np.moveaxis(steps, 4, 3)), np.float16)
