# SPDX-License-Identifier: MIT
"""Device buffers: activations with a border of zeros, and the caller's arrays, without a copy where possible."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.parts import Parts, make_zeros
from stss_cl.device.recycling import recycler_of
from stss_cl.device.staging import so_far, staging
from stss_ref.arrays import Array, ArrayError, require_dtype

FLAGS = cl.mem_flags

SLACK = 80
"""Pixels behind the last row, for strips and tiles of 32 pixels that go beyond its end (kernels/common.clh)."""

BFLOAT16 = np.dtype(np.uint16)
"""In place of bfloat16, which NumPy lacks: the upper halves of floats."""

Plain = Array | cla.Array
"""A NumPy array, or one on the device: ``pyopencl.array.Array(queue, shape, dtype, data=buffer)`` wraps an engine's buffer."""

ALIGNMENT = 16
"""Alignment of a ``float4``; bytes. A part of an array need not begin at a multiple of it."""


@dataclass(frozen=True)
class FeatureMap:
    """Activations (height, width, channels), channels last, inside a border of zeros (kernels/common.clh).

    Attributes:
        data: the buffer; it holds ``images`` images one behind the other.
        height, width, channels: the shape of an image, without its border.
        dtype: of the stored values: float32, float16 or ``BFLOAT16``.
        images: number of images.
        changes: the change maps (kernels/change_map.clh) of the images, one behind the other; None: there are none.
    """

    data: cl.Buffer
    height: int
    width: int
    channels: int
    dtype: np.dtype[Any]
    images: int = 1
    changes: cl.Buffer | None = None

    @property
    def rows(self) -> int:
        """With the border, and room for whole tiles of 4."""
        return -(-self.height // 4) * 4 + 2

    @property
    def columns(self) -> int:
        """With the border, and room for whole tiles of 4."""
        return -(-self.width // 4) * 4 + 2

    @property
    def inside(self) -> tuple[slice, slice]:
        """The slices of the activations within (rows, columns)."""
        return slice(1, self.height + 1), slice(1, self.width + 1)


def storage(dtype: np.dtype[Any]) -> str:
    """The option ``STORED`` of kernels for activations of this dtype (kernels/common.clh)."""
    return {np.dtype(np.float16): "HALF", BFLOAT16: "BFLOAT16"}.get(dtype, "FLOAT")


def to_bfloat16(array: NDArray[Any]) -> NDArray[np.uint16]:
    """Round as kernels do: to nearest even, subnormal numbers to 0."""
    bits = np.asarray(array, np.float32).view(np.uint32)
    rounded = np.where(bits & 0x7F800000, bits + 0x7FFF + (bits >> 16 & 1), bits & 0x80000000)
    return (rounded >> 16).astype(np.uint16)


def from_bfloat16(bits: NDArray[np.uint16]) -> NDArray[np.float32]:
    """The same numbers in float32."""
    return (bits.astype(np.uint32) << 16).view(np.float32)


def padded_bytes(height: int, width: int, channels: int, dtype: np.dtype[Any], images: int = 1) -> int:
    """Size of activations with their border and slack."""
    pixels = images * (-(-height // 4) * 4 + 2) * (-(-width // 4) * 4 + 2) + SLACK
    return pixels * channels * dtype.itemsize


def map_bytes(height: int, width: int, images: int = 1) -> int:
    """Size of change maps: a byte for each pixel, rows and columns rounded up to whole fours; kernels may read 64 more behind them."""
    return images * (-(-height // 4) * 4) * (-(-width // 4) * 4) + 64


def pad(device: Device, height: int, width: int, channels: int, dtype: np.dtype[Any], images: int = 1) -> FeatureMap:
    """Allocate activations of zeros, without a change map."""
    data = make_zeros(device, padded_bytes(height, width, channels, dtype, images))
    return FeatureMap(data, height, width, channels, dtype, images)


@dataclass(frozen=True)
class Inputs:
    """The network's inputs, at H8, W8 = H, W rounded up to multiples of 8; ``input`` and ``base`` share a change map.

    Attributes:
        input: (H8, W8, 24) color 6, color * mask 6, gbuffer 9, zeros 3.
        earlier: 3 of (H8, W8, 4) oldest, middle, newest: warped colour and its mask.
        eighth: (H8/8, W8/8, 16) gbuffer 9, mask, zeros 6.
        base: (H8, W8, 4) float32, no border: color 0..2 and 0, which the decoder upsamples and adds.
        changes: the change maps of ``input``, ``earlier`` and ``eighth``; None: there are none.
    """

    input: FeatureMap
    earlier: FeatureMap
    eighth: FeatureMap
    base: cl.Buffer
    changes: Parts | None = None


def inputs_for(device: Device, rows: int, columns: int, dtype: np.dtype[Any], changes: bool = False) -> Inputs:
    """Allocate the network's inputs for (rows, columns), multiples of 8: a frame, or a strip of it; with change maps or without."""
    images = (
        pad(device, rows, columns, 24, dtype),
        pad(device, rows, columns, 4, dtype, images=3),
        pad(device, rows // 8, columns // 8, 16, dtype),
    )
    base = cl.Buffer(device.context, FLAGS.READ_WRITE, rows * columns * 16)
    maps = Parts(device, [map_bytes(image.height, image.width, image.images) for image in images]) if changes else None
    marks = (None, None, None) if maps is None else maps.buffers
    input_, earlier, eighth = (replace(image, changes=map_) for image, map_ in zip(images, marks, strict=True))
    return Inputs(input_, earlier, eighth, base, maps)


def write(device: Device, to: FeatureMap, array: Array, first: int = 0) -> None:
    """Copy (height, width, C) or (images, height, width, C) into channels ``first`` .. of ``to``, the others 0."""
    host = np.zeros((to.images, to.rows, to.columns, to.channels), to.dtype)
    rows, columns = to.inside
    host[:, rows, columns, first : first + array.shape[-1]] = to_bfloat16(array) if to.dtype == BFLOAT16 else array
    cl.enqueue_copy(device.queue, to.data, host)


def read(device: Device, source: FeatureMap, first: int = 0, channels: int | None = None, image: int = 0) -> Array:
    """Copy one image out: (height, width, channels) float32."""
    host = np.empty((source.images, source.rows, source.columns, source.channels), source.dtype)
    cl.enqueue_copy(device.queue, host, source.data)  # the slack stays behind
    last = source.channels if channels is None else first + channels
    values = host[image][(*source.inside, slice(first, last))]
    return np.ascontiguousarray(from_bfloat16(values) if source.dtype == BFLOAT16 else values, np.float32)


def constant(device: Device, array: NDArray[Any]) -> cl.Buffer:
    """A read-only copy of ``array`` on the device."""
    return cl.Buffer(device.context, FLAGS.READ_ONLY | FLAGS.COPY_HOST_PTR, hostbuf=np.ascontiguousarray(array))


def on_device(device: Device, name: str, array: cla.Array, dtype: type[np.floating[Any]] = np.float32) -> cl.Buffer:
    """The buffer of an array that is already on the device, or the part of a buffer that the array covers.

    The device waits for the array's own events.

    Raises:
        ArrayError: it is not of this ``dtype``, not C-contiguous, of another context, or larger than its buffer.
    """
    require_dtype(name, array, np.dtype(dtype))
    if not array.flags.c_contiguous:
        raise ArrayError(f"{name}: expected a C-contiguous array, got strides {array.strides}")
    buffer: Any = array.base_data
    if _context(buffer) != device.context:
        raise ArrayError(f"{name}: expected an array in the device's context, got one of another")
    if array.offset + array.nbytes > buffer.size:
        raise ArrayError(f"{name}: expected a buffer of at least {array.offset + array.nbytes} bytes, got {buffer.size}")
    # PyOpenCL keeps events that are over, too; each barrier takes microseconds.
    if waiting := [event for event in array.events if event.command_execution_status != cl.command_execution_status.COMPLETE]:
        cl.enqueue_barrier(device.queue, wait_for=waiting)
    return part(device, buffer, array.offset, array.nbytes) if array.offset else buffer


def _context(buffer: cl.Buffer) -> Any:
    """The buffer's context; None if only the buffer holds it: Intel's runtime then calls it invalid."""
    with suppress(cl.LogicError):
        return buffer.get_info(cl.mem_info.CONTEXT)
    return None


def part(device: Device, buffer: cl.Buffer, first: int, size: int) -> cl.Buffer:
    """The ``size`` bytes of a buffer from byte ``first`` on: in place if the device allows a buffer to begin there, otherwise a copy."""
    if size and first % (device.handle.mem_base_addr_align // 8) == 0:
        return buffer.get_sub_region(first, size)
    copy = cl.Buffer(device.context, FLAGS.READ_WRITE, size)
    cl.enqueue_copy(device.queue, copy, buffer, byte_count=size, src_offset=first)
    return copy


def incoming(device: Device, array: Plain) -> cl.Buffer:
    """An array as a buffer: in place if it is on the device, or on a CPU if its alignment allows that; else a copy, perhaps under way."""
    if isinstance(array, cla.Array):
        return on_device(device, "array", array)
    if not device.is_cpu:
        return staging(device).upload(np.ascontiguousarray(array))
    in_place = array.flags.c_contiguous and array.ctypes.data % ALIGNMENT == 0
    how = FLAGS.USE_HOST_PTR if in_place else FLAGS.COPY_HOST_PTR
    return cl.Buffer(device.context, FLAGS.READ_ONLY | how, hostbuf=np.ascontiguousarray(array))


def mask_of(device: Device, mask: cl.Buffer, size: tuple[int, int], *, on_device: bool) -> Outgoing:
    """A copy of a mask (H, W), uint8."""
    copy = Outgoing(device, size, np.uint8, on_device=on_device)
    cl.enqueue_copy(device.queue, copy.data, mask, byte_count=copy.array.nbytes)
    return copy


class Outgoing:
    """An array that a kernel writes: a NumPy array, filled in place on a CPU, or a ``pyopencl.array``.

    Attributes:
        array: complete after ``finish``.
        data: the buffer to write to.
    """

    def __init__(self, device: Device, shape: tuple[int, ...], dtype: type[np.generic] = np.float32, *, on_device: bool):
        self._device, self._on_device = device, on_device
        self._arriving: cl.Event | None = None
        self.data: Any
        if on_device:
            self.array: Any = cla.empty(device.queue, shape, dtype, allocator=device.pool)
            self.data = self.array.base_data
        elif device.is_cpu:
            self.array = recycler_of(device.context).array(shape, np.dtype(dtype))
            self.data = cl.Buffer(device.context, FLAGS.READ_WRITE | FLAGS.USE_HOST_PTR, hostbuf=self.array)
        else:
            self.array = staging(device).array(shape, np.dtype(dtype))
            self.data = device.pool.allocate(self.array.nbytes)

    def send(self) -> None:
        """Enqueue the download, if there is one, behind the launches so far; does not wait."""
        if self._on_device or self._device.is_cpu or self._arriving is not None:
            return
        queue = staging(self._device).downloads
        event = so_far(self._device.queue)
        self._arriving = cl.enqueue_copy(queue, self.array, self.data, is_blocking=False, wait_for=[event])
        queue.flush()

    def renew(self) -> None:
        """Let the next ``send`` download again, since ``data`` was written again."""
        self._arriving = None

    def finish(self) -> Any:
        """The complete array. Waits for the queue, unless the array is on the device."""
        if self._on_device:
            return self.array
        if not self._device.is_cpu:
            self.send()
            assert self._arriving is not None
            self._arriving.wait()
            return self.array
        # Only mapping makes the device's writes visible in the host's memory.
        view, _ = cl.enqueue_map_buffer(self._device.queue, self.data, cl.map_flags.READ, 0, self.array.shape, self.array.dtype)
        view.base.release(self._device.queue)
        self._device.queue.finish()
        return self.array
