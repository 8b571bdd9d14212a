# SPDX-License-Identifier: MIT
"""Compare one device with the reference; ``stss.devices.verdicts`` runs this in a separate process, since a driver may hang or crash.

``python -m stss.devices.selftest NAME TRIAL`` prints one line of JSON: ``why``, the reason of a failure or "", and the speed in ``gflops``.
It compiles what frames need with the weights of that trial (`stss.devices.trial`).
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from conformance.tolerance import ratio
from stss.devices.trial import SIZE, trial_weights
from stss.images.color import transfer
from stss.weights.file import REALTIME
from stss_cl.device.discovery import Device, open_device
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_cl.image_space.output import CURVE_ERROR, OutputKernels
from stss_cl.image_space.stages import ImageStages
from stss_cl.skip.arrival import Arrival
from stss_cl.skip.stream import Stream
from stss_ground.errors import DeviceError
from stss_ref.accumulate import accumulate
from stss_ref.frame import FrameInputs, prepare_for
from stss_ref.network import network as reference_network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.resample import upsample_centres
from stss_ref.warp import warp

COUNT = 1003
GROUP = 64
ARRIVING = {"motion": 2, "gbuffer": 9, "nov": 1, "stencil": 1, "position": 3}
TURNS = 100_000
"""Least turns of the loop: Mesa's llvmpipe ends a work-item's loops after 65,535, and leaves the rest of its tiles unchanged."""

# Largest errors in units in the last place that OpenCL 1.2, section 7.4, allows: these are not our choice.
ULP = {"divide": 2.5, "exp": 3.0, "sqrt": 3.0}


class MismatchError(Exception):
    """A result is wrong; the message says which, in a few words."""


@dataclass(frozen=True)
class SelfTestResult:
    """The result that the child process prints."""

    why: str
    gflops: float = 0.0


def arithmetic(device: Device, generator: np.random.Generator) -> None:
    """Sums and products round as IEEE 754 says and in the order written; quotients and functions as OpenCL says."""
    a = generator.standard_normal(COUNT).astype(np.float32) * np.float32(2) ** generator.integers(-8, 20, COUNT)
    b = (generator.random(COUNT) + 0.5).astype(np.float32) * generator.choice([-3, 1], COUNT)
    c = generator.uniform(-79, 79, COUNT)
    a, b, c = (array.astype(np.float32) for array in (a, b, c))
    values, whole = np.empty((5, COUNT), np.float32), np.empty((3, COUNT), np.int32)
    _launch(device, "arithmetic", (COUNT + 21,), None, {"a": a, "b": b, "c": c}, {"values": values, "whole": whole}, n=COUNT)

    _exact("a * b + c", values[0], a * b + c)
    _exact("(a + b) + c", values[1], (a + b) + c)
    _close("divide", values[2], a.astype(np.float64) / b)
    _close("exp", values[3], np.exp(c.astype(np.float64)))
    _close("sqrt", values[4], np.sqrt(np.abs(a.astype(np.float64))))
    _exact("(int)", whole[0], a.astype(np.int32))
    _exact("floor", whole[1], np.floor(a).astype(np.int32))
    _exact("as_int", whole[2], a.view(np.int32))


def vectors(device: Device, generator: np.random.Generator) -> None:
    """Eight values move at once, aligned and not."""
    numbers = generator.standard_normal(8 * COUNT + 8).astype(np.float32)
    got = np.empty((2, 8 * COUNT), np.float32)
    _launch(device, "vectors", (COUNT,), None, {"in": numbers}, {"out": got}, n=COUNT)
    _exact("float8", got[0], numbers[:-8].reshape(-1, 8)[:, ::-1].reshape(-1))
    _exact("vload8", got[1], numbers[1:-7] + numbers[:-8])


def groups(device: Device, generator: np.random.Generator) -> None:
    """Work-items of a group share local memory and wait for each other."""
    numbers = generator.integers(-1000, 1000, (37, GROUP)).astype(np.float32)
    got = np.empty(37, np.float32)
    _launch(device, "reduce_group", (numbers.size,), (GROUP,), {"in": numbers}, {"out": got})
    _exact("local memory and barrier", got, numbers.sum(axis=1))


def turns(device: Device, generator: np.random.Generator) -> None:
    """A long loop runs to its end; its sums of whole numbers are exact."""
    steps = int(generator.integers(TURNS, 2 * TURNS))
    got = np.empty((1, 8), np.float32)
    _launch(device, "speed", (1,), None, {"weights": np.ones((steps, 8), np.float32)}, {"out": got}, steps=steps)
    _exact("turns of a loop", got / 6, np.full((1, 8), steps, np.float32))


def nearest(device: Device, generator: np.random.Generator) -> None:
    """Of all keys written to one place, the smallest stays."""
    place = generator.integers(0, 50, 5000).astype(np.int32)
    key = generator.integers(-(2**31), 2**31 - 1, 5000).astype(np.int32)
    got, want = np.full(50, 2**31 - 1, np.int32), np.full(50, 2**31 - 1, np.int32)
    np.minimum.at(want, place, key)
    _launch(device, "nearest", (5000,), None, {"place": place, "key": key}, {"out": got}, n=5000)
    _exact("atomic_min", got, want)


def image_stages(device: Device, generator: np.random.Generator) -> None:
    """Warping, splatting and accumulation, bit for bit the reference in float32."""
    size = (24, 40)
    color, depth = generator.random((*size, 3)).astype(np.float32), generator.random(size).astype(np.float32)
    motion = generator.uniform(-9, 9, (*size, 2)).astype(np.float32)
    valid = generator.random(size) > 0.5
    stages = ImageStages(device)
    warped, inside = warp(color, motion)
    got = stages.run_stage("warp", {"color": color, "motion": motion})
    _exact("warped", got["warped"], warped)
    _exact("inside", got["inside"], inside)
    inputs = {"color": color, "warped": warped, "motion": motion, "depth": depth, "valid": valid}
    got = stages.run_stage("occlusion_warp", inputs)
    occlusion_motion, filled = occlusion_warp(color, warped, motion, depth, valid)
    _exact("occlusion_motion", got["occlusion_motion"], occlusion_motion)
    _exact("occlusion_warp", got["occlusion_warp"], filled)
    images = {
        "image": color,
        "earlier": np.stack([warped, color[::-1]]),
        "motions": np.stack([motion[::2, ::2], motion[1::2, ::2]]),
    }
    _exact("shown", stages.run_stage("accumulate", images)["shown"], accumulate(**images))


class Display(NamedTuple):
    """A display frame (`stss_cl.skip.display_frame.DisplayFrame`)."""

    color: NDArray[np.float32] | None
    motion: NDArray[np.float32]
    stencil: NDArray[np.float32]
    gbuffer: NDArray[np.float32]
    nov: NDArray[np.float32]
    position: NDArray[np.float32]


def frames(device: Device, generator: np.random.Generator, trial: str = REALTIME) -> None:
    """Display frames in sequence against the reference: the programs are those that `stss run` builds."""
    weights, size = trial_weights(trial), SIZE
    stream, window = Stream(weights, device), list[Display]()
    color, gbuffer, nov, position = (generator.random((*size, *c)).astype(np.float32) for c in ((3,), (9,), (), (3,)))
    for number in range(8):
        kind = number % 2
        picture, motion, stencil = color.copy(), np.zeros((*size, 2), np.float32), np.zeros(size, np.float32)
        if number >= 6:  # first a tile of the colour differs; then a surface moves, and leaves holes
            picture[4:8, 8:12] *= 0.5
        if number == 7:
            motion[6:16, 10:30], stencil[8:14, 12:28] = generator.uniform(-9, 9, 2), 1
        window = [*window[-5:], Display(None if kind else picture, motion, stencil, gbuffer, nov, position)]
        steps = kind, min(number, kind + 2), min(number, kind + 4)
        image, valid = stream(window, steps)
        if number >= 6:
            inputs = prepare_for(weights, _inputs(window, steps))
            _exact("mask", valid, inputs.mask.astype(bool))
            arrays = inputs.color, inputs.gbuffer, inputs.mask, inputs.history
            _within("frames", image, reference_network(*(array.astype(np.float64) for array in arrays), weights=weights))
        if number == 6 and stream.cost.network != "changed":
            raise MismatchError(f"frames: expected a part of the network to run, found {stream.cost.network}")


def _inputs(window: list[Display], steps: tuple[int, int, int]) -> FrameInputs:
    """The inputs of the last frame as the reference takes them."""
    back = window[::-1]
    views = [back[0], *(back[step] for step in steps)]
    return FrameInputs(
        colors=np.stack([frame.color for frame in views[1:] if frame.color is not None]),
        steps=steps,
        motions=np.stack([frame.motion for frame in back[: steps[2]]]),
        gbuffer=back[0].gbuffer,
        nov=back[0].nov,
        stencils=np.stack([frame.stencil for frame in views]),
        normals=np.stack([frame.gbuffer[..., :3] for frame in views]),
        positions=np.stack([frame.position for frame in views]),
    )


def arrival(device: Device, generator: np.random.Generator) -> None:
    """The kernel that looks for NaN finds it."""
    planes = {name: _upload(device, generator.random((8, 24, n)).astype(np.float32)) for name, n in ARRIVING.items()}
    broken = _upload(device, np.full((8, 24, 3), np.nan, np.float32))
    if Arrival(device, 8, 24).look(planes, broken, planes, broken)[0] != "color":
        raise MismatchError("arrive: NaN is not found")


def output(device: Device, generator: np.random.Generator) -> None:
    """Planes are carried past the network bit for bit, and an image goes back through the sRGB curve within its bound."""
    kernels, size = OutputKernels(device), (24, 40)
    plane, motion = generator.random((*size, 3)).astype(np.float32), generator.uniform(-9, 9, (*size, 2)).astype(np.float32)
    image = generator.random((2 * size[0], 2 * size[1], 3)).astype(np.float32)
    color, carried = kernels.deliver(image, {"plane": plane}, motion, srgb=True)
    _exact("carried", carried["plane"], upsample_centres(warp(plane, motion)[0]))
    linear = transfer("srgb").decode(image)
    error = np.abs(color.astype(np.float64) - linear)
    if not (error <= (CURVE_ERROR + 2.0**-24) * linear).all():  # the host's own is rounded, too
        raise MismatchError(f"sRGB: {(error / linear).max() / CURVE_ERROR:.3g} times the allowed error")


CHECKS: tuple[Callable[[Device, np.random.Generator], None], ...] = (
    arithmetic, vectors, groups, turns, nearest, image_stages, output, arrival,
)  # fmt: skip


def gflops(device: Device) -> float:
    """Speed of a convolution's inner loop, the best of three; the work grows until it takes 10 ms."""
    steps = 64
    weights = _upload(device, np.ones((steps, 8), np.float32))
    kernel = Kernel(program_for(device, "selftest.cl", flags="-cl-mad-enable"), "speed", {"weights": weights, "steps": steps})
    best, took, items = 0.0, 0.0, 64
    while took < 0.01 and items < 2**22:
        out = cl.Buffer(device.context, cl.mem_flags.WRITE_ONLY, items * 32)
        kernel.set(out=out)
        for _ in range(3):
            start = time.perf_counter()
            kernel.enqueue(device.queue, (items,), None)
            device.queue.finish()
            took = time.perf_counter() - start
            best = max(best, 64e-9 * steps * items / took)
        items *= 4
    return best


def examine(device: Device, trial: str = REALTIME) -> SelfTestResult:
    """Run every check; the first fault counts."""
    for check in (*CHECKS, partial(frames, trial=trial)):
        try:
            check(device, np.random.default_rng(0))
        except (MismatchError, DeviceError) as fault:
            return SelfTestResult(str(fault))
        except cl.Error as error:
            return SelfTestResult(f"{getattr(check, '__name__', 'frames')}: {' '.join(str(error).split())}")
    return SelfTestResult("", round(gflops(device), 3))


def _upload(device: Device, array: NDArray[Any]) -> cl.Buffer:
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return cl.Buffer(device.context, flags, hostbuf=np.ascontiguousarray(array))


def _launch(
    device: Device,
    name: str,
    size: tuple[int, ...],
    group: tuple[int, ...] | None,
    inputs: dict[str, NDArray[Any]],
    outputs: dict[str, NDArray[Any]],
    **numbers: int,
) -> None:
    """Run a kernel of ``selftest.cl`` on arrays in and out, and numbers."""
    buffers = {name: _upload(device, array) for name, array in (inputs | outputs).items()}
    Kernel(program_for(device, "selftest.cl"), name, {**buffers, **numbers}).enqueue(device.queue, size, group)
    for argument, array in outputs.items():
        cl.enqueue_copy(device.queue, array, buffers[argument])


def _exact(what: str, got: NDArray[Any], want: NDArray[Any]) -> None:
    wrong = np.argwhere(got != want)
    if len(wrong):
        at = tuple(wrong[0])
        raise MismatchError(f"{what}: {len(wrong)} of {got.size} wrong, first {got[at]} for {want[at]}")


def _within(what: str, got: NDArray[Any], want: NDArray[Any]) -> None:
    error = ratio("network.cl", got, want)
    if not error <= 1:
        raise MismatchError(f"{what}: {error:.3g} times the allowed error")


def _close(what: str, got: NDArray[Any], want: NDArray[Any]) -> None:
    error = np.abs(got - want) / np.spacing(np.abs(want).astype(np.float32))
    if not error.max() <= ULP[what]:
        raise MismatchError(f"{what}: off by {error.max():.3g} ulp, {ULP[what]} allowed")


def main() -> None:
    """Print the result for the device named on the command line."""
    try:
        result = examine(open_device(sys.argv[1]), sys.argv[2])
    except DeviceError as error:
        result = SelfTestResult(str(error))
    print(json.dumps(asdict(result)))  # noqa: T201


if __name__ == "__main__":
    main()
