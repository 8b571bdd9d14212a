# SPDX-License-Identifier: MIT
"""Convolutions: the fast or the direct kernel, built and launched for one layer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import Padded, constant, map_bytes
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, span
from stss_cl.device.program import build
from stss_cl.device.tuning import tuning_for
from stss_cl.network.launch import FAST_MULTIPLY_ADD, Launch, Skip
from stss_cl.network.pack_weights import Packed, winograd


@dataclass(frozen=True)
class Final:
    """What the decoder's last layer needs to write the image itself (kernels/decoder.clh).

    ``color`` (rows, columns, 4), ``weight`` (24, 16) and ``bias`` (16) of outc, the frame's own height and width, and the change
    map of ``color``, if any.
    """

    color: cl.Buffer
    weight: cl.Buffer
    bias: cl.Buffer
    rows: int
    columns: int
    height: int
    width: int
    changes: cl.Buffer | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """For winograd.cl, all rows of the frame; the image's place is taken by another buffer until the caller sets it."""
        return {
            "color": self.color,
            "outc_weight": self.weight,
            "outc_bias": self.bias,
            "image": self.bias,
            "rows": np.int32(self.rows),
            "columns": np.int32(self.columns),
            "first_row": np.int32(0),
            "top": np.int32(0),
        }


def half(dtype: np.dtype[Any]) -> bool:
    """Whether activations of this dtype are stored as half."""
    return dtype == np.float16


def conv(
    device: Device,
    stage: str,
    name: str,
    packed: Packed,
    a: Padded,
    b: Padded | None,
    out: Padded,
    *,
    out_first: int = 0,
    stride: int = 1,
    relu: bool = True,
    side: int = 4,
    image: int = 0,
    final: Final | None = None,
) -> Launch:
    """A convolution of ``a`` and ``b`` side by side into channels ``out_first`` .. of ``out``.

    Args:
        device: to run on.
        stage: for the launch.
        name: for the launch.
        packed: the layer's tensors.
        a: first input; its image ``image`` is read.
        b: second input, if any.
        out: the output; its size is the input's over ``stride``.
        out_first: its first channel written.
        stride: 1 or 2.
        relu: whether ReLU follows.
        side: of the fast variant's tiles at stride 1, 4 or 2, at stride 2 they are 2; 0: the plain variant. Where there is no fast one it
            is the plain one in any case.
        image: which of ``a``'s images.
        final: write ``image`` instead of ``out``; the caller sets it before every run.
    """
    fast = side > 0 and a.channels % 8 == 0 and packed.direct.shape[0] == 3 and tuning_for(device).winograd is not None
    if fast:
        shape = _winograd(device, packed, out, side if stride == 1 else 2, stride, final)
    else:
        shape = _direct(device, packed, out, stride, final)
    options = shape.options | {
        "A": a.channels,
        "B": b.channels if b else 0,
        "OUT": packed.direct.shape[-1],
        "GATED": packed.gate_direct is not None,
        "RELU": relu,
        "HALF": half(out.dtype),
        "IMAGE": final is not None,
    }
    kernel = cl.Kernel(build(device, shape.file, options, FAST_MULTIPLY_ADD), shape.file.removesuffix(".cl"))
    weight = constant(device, shape.weight)
    gate = weight if shape.gate is None else constant(device, shape.gate)
    arguments = {
        "a": a.data,
        "b": b.data if b else a.data,
        "weight": weight,
        "gate_weight": gate,
        "bias": constant(device, packed.bias),
        "gate_bias": np.float32(packed.gate_bias),
        "out": out.data,
        "a_first": np.int32(image * a.rows * a.columns * a.channels),
        **shape.dimensions,
        "in_columns": np.int32(a.columns),
        "out_columns": np.int32(out.columns),
        "out_channels": np.int32(out.channels),
        "out_first": np.int32(out_first),
        **(final.arguments if final else {}),
    }
    kernel.set_args(*arguments.values())
    skip = None if a.changes is None else _skip(device, shape, options, a, b, final or out, image)
    return Launch(stage, name, kernel, shape.size, shape.group, arguments, skip)


def _skip(
    device: Device, shape: _Shape, options: Mapping[str, object], a: Padded, b: Padded | None, out: Padded | Final, image: int
) -> Skip:
    maps = {
        "a_changes": a.changes,
        "b_changes": b.changes if b else a.changes,
        "color_changes" if isinstance(out, Final) else "changes": out.changes,
        "a_tile": np.int32(image * map_bytes(a.height, a.width)),
    }
    if shape.file == "winograd.cl":
        return Skip(shape.file, options, FAST_MULTIPLY_ADD, shape.size, shape.group, maps)
    pixels, group = int(shape.options["PIXELS"]), shape.group[1]
    wide, tall = span(device, pixels), 4 if device.is_cpu else 1
    size = (shape.size[0], ceil_div(ceil_div(out.width, wide), group) * group, ceil_div(out.height, tall))
    options = {**options, "SPAN": wide, "TALL": tall}
    return Skip(shape.file, options, FAST_MULTIPLY_ADD, size, shape.group, maps, {"height": np.int32(out.height)})


@dataclass(frozen=True)
class _Shape:
    """How one of the two kernels is built and launched."""

    file: str
    options: dict[str, int]
    weight: NDArray[np.float32]
    gate: NDArray[np.float32] | None
    size: tuple[int, ...]
    group: tuple[int, ...]
    dimensions: dict[str, np.int32]


def _winograd(device: Device, packed: Packed, out: Padded, side: int, stride: int, final: Final | None) -> _Shape:
    table = tuning_for(device).winograd
    assert table is not None
    row = table[packed.direct.shape[-1]]
    gate = packed.gate_direct
    return _Shape(
        file="winograd.cl",
        options={
            "STRIDE": stride,
            "SIDE": side,
            "USED": packed.used,
            "TILES": row.tiles,
            "ROWS": row.rows,
            "BLOCK": row.block,
            "PREFETCH": row.prefetch and device.takes_prefetch,
        },
        weight=winograd(packed.direct, side, 8 * row.block, stride),
        gate=None if gate is None else winograd(gate, side, 1, stride),
        size=(ceil_div(ceil_div(out.width, side), row.tiles), ceil_div(out.height, side)),
        group=(1, 1),
        dimensions={"height": np.int32((final or out).height), "width": np.int32((final or out).width)},
    )


def _direct(device: Device, packed: Packed, out: Padded, stride: int, final: Final | None) -> _Shape:
    assert final is None
    kernel, _, _, outputs = packed.direct.shape
    row = tuning_for(device).direct[outputs]
    columns = ceil_div(ceil_div(out.width, row.pixels), row.group) * row.group
    return _Shape(
        file="conv.cl",
        options={"KERNEL": kernel, "STRIDE": stride, "PIXELS": row.pixels, "BLOCK": row.block, "GROUP": row.group},
        weight=packed.direct,
        gate=packed.gate_direct,
        size=(outputs // 8 // row.block, columns, out.height),
        group=(1, row.group, 1),
        dimensions={"width": np.int32(out.width)},
    )
