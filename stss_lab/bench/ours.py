# SPDX-License-Identifier: MIT
"""Our own contenders in the benchmark, and the inputs of all contenders."""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from stss.frames.backends import open_backend
from stss.frames.buffers import Buffers
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW
from stss.frames.supersampler import Supersampler
from stss_ground.machine import versions
from stss_lab.bench.contender import Contender, Setup
from stss_lab.bench.peers import PEERS
from stss_ref.arrays import Image
from stss_ref.frame import FrameInputs, NetworkInputs, frame
from stss_ref.network import network
from stss_ref.weights import Weights, astype

MOTION = (1.5, 0.75)
"""Motion in the inputs of whole frames, pixels a frame: float32 has all positions exactly, so that rounding decides no hole."""


class Reference:
    """``stss_ref`` in float32."""

    def __init__(self, setup: Setup):
        self._weights = setup.weights
        self.details = {"numpy": np.__version__, "precision": "float32"}

    def prepare(self, inputs: NetworkInputs) -> None:
        """See `Contender`."""
        self._inputs = inputs

    def run(self) -> None:
        """See `Contender`."""
        self._image = network(**vars(self._inputs), weights=self._weights)

    def image(self) -> Image:
        """See `Contender`."""
        return self._image


class OpenCL:
    """``Network`` or ``Frame`` of ``stss_cl``; ``timings`` returns the seconds of each stage.

    Args:
        setup: weights and device.
        name: name of the class.
        precision: of ``stss_cl.options.PRECISIONS``.
        on_device: inputs and image stay on the device, as the peers' inputs and images do; else both are NumPy arrays.
    """

    def __init__(self, setup: Setup, *, name: str, precision: str, on_device: bool):
        device = importlib.import_module("stss_cl.device.discovery").open_device(setup.device)
        make: Any = getattr(importlib.import_module("stss_cl"), name)
        self._network = make(setup.weights, device, precision=precision)
        self.timings: Callable[[], dict[str, float]] = self._network.timings
        self._queue = device.queue
        self._on_device = on_device
        scope = "on the device" if on_device else "with transfers"
        self.details = {**versions(("pyopencl",)), "device": device.name, "precision": precision, "timed": scope}
        if device.is_cpu:
            self.details["threads"] = str(device.handle.max_compute_units)

    def prepare(self, inputs: NetworkInputs | FrameInputs) -> None:
        """See `Contender`."""
        self._inputs: dict[str, Any] = dict(vars(inputs))
        if self._on_device:
            to_device: Any = importlib.import_module("pyopencl.array").to_device
            arrays = {n: x for n, x in self._inputs.items() if isinstance(x, np.ndarray)}
            self._inputs |= {n: to_device(self._queue, np.ascontiguousarray(x)) for n, x in arrays.items()}

    def run(self) -> None:
        """See `Contender`."""
        self._image: Any = self._network(**self._inputs)
        self._queue.finish()

    def image(self) -> Image:
        """See `Contender`."""
        image = self._image[0] if isinstance(self._image, tuple) else self._image
        return image.get() if self._on_device else image


class StreamContender:
    """``stss_cl.Stream`` on display frames, NumPy arrays, each uploaded once; SF and EF in turns, each computed whole.

    Args:
        setup: weights and device.
        ahead: each frame starts before the previous one is returned; else one call a frame.
    """

    frames = 24
    """Frames of a run: enough that the first one, which has no frame before it, hardly counts."""

    def __init__(self, setup: Setup, *, ahead: bool):
        device = importlib.import_module("stss_cl.device.discovery").open_device(setup.device)
        self._stream: Any = importlib.import_module("stss_cl").Stream(setup.weights, device, skip="off")
        self._ahead, self._window = ahead, deque[Any](maxlen=WINDOW)
        scope = f"with transfers, {'one frame ahead' if ahead else 'frames one by one'}"
        self.details = {**versions(("pyopencl",)), "device": device.name, "precision": "float32", "timed": scope}

    def prepare(self, inputs: FrameInputs) -> None:
        """See `Contender`: the last frame of each run is that of ``inputs``."""
        arrays: dict[str, Any] = {"motion": inputs.motions[0], "gbuffer": inputs.gbuffer, "nov": inputs.nov}
        arrays["stencil"] = inputs.stencils[0]
        self._frames: list[dict[str, Any]] = []
        for step in reversed(range(WINDOW)):
            planes = {name: array.copy() for name, array in arrays.items()}
            planes["position"] = inputs.positions[0] - np.array((step * MOTION[0], step * MOTION[1], 0), np.float32)
            planes["color"] = inputs.colors[inputs.steps.index(step)] if step in inputs.steps else None
            self._frames.append(planes)
            self._window.append(SimpleNamespace(**planes))

    def run(self) -> None:
        """See `Contender`."""
        calls = self._calls()
        for image, _ in self._stream.frames(calls) if self._ahead else (self._stream(*call) for call in calls):
            self._image = image

    def _calls(self) -> Iterator[tuple[tuple[Any, ...], tuple[int, int, int]]]:
        for i in range(self.frames):
            self._window.append(SimpleNamespace(**self._frames[i % WINDOW]))  # a new object is a new frame
            yield tuple(self._window), (1, 3, 5) if i % 2 else (0, 2, 4)

    def image(self) -> Image:
        """See `Contender`."""
        return self._image


class PushContender:
    """``stss.Supersampler.push`` as an engine calls it: NumPy arrays, frames with colour and without in turns, each computed whole.

    Colours are scene-linear with highlights, images are mixed with earlier ones. So the output is not that of stage ``frame``.
    """

    frames = StreamContender.frames

    def __init__(self, setup: Setup):
        backend = open_backend("cl", setup.weights, ComputeOptions(setup.device, skip="off", accumulate=True))
        self._loop = Supersampler(backend=backend)
        self._frames: list[Buffers] = []
        self.details = {**versions(("pyopencl",)), "device": backend.name, "precision": "float32", "timed": "with transfers"}

    def prepare(self, inputs: FrameInputs) -> None:
        """See `Contender`: the G-buffer is that of ``inputs``, which slides."""
        gbuffer, color = inputs.gbuffer, 2 * inputs.colors[0]
        planes = {"normal": gbuffer[..., :3], "depth": gbuffer[..., 3], "roughness": gbuffer[..., 4], "metallic": gbuffer[..., 5]}
        planes |= {"base_color": gbuffer[..., 6:], "motion": inputs.motions[0], "nov": inputs.nov, "stencil": inputs.stencils[0]}
        arrays: dict[str, Any] = {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
        for number in range(self.frames):
            position = inputs.positions[0] + np.array((number * MOTION[0], number * MOTION[1], 0), np.float32)
            self._frames.append(Buffers(number, None if number % 2 else color, position=position, **arrays))

    def run(self) -> None:
        """See `Contender`."""
        self._loop.reset()
        for buffers in self._frames:
            self._loop.push(buffers)

    def image(self) -> None:
        """There is no truth to compare the image with."""


_NETWORK = partial(OpenCL, name="Network", on_device=True)

PUSH = "cl-push"
"""The contender whose images have no truth."""
OURS: dict[str, Callable[[Setup], Contender]] = {
    "cl": partial(_NETWORK, precision="float32"),
    "cl-direct": partial(_NETWORK, precision="float32-direct"),
    "cl-half": partial(_NETWORK, precision="half"),
    "cl-bfloat16": partial(_NETWORK, precision="bfloat16"),
    "cl-host": partial(_NETWORK, precision="float32", on_device=False),
    "cl-frame": partial(OpenCL, name="Frame", precision="float32", on_device=True),
    "cl-stream": partial(StreamContender, ahead=False),
    "cl-stream-ahead": partial(StreamContender, ahead=True),
    PUSH: PushContender,
    "ref": Reference,
}
"""Our contenders, by the name that ``--ours`` takes; ``cl-host`` is ``cl`` with the transfers from and to NumPy arrays."""

FRAMES = frozenset({"cl-frame", "cl-stream", "cl-stream-ahead", PUSH})
"""Contenders that compute whole frames; the others compute the network alone."""


def contender(name: str, setup: Setup) -> Contender:
    """Make the contender called ``name``, a key of ``OURS`` or ``PEERS``."""
    return (OURS | PEERS)[name](setup)


ONE, DARK = np.float32(1), np.float32(1e-38)
"""Light of a frame, and of a dark one: below the smallest normal number of float32."""


def network_inputs(height: int, width: int, light: np.float32 = ONE) -> NetworkInputs:
    """Inputs (height, width) of noise, so that shortcuts for flat or still parts do not help. Holes make up a fifth of the mask.

    Colours are up to ``light``.
    """
    random = np.random.default_rng(0)

    def noise(*shape: int) -> Image:
        return random.random(shape, np.float32)

    mask = (noise(height, width) < 0.8).astype(np.float32)
    inputs = NetworkInputs(noise(height, width, 6), noise(height, width, 9), mask, noise(3, height, width, 4))
    inputs.color[:] *= light
    inputs.history[..., :3] *= light
    return inputs


def frame_inputs(height: int, width: int, light: np.float32 = ONE) -> FrameInputs:
    """Inputs (height, width) of an extrapolated frame: a plane with noise on it slides past, with holes only where it enters."""
    inputs = network_inputs(height, width, light)
    size = height, width
    steps = (1, 3, 5)
    motions = np.full((5, *size, 2), MOTION, np.float32)
    y, x = np.indices(size, np.float32)
    positions = [np.stack([x - step * MOTION[0], y - step * MOTION[1], 0 * x], axis=-1) for step in (0, *steps)]
    normals = np.full((4, *size, 3), (0, 0, -1), np.float32)
    inputs.gbuffer[..., :3] = normals[0]
    ones = np.ones(size, np.float32)
    return FrameInputs(
        np.ascontiguousarray(inputs.history[..., :3]), steps, motions, inputs.gbuffer, ones, np.zeros((4, *size), np.float32), normals,
        np.stack(positions).astype(np.float32),
    )  # fmt: skip


def inputs_for(name: str, setup: Setup) -> NetworkInputs | FrameInputs:
    """The inputs of the contender ``name``."""
    draw = frame_inputs if name in FRAMES else network_inputs
    return draw(setup.height, setup.width, DARK if setup.dark else ONE)


def truth(inputs: NetworkInputs | FrameInputs, weights: Weights) -> Image:
    """The image of ``inputs`` by the reference in float64."""
    exact: dict[str, Any] = {n: v.astype(np.float64) if isinstance(v, np.ndarray) else v for n, v in vars(inputs).items()}
    weights = astype(weights, np.float64)
    if isinstance(inputs, FrameInputs):
        return frame(FrameInputs(**exact), weights)[0]
    return network(**exact, weights=weights)
