# SPDX-License-Identifier: MIT
"""The image-space stages one by one, on arrays in the form of the port protocol (spec 11).

Every result equals the reference's in float32 bit for bit, except that subnormal numbers are 0, if the device rounds divisions and square
roots correctly. Whole frames run the fused kernels of ``prepare`` instead.
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
from stss_cl.device.program import Program, program_for
from stss_ref.arrays import ArrayError, require_dtype, require_finite, require_shape
from stss_ref.constants import EARLIER_SHARES, SLOW, HoleLimits, HoleTest

Inputs = Mapping[str, NDArray[Any]]
Outputs = dict[str, NDArray[Any]]


def hole_options(test: HoleTest) -> Mapping[str, object]:
    """The hole test and its constants (spec 4), as options of its kernel."""
    return {"PAPER": int(test == "paper")} | {name.upper(): f"{value}f" for name, value in asdict(HoleLimits()).items()}


def program(device: Device, file: str, options: Mapping[str, object] | None = None) -> Program:
    """The program of an image-space ``file``, with correctly rounded division and roots if the device has them."""
    return program_for(device, file, options, "-cl-fp32-correctly-rounded-divide-sqrt" if device.correctly_rounded_divide else "")


def accumulate_program(device: Device) -> Program:
    """The program of stage ``accumulate``."""
    newer, older = EARLIER_SHARES
    options = {"NEWER_SHARE": newer, "OLDER_SHARE": older, "SLOW": SLOW}
    return program(device, "accumulate.cl", {name: f"{value}f" for name, value in options.items()})


class ImageStages:
    """The image-space stages on one device."""

    def __init__(self, device: Device) -> None:
        self.device = device

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

    def buffer(self, size: tuple[int, int], channels: int = 1, dtype: DTypeLike = np.float32) -> cl.Buffer:
        """A new buffer for an array (H, W, channels)."""
        count = size[0] * size[1] * channels
        return cl.Buffer(self.device.context, cl.mem_flags.READ_WRITE, count * np.dtype(dtype).itemsize)

    def download(self, buffer: cl.Buffer, shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
        """A new array with the content of ``buffer`` after everything enqueued so far is done."""
        array = np.empty(shape, dtype)
        cl.enqueue_copy(self.device.queue, array, buffer)
        return array

    def launch(self, of: Program, kernel: str, size: tuple[int, int], **arguments: cl.Buffer | int) -> None:
        """Enqueue a kernel with one work-item for each of (H, W) places, rounded up to whole work-groups."""
        height, width = size
        stage = Kernel(of, kernel, {**arguments, "height": height, "width": width})
        stage.enqueue(self.device.queue, *grid(self.device, width, height))


def _size(inputs: Inputs, name: str, *channels: int | None) -> tuple[int, int]:
    require_shape(name, inputs[name], (None, None, *channels))
    return int(inputs[name].shape[0]), int(inputs[name].shape[1])


def _planes(
    stages: ImageStages, inputs: Inputs, size: tuple[int, int], channels: Mapping[str, int], finite: tuple[str, ...] = ()
) -> dict[str, cl.Buffer]:
    """The named float32 arrays on the device, checked to have ``size`` and the given number of channels; 0: a plane."""
    for name, count in channels.items():
        require_shape(name, inputs[name], (*size, count) if count else size)
        require_dtype(name, inputs[name], np.dtype(np.float32))
    for name in finite:
        require_finite(name, inputs[name])
    return {name: stages.upload(inputs[name]) for name in channels}


def _valid(stages: ImageStages, inputs: Inputs, size: tuple[int, int]) -> cl.Buffer:
    require_shape("valid", inputs["valid"], size)
    return stages.upload((inputs["valid"] != 0).astype(np.uint8))


SURFACES = {
    "stencil_previous": 0, "stencil": 0, "normal_previous": 3, "normal": 3, "position_previous": 3, "position": 3,
}  # fmt: skip
"""Planes of two frames that decide where both show the same surface, with their channels."""


def _motion_chain(stages: ImageStages, inputs: Inputs) -> Outputs:
    motions = inputs["motions"]
    require_shape("motions", motions, (None, None, None, 2))
    require_dtype("motions", motions, np.dtype(np.float32))
    k, height, width, _ = motions.shape
    size = height, width
    motion = stages.buffer(size, 2)
    stages.launch(
        program(stages.device, "motion_chain.cl"), "motion_chain", size, motions=stages.upload(motions), motion=motion, k=k
    )
    return {"motion": stages.download(motion, (*size, 2))}


def _warp(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", None)
    channels = int(inputs["color"].shape[2])
    planes = _planes(stages, inputs, size, {"color": channels, "motion": 2}, ("color",))
    warped, inside = stages.buffer(size, channels), stages.buffer(size, dtype=np.uint8)
    of = program(stages.device, "warp.cl", {"CHANNELS": channels})
    stages.launch(of, "warp", size, **planes, warped=warped, inside=inside)
    return {"warped": stages.download(warped, (*size, channels)), "inside": stages.download(inside, size, np.uint8)}


def _holes(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "motion", 2)
    planes = _planes(stages, inputs, size, {"motion": 2, **SURFACES, "nov": 0, "depth": 0})
    require_shape("paper", inputs["paper"], (1,))
    valid = stages.buffer(size, dtype=np.uint8)
    of = program(stages.device, "holes.cl", hole_options("paper" if inputs["paper"][0] else "footprint"))
    stages.launch(of, "holes", size, **planes, valid=valid)
    return {"valid": stages.download(valid, size, np.uint8)}


def _occlusion_warp(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", 3)
    planes = _planes(stages, inputs, size, {"color": 3, "warped": 3, "motion": 2, "depth": 0}, ("color", "depth"))
    depth, valid, of = planes.pop("depth"), _valid(stages, inputs, size), program(stages.device, "occlusion_warp.cl")
    keys, first = stages.buffer(size, dtype=np.uint32), stages.buffer(size, dtype=np.uint32)
    motion, filled = stages.buffer(size, 2), stages.buffer(size, 3)
    stages.launch(of, "splat_clear", size, keys=keys, first=first)
    stages.launch(of, "splat_nearest", size, motion=planes["motion"], depth=depth, keys=keys)
    stages.launch(of, "splat_first", size, motion=planes["motion"], depth=depth, keys=keys, first=first)
    stages.launch(of, "occlusion_warp", size, **planes, first=first, valid=valid, occlusion_motion=motion, filled=filled)
    return {
        "occlusion_motion": stages.download(motion, (*size, 2)),
        "occlusion_warp": stages.download(filled, (*size, 3)),
    }


def _reshade(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = _size(inputs, "color", 3)
    finite = ("color", "warped", "normal_previous", "normal", "base_color")
    planes = _planes(stages, inputs, size, {"color": 3, "warped": 3, "motion": 2, **SURFACES, "base_color": 3}, finite)
    of, valid = program(stages.device, "reshade.cl"), _valid(stages, inputs, size)
    samples, lights, filled = stages.buffer(size, 4), stages.buffer(size, 4), stages.buffer(size, 3)
    search = {name: planes[name] for name in ("color", "motion", *SURFACES)}
    stages.launch(of, "find_samples", size, **search, valid=valid, samples=samples)
    material = {name: planes[name] for name in ("warped", "stencil", "normal", "base_color")}
    stages.launch(of, "find_lights", size, **material, valid=valid, samples=samples, lights=lights)
    stages.launch(of, "reshade", size, **material, valid=valid, samples=samples, lights=lights, filled=filled)
    return {"reshade": stages.download(filled, (*size, 3))}


def _rrm(stages: ImageStages, inputs: Inputs) -> Outputs:
    size = height, width = _size(inputs, "valid")
    y, x, h, w = (int(v) for v in inputs["rectangle"])
    if not (0 <= y <= y + h <= height and 0 <= x <= x + w <= width):
        raise ArrayError(f"rectangle: expected to lie within {height} x {width}, got y={y}, x={x}, h={h}, w={w}")
    masked = stages.buffer(size, dtype=np.uint8)
    place = {"top": y, "left": x, "rows": h, "columns": w}
    stages.launch(program(stages.device, "rrm.cl"), "rrm", size, valid=_valid(stages, inputs, size), masked=masked, **place)
    return {"valid": stages.download(masked, size, np.uint8)}


def _accumulate(stages: ImageStages, inputs: Inputs) -> Outputs:
    motions, earlier = inputs["motions"], inputs["earlier"]
    require_shape("motions", motions, (None, None, None, 2))
    count, size = len(motions), (int(motions.shape[1]), int(motions.shape[2]))
    display = 2 * size[0], 2 * size[1]
    require_shape("earlier", earlier, (count, *display, 3))
    if count > len(EARLIER_SHARES):
        raise ArrayError(f"earlier: expected at most {len(EARLIER_SHARES)} images, got {count}")
    arrays = {
        "image": inputs["image"],
        "newer": earlier[0],
        "older": earlier[-1],
        "to_newer": motions[0],
        "to_older": motions[-1],
    }
    images = _planes(stages, arrays, display, {"image": 3, "newer": 3, "older": 3}, ("image", "newer", "older"))
    places, shown = _planes(stages, arrays, size, {"to_newer": 2, "to_older": 2}), stages.buffer(display, 3)
    stages.launch(accumulate_program(stages.device), "accumulate", size, **images, **places, shown=shown, count=count)
    return {"shown": stages.download(shown, (*display, 3))}


STAGES: dict[str, Callable[[ImageStages, Inputs], Outputs]] = {
    "motion_chain": _motion_chain,
    "warp": _warp,
    "holes": _holes,
    "occlusion_warp": _occlusion_warp,
    "reshade": _reshade,
    "rrm": _rrm,
    "accumulate": _accumulate,
}
"""The stages that ``ImageStages.run_stage`` runs."""
