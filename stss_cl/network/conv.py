# SPDX-License-Identifier: MIT
"""Convolutions: the fast or the direct kernel, built and launched for one layer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from stss_cl.device import amx, matrix_units
from stss_cl.device.buffers import FeatureMap, constant, storage
from stss_cl.device.conversion import storage_options
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil_div, list_size
from stss_cl.device.tuning import tuning_for
from stss_cl.network import conv_gpu
from stss_cl.network.layer import FAST, KernelSource, LayerLaunch, Shape, Work, layer
from stss_cl.network.pack_weights import PackedLayer, amx_bias, amx_tiles, in_lanes, pair_inputs, winograd
from stss_cl.network.tiles import Maps, Tiling, of_convolution


@dataclass(frozen=True)
class Final:
    """The data that the decoder's last layer needs to write the image itself (winograd_image.cl, conv_amx.cl with IMAGE).

    ``color`` is (rows, columns, 4); ``weight`` (24, 16) and ``bias`` (16) are outc's; ``height`` and ``width`` are the frame's before
    padding; ``changes`` is the change map of ``color``, if any.
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
        """The kernel's arguments for all rows of the frame but ``image``, which the caller sets."""
        return {
            "color": self.color,
            "outc_weight": self.weight,
            "outc_bias": self.bias,
            "rows": self.rows,
            "columns": self.columns,
            "first_row": 0,
            "top": 0,
        }


@dataclass(frozen=True)
class ConvSpec:
    """A convolution, without its inputs and outputs.

    Attributes:
        stage: the stage that it belongs to.
        name: its name.
        packed: its tensors.
        stride: 1 or 2.
        relu: whether ReLU follows.
        side: side of Winograd's tiles, 4 or 2 at stride 1, 2 at stride 2; 0: the plain kernel, which also runs if no faster one can.
    """

    stage: str
    name: str
    packed: PackedLayer
    stride: int = 1
    relu: bool = True
    side: int = 4


def conv(
    device: Device,
    spec: ConvSpec,
    a: FeatureMap,
    b: FeatureMap | None,
    out: FeatureMap,
    *,
    out_first: int = 0,
    image: int | None = 0,
    final: Final | None = None,
) -> LayerLaunch:
    """Make a convolution of ``a`` and ``b`` side by side into channels ``out_first`` .. of ``out``.

    Args:
        device: to run on.
        spec: the convolution.
        a: first input; its image ``image`` is read.
        b: second input, if any.
        out: the output; its size is the input's divided by the stride.
        out_first: the first channel of it to write.
        image: the image of ``a`` to read; None: all of them in one launch, if work-groups share local memory, into the images of ``out``,
            or, if it has one image, into channels one behind the other.
        final: write ``image`` instead of ``out``; the caller sets it before every run.
    """
    packed = spec.packed
    shape = _shape(device, spec, a, out, final, a.images if image is None else 1)
    source = _source(device, shape, packed, a, b, out, relu=spec.relu)
    arguments = {
        "a": a.data,
        "b": b.data if b else a.data,
        **_tensors(device, packed, shape),
        **(final.arguments if final else {"out": out.data}),
        "a_first": (image or 0) * a.rows * a.columns * a.channels,
        "height": (final or out).height,
        "width": (final or out).width,
        "in_columns": a.columns,
        "out_columns": out.columns,
        "out_channels": out.channels,
        "out_first": out_first,
        **_from_image_to_image(a, out, packed, shape),
    }
    maps = _maps(a, image or 0, b or final)
    work = Work(shape.tiling, shape.size, shape.group)
    return layer(device, spec.stage, spec.name, source, arguments, work, maps, None if final else out)


def _from_image_to_image(a: FeatureMap, out: FeatureMap, packed: PackedLayer, shape: Shape) -> dict[str, int]:
    """The distance between two images: in values of the input and of the output, pixels of the change map, rows of tiles."""
    several = out.images > 1
    return {
        "a_next": a.rows * a.columns * a.channels,
        "out_next": out.rows * out.columns * out.channels if several else packed.direct.shape[-1],
        "map_next": (out.rows - 2) * (out.columns - 2) if several else 0,
        "tile_rows": shape.tiling.rows,
    }


def _tensors(device: Device, packed: PackedLayer, shape: Shape) -> dict[str, Any]:
    weight = constant(device, shape.weight)
    return {
        "weight": weight,
        "gate_weight": weight if shape.gate is None else constant(device, shape.gate),
        "bias": constant(device, packed.bias if shape.bias is None else shape.bias),
        "gate_bias": float(packed.gate_bias),
    }


def _source(
    device: Device, shape: Shape, packed: PackedLayer, a: FeatureMap, b: FeatureMap | None, out: FeatureMap, *, relu: bool
) -> KernelSource:
    """The source and options from which the layer's kernel is built."""
    options = {
        "A": a.channels,
        "B": b.channels if b else 0,
        "OUT": packed.direct.shape[-1],
        **({"OUT_CHANNELS": out.channels} if "SIDE" in shape.options else {}),
        "GATED": packed.gate_direct is not None,
        "RELU": relu,
        **storage_options(device, out.dtype),
    }
    return KernelSource(
        shape.file,
        shape.file.removesuffix(".cl"),
        {**shape.options, **options},
        FAST,
    )


def _shape(device: Device, spec: ConvSpec, a: FeatureMap, out: FeatureMap, final: Final | None, images: int) -> Shape:
    """The fastest kernel for this layer by the row of tile sizes; the plain one for side 0."""
    packed, stride, side = spec.packed, spec.stride, spec.side
    tuning, whole_eights = tuning_for(device), a.channels % 8 == 0
    if storage(out.dtype) == "BFLOAT16":
        return _on_amx(device, packed, a, final or out, stride, image=final is not None)
    if side == 0 or packed.direct.shape[0] != 3:
        return _direct(device, packed, out, stride, final)
    if tuning.winograd is not None and whole_eights:
        return _winograd(device, packed, out, side if stride == 1 else 2, stride, final)
    if tuning.local is not None:
        takes = whole_eights or (a.channels == 4 and packed.gate_direct is None)
        if tuning.local.matrix_units and storage(out.dtype) == "HALF" and takes and matrix_units.prove(device):
            return conv_gpu.on_matrix_units(device, packed, out, stride, tuning.local.rows, images)
        return conv_gpu.local(device, packed, out, stride, tuning.local.rows, images)
    return _direct(device, packed, out, stride, final)


def _on_amx(device: Device, packed: PackedLayer, a: FeatureMap, out: FeatureMap | Final, stride: int, *, image: bool) -> Shape:
    tiling = Tiling(ceil_div(out.height, 4), ceil_div(out.width, 32), (4 * stride, 32 * stride), 1, 1 - stride)
    return Shape(
        file="conv_amx.cl",
        options={"STRIDE": stride, "EMULATE": not amx.are_used(device), "IMAGE": image},
        weight=amx_tiles(packed, a.channels),
        gate=None,
        tiling=tiling,
        size=(list_size(device, tiling.most),),
        group=(1,),
        bias=amx_bias(packed),
    )


def _maps(a: FeatureMap, image: int, other: FeatureMap | Final | None) -> Maps | None:
    """The change maps of all inputs; None: they have none."""
    if a.changes is None:
        return None
    buffers = (a.changes,) if other is None or other.changes is None else (a.changes, other.changes)
    return Maps(buffers, a.rows - 2, a.columns - 2, image * (a.rows - 2) * (a.columns - 2))


def _winograd(device: Device, packed: PackedLayer, out: FeatureMap, side: int, stride: int, final: Final | None) -> Shape:
    row = tuning_for(device).winograd_for(packed.direct.shape[-1])
    (kernels, gate), target = in_lanes(packed, row.vector), final or out
    outputs = packed.direct.shape[-1]
    weight = winograd(kernels, side, row.vector * row.vectors_held, stride)
    # The lanes behind the outputs hold the gate; without a gate, two inputs at a time fill them.
    in_pairs = bool(outputs % row.vector) and packed.gate_direct is None and row.vectors_held * row.vector == kernels.shape[-1]
    tiling = of_convolution(target.height, target.width, stride, 3, side)
    return Shape(
        file="winograd_image.cl" if final else "winograd.cl",
        options={
            "STRIDE": stride,
            "SIDE": side,
            "TILES": row.tiles,
            "TILES_HELD": row.tiles_held,
            "VECTORS_HELD": row.vectors_held,
            "VECTOR": row.vector,
            "PAIRED": in_pairs,
            "USED": packed.used,
            "PREFETCH": device.takes_prefetch,
        },
        weight=pair_inputs(weight, outputs) if in_pairs else weight,
        gate=None if gate is None else winograd(gate, side, 1, stride),
        tiling=tiling,
        size=(list_size(device, tiling.most, row.tiles),),
        group=(1,),
    )


def _direct(device: Device, packed: PackedLayer, out: FeatureMap, stride: int, final: Final | None) -> Shape:
    assert final is None
    size, _, _, outputs = packed.direct.shape
    row = tuning_for(device).direct_for(outputs)
    # A CPU's core computes a tile with all blocks of its outputs by itself.
    workers, blocks = (1, 1) if device.is_cpu else (16 // row.pixels, outputs // 8 // row.eights_held)
    tiling = of_convolution(out.height, out.width, stride, size)
    return Shape(
        file="conv.cl",
        options={
            "KERNEL": size,
            "STRIDE": stride,
            "PIXELS": row.pixels,
            "EIGHTS_HELD": row.eights_held,
            "GROUP": row.group,
            "WORKERS": workers,
        },
        weight=packed.direct,
        gate=packed.gate_direct,
        tiling=tiling,
        size=(list_size(device, tiling.most, 1, workers, row.group), blocks),
        group=(row.group, 1),
    )
