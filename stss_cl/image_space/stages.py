# SPDX-License-Identifier: MIT
"""The image-space stages one by one: on device buffers, and on arrays in the form of the port protocol (spec 11).

Every result equals the reference's in float32 bit for bit if the device rounds divisions and square roots correctly. Whole frames run
the fused kernels of ``prepare`` instead.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import DTypeLike, NDArray

from stss_cl.device.discovery import Device
from stss_cl.device.grid import grid
from stss_cl.device.launch import Kernel
from stss_cl.device.program import Program, build
from stss_ref.arrays import Array, ArrayError, require_dtype, require_finite, require_shape
from stss_ref.constants import Gather, HoleLimits, HoleTest

Inputs = Mapping[str, NDArray[Any]]
Outputs = dict[str, NDArray[Any]]


def hole_options(test: HoleTest) -> Mapping[str, object]:
    """The hole test and its constants (spec 4), as options of its kernel."""
    return {"PAPER": int(test == "paper")} | {name.upper(): f"{value}f" for name, value in asdict(HoleLimits()).items()}


def program(device: Device, file: str, options: Mapping[str, object] | None = None) -> Program:
    """The program of an image-space ``file``, with correctly rounded division and roots where the device has them."""
    return build(device, file, options, "-cl-fp32-correctly-rounded-divide-sqrt" if device.correctly_rounded_divide else "")


def launch(device: Device, of: Program, kernel: str, height: int, width: int, **arguments: cl.Buffer | int) -> cl.Event:
    """Enqueue one work-item for each of ``height`` x ``width`` places, rounded up to whole work-groups."""
    made = Kernel(of, kernel, {**arguments, "height": height, "width": width})
    return made.enqueue(device.queue, *grid(device, width, height))


class ImageStages:
    """The image-space stages on one device. Methods take buffers of float32 (masks: uint8), sizes in pixels, and enqueue."""

    def __init__(self, device: Device, gather: Gather = "longest") -> None:
        self.device = device
        self._gather: Gather = gather

    def motion_chain(self, motions: cl.Buffer, k: int, height: int, width: int) -> cl.Buffer:
        """``motion`` (H, W, 2) over ``motions`` (k, H, W, 2)."""
        chain = program(self.device, "motion_chain.cl", {"GATHER": f"gather_{self._gather}"})
        motion = self._buffer(height * width * 2, np.float32)
        launch(self.device, chain, "motion_chain", height, width, motions=motions, motion=motion, k=k)
        return motion

    def warp(self, color: cl.Buffer, motion: cl.Buffer, channels: int, height: int, width: int) -> tuple[cl.Buffer, cl.Buffer]:
        """``warped`` (H, W, channels) and ``inside`` (H, W)."""
        warped, inside = self._buffer(height * width * channels, np.float32), self._buffer(height * width, np.uint8)
        buffers = {"color": color, "motion": motion, "warped": warped, "inside": inside}
        launch(self.device, program(self.device, "warp.cl", {"CHANNELS": channels}), "warp", height, width, **buffers)
        return warped, inside

    def holes(
        self,
        motion: cl.Buffer,
        stencil_previous: cl.Buffer,
        stencil: cl.Buffer,
        normal_previous: cl.Buffer,
        normal: cl.Buffer,
        position_previous: cl.Buffer,
        position: cl.Buffer,
        nov: cl.Buffer,
        depth: cl.Buffer,
        height: int,
        width: int,
        test: HoleTest = "footprint",
    ) -> cl.Buffer:
        """``valid`` (H, W)."""
        valid = self._buffer(height * width, np.uint8)
        launch(
            self.device, program(self.device, "holes.cl", hole_options(test)), "holes", height, width,
            motion=motion, stencil_previous=stencil_previous, stencil=stencil, normal_previous=normal_previous, normal=normal,
            position_previous=position_previous, position=position, nov=nov, depth=depth, valid=valid,
        )  # fmt: skip
        return valid

    def occlusion_warp(
        self, color: cl.Buffer, warped: cl.Buffer, motion: cl.Buffer, depth: cl.Buffer, valid: cl.Buffer, height: int, width: int
    ) -> tuple[cl.Buffer, cl.Buffer]:
        """``occlusion_motion`` (H, W, 2) and ``occlusion_warp`` (H, W, 3)."""
        steps = program(self.device, "occlusion_warp.cl")
        keys, first = self._buffer(height * width, np.uint32), self._buffer(height * width, np.uint32)
        occlusion_motion, filled = (self._buffer(height * width * n, np.float32) for n in (2, 3))
        launch(self.device, steps, "splat_clear", height, width, keys=keys, first=first)
        launch(self.device, steps, "splat_nearest", height, width, motion=motion, depth=depth, keys=keys)
        launch(self.device, steps, "splat_first", height, width, motion=motion, depth=depth, keys=keys, first=first)
        launch(
            self.device, steps, "occlusion_warp", height, width, color=color, warped=warped, motion=motion, first=first, valid=valid,
            occlusion_motion=occlusion_motion, filled=filled,
        )  # fmt: skip
        return occlusion_motion, filled

    def reshade(
        self,
        color: cl.Buffer,
        warped: cl.Buffer,
        motion: cl.Buffer,
        valid: cl.Buffer,
        stencil_previous: cl.Buffer,
        stencil: cl.Buffer,
        normal_previous: cl.Buffer,
        normal: cl.Buffer,
        position_previous: cl.Buffer,
        position: cl.Buffer,
        base_color: cl.Buffer,
        height: int,
        width: int,
    ) -> cl.Buffer:
        """``reshade`` (H, W, 3)."""
        steps = program(self.device, "reshade.cl")
        samples, filled = self._buffer(height * width * 4, np.float32), self._buffer(height * width * 3, np.float32)
        launch(
            self.device, steps, "find_samples", height, width, color=color, motion=motion, valid=valid,
            stencil_previous=stencil_previous, stencil=stencil, normal_previous=normal_previous, normal=normal,
            position_previous=position_previous, position=position, samples=samples,
        )  # fmt: skip
        launch(
            self.device, steps, "reshade", height, width, warped=warped, valid=valid, stencil=stencil, normal=normal,
            base_color=base_color, samples=samples, filled=filled,
        )  # fmt: skip
        return filled

    def rrm(self, valid: cl.Buffer, rectangle: tuple[int, int, int, int], height: int, width: int) -> cl.Buffer:
        """``valid`` (H, W) with a rectangle (y, x, h, w) of it set to 0."""
        masked = self._buffer(height * width, np.uint8)
        top, left, rows, columns = rectangle
        place = {"top": top, "left": left, "rows": rows, "columns": columns}
        launch(self.device, program(self.device, "rrm.cl"), "rrm", height, width, valid=valid, masked=masked, **place)
        return masked

    def run_stage(self, name: str, inputs: Inputs) -> Outputs:
        """Run one stage on arrays, under the names and in the dtypes of spec 11.

        Args:
            name: of ``STAGES``.
            inputs: float32 arrays; ``valid`` of any dtype, 0 or not; ``rectangle`` of integers.

        Raises:
            ArrayError: shapes or dtypes differ, or an array that must be finite is not.
        """
        return STAGES[name](self, inputs)

    def upload(self, array: NDArray[Any]) -> cl.Buffer:
        """A new buffer with the content of ``array``."""
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
        return cl.Buffer(self.device.context, flags, hostbuf=np.ascontiguousarray(array))

    def download(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """A new array with the content of ``buffer`` after everything enqueued so far is done."""
        array = np.empty(shape, dtype)
        cl.enqueue_copy(self.device.queue, array, buffer)
        return array

    def _buffer(self, count: int, dtype: DTypeLike) -> cl.Buffer:
        return cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, count * np.dtype(dtype).itemsize)


def _size(inputs: Inputs, name: str, *channels: int | None) -> tuple[int, int]:
    require_shape(name, inputs[name], (None, None, *channels))
    return int(inputs[name].shape[0]), int(inputs[name].shape[1])


def _take(inputs: Inputs, size: tuple[int, int], **channels: int) -> list[Array]:
    """The named float32 arrays, checked to have ``size`` and the given number of channels; 0: a plane."""
    for name, count in channels.items():
        require_shape(name, inputs[name], (*size, count) if count else size)
        require_dtype(name, inputs[name], np.dtype(np.float32))
    return [inputs[name] for name in channels]


def _motion_chain(stages: ImageStages, inputs: Inputs) -> Outputs:
    motions = inputs["motions"]
    require_shape("motions", motions, (None, None, None, 2))
    require_dtype("motions", motions, np.dtype(np.float32))
    k, height, width, _ = motions.shape
    motion = stages.motion_chain(stages.upload(motions), k, height, width)
    return {"motion": stages.download(motion, (height, width, 2), np.float32)}


def _warp(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", None)
    channels = int(inputs["color"].shape[2])
    color, motion = _take(inputs, size, color=channels, motion=2)
    require_finite("color", color)
    warped, inside = stages.warp(stages.upload(color), stages.upload(motion), channels, *size)
    return {
        "warped": stages.download(warped, (*size, channels), np.float32),
        "inside": stages.download(inside, size, np.uint8),
    }


def _holes(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "motion", 2)
    arrays = _take(
        inputs,
        size,
        motion=2,
        stencil_previous=0,
        stencil=0,
        normal_previous=3,
        normal=3,
        position_previous=3,
        position=3,
        nov=0,
        depth=0,
    )
    require_shape("paper", inputs["paper"], (1,))
    test: HoleTest = "paper" if inputs["paper"][0] else "footprint"
    motion, *others = (stages.upload(array) for array in arrays)
    stencil_0, stencil, normal_0, normal, position_0, position, nov, depth = others
    valid = stages.holes(motion, stencil_0, stencil, normal_0, normal, position_0, position, nov, depth, *size, test)
    return {"valid": stages.download(valid, size, np.uint8)}


def _occlusion_warp(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", 3)
    arrays = _take(inputs, size, color=3, warped=3, motion=2, depth=0)
    require_finite("color", inputs["color"])
    require_finite("depth", inputs["depth"])
    require_shape("valid", inputs["valid"], size)
    valid = stages.upload((inputs["valid"] != 0).astype(np.uint8))
    color, warped, motion, depth = (stages.upload(array) for array in arrays)
    motion, filled = stages.occlusion_warp(color, warped, motion, depth, valid, *size)
    return {
        "occlusion_motion": stages.download(motion, (*size, 2), np.float32),
        "occlusion_warp": stages.download(filled, (*size, 3), np.float32),
    }


def _reshade(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", 3)
    images = {"color": 3, "warped": 3, "motion": 2}
    surfaces = {
        "stencil_previous": 0, "stencil": 0, "normal_previous": 3, "normal": 3, "position_previous": 3, "position": 3, "base_color": 3,
    }  # fmt: skip
    arrays = [stages.upload(array) for array in _take(inputs, size, **images, **surfaces)]
    (color, warped, motion), others = arrays[:3], dict(zip(surfaces, arrays[3:], strict=True))
    for name in ("color", "warped", "normal_previous", "normal", "base_color"):
        require_finite(name, inputs[name])
    require_shape("valid", inputs["valid"], size)
    valid = stages.upload((inputs["valid"] != 0).astype(np.uint8))
    filled = stages.reshade(color, warped, motion, valid, **others, height=size[0], width=size[1])
    return {"reshade": stages.download(filled, (*size, 3), np.float32)}


def _rrm(stages: ImageStages, inputs: Inputs) -> Outputs:
    height, width = _size(inputs, "valid")
    y, x, h, w = (int(v) for v in inputs["rectangle"])
    if not (0 <= y <= y + h <= height and 0 <= x <= x + w <= width):
        raise ArrayError(f"rectangle: expected to lie within {height} x {width}, got y={y}, x={x}, h={h}, w={w}")
    valid = stages.upload((inputs["valid"] != 0).astype(np.uint8))
    masked = stages.rrm(valid, (y, x, h, w), height, width)
    return {"valid": stages.download(masked, (height, width), np.uint8)}


STAGES: dict[str, Callable[[ImageStages, Inputs], Outputs]] = {
    "motion_chain": _motion_chain,
    "warp": _warp,
    "holes": _holes,
    "occlusion_warp": _occlusion_warp,
    "reshade": _reshade,
    "rrm": _rrm,
}
"""The stages that ``ImageStages.run_stage`` knows."""
