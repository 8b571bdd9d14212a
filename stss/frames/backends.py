# SPDX-License-Identifier: MIT
"""The backends that compute frames: the reference, and OpenCL devices."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from threading import Lock
from typing import Protocol

from stss.frames.accumulation import Accumulation, accumulate_arrays, accumulates
from stss.frames.carried_planes import HIGHLIGHTS, WHITE
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW, BackendImage, DisplayFrame, OnArrays
from stss.images.color import Transfer
from stss.weights.file import LoadedWeights, load
from stss_cl.cost import Cost
from stss_cl.liveness import has_residual
from stss_ground.arguments import require_choice, require_kind
from stss_ground.errors import InputError
from stss_ground.terminal import log
from stss_ref.arrays import Image, Mask
from stss_ref.frame import FrameInputs, frame, prepare_for
from stss_ref.resample import upsample_centres
from stss_ref.weights import Weights, check

NETWORK = "network"
"""The method that uses the network; `stss_lab.baselines` has the others."""
BACKENDS = ("cl", "ref")
"""The names that ``open_backend`` takes."""
DEFAULTS = ComputeOptions()


class Backend(Protocol):
    """Computes stage ``frame``.

    Attributes:
        name: goes into the metadata of every output file, and into the key that ``--resume`` compares.
        method: likewise: ``network``, or another method for comparison.
        window: the number of display frames that an output depends on, its own included; None: all before it, and ``compute`` must be
            called for each in turn.
    """

    name: str
    method: str

    @property
    def window(self) -> int | None: ...  # noqa: D102

    @property
    def cost(self) -> Cost | None:
        """The cost of the last frame; None where every frame costs the same."""
        ...

    def expect(self, size: tuple[int, int]) -> None:
        """Prepare for frames of (H, W) in advance; otherwise the first ``compute`` does so."""
        ...

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[BackendImage, Mask]:
        """``(image (2H, 2W, 3), valid (H, W))`` as ``stss_ref.frame.frame``, for the last frame of ``window``.

        The image may be on the backend's device.

        Args:
            window: consecutive display frames, oldest first, up to ``Backend.window`` of them; the caller must not change a frame that
                it has passed before.
            steps: how many frames back the three colour frames lie, newest first.
        """
        ...

    def deliver(
        self, image: BackendImage, curve: Transfer, planes: Mapping[str, Image], motion: Image | None
    ) -> tuple[Image, dict[str, Image]]:
        """Bring an image to the domain that its colours came in, and planes past the network to its size and time.

        Args:
            image: (2H, 2W, 3) display-referred, of ``compute``.
            curve: the transfer of its colours.
            planes: of the newest rendered frame, see `stss.frames.carried_planes.carry`.
            motion: (H, W, 2) that leads from the display frame to the rendered one; None: they are the same frame.

        Returns:
            The colour, with the highlights of the plane `stss.frames.carried_planes.HIGHLIGHTS`; and the other planes.

        Raises:
            ArrayError: ``image`` holds NaN or Inf: a fault of the network that must not be hidden.
        """
        ...


class ReferenceBackend(OnArrays):
    """``stss_ref``, in the dtype of the inputs."""

    name, method = "ref", NETWORK

    def __init__(self, weights: Weights):
        self._weights, self._residual = weights, has_residual(weights)

    def frame(self, inputs: FrameInputs) -> tuple[Image, Mask]:
        """See ``Backend``."""
        if self._residual:
            return frame(inputs, self._weights)
        prepared = prepare_for(self._weights, inputs)
        return upsample_centres(prepared.color[..., :3]), prepared.mask.astype(bool)


class OpenCLBackend:
    """``stss_cl`` on one device; its name holds precision, device and driver, since bits may differ between them."""

    method, window = NETWORK, WINDOW

    def __init__(self, weights: Weights, options: ComputeOptions, tell: Callable[[str], None]):
        self._alone = Lock()
        # Imported here, so that the OpenCL library is opened only by commands that use it.
        from stss.devices.selection import choose
        from stss.devices.trial import trial_for
        from stss_cl.device.amx import why_emulated
        from stss_cl.image_space.accumulate import Accumulate
        from stss_cl.image_space.output import OutputKernels
        from stss_cl.skip.stream import Stream

        device = choose(options.device, tell, trial=trial_for(weights))
        if options.precision == "bfloat16" and (why := why_emulated(device)):
            tell(f"bfloat16: {why}; emulated, which is slow")
        self._stream = Stream(weights, device, options.precision, memory_limit=options.memory_limit, skip=options.skip)
        self._accumulate, self._output = Accumulate(device), OutputKernels(device)
        role = "" if device.kind.lower() == device.device_class else f" as {device.device_class}"
        self.device = device
        self.name = f"cl {options.precision} on {device.name}{role}, {device.driver}"

    def expect(self, size: tuple[int, int]) -> None:
        """See ``Backend``."""
        with self._alone:
            self._stream.expect(size)
            self._output.load()

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[BackendImage, Mask]:
        """See ``Backend``; threads that share a backend take turns. On a GPU the image stays there."""
        with self._alone:
            return self._stream(window, steps, stay=True)

    def accumulate(self, image: BackendImage, earlier: Sequence[BackendImage], motions: Sequence[Image]) -> BackendImage:
        """See `stss.frames.accumulation.Accumulate`."""
        with self._alone:
            return self._accumulate(image, earlier, [self._stream.motion_on_device(motion) for motion in motions])

    def deliver(
        self, image: BackendImage, curve: Transfer, planes: Mapping[str, Image], motion: Image | None
    ) -> tuple[Image, dict[str, Image]]:
        """See ``Backend``."""
        with self._alone:
            way = None if motion is None else self._stream.motion_on_device(motion)
            return self._output.deliver(image, planes, way, srgb=curve.name == "srgb", highlights=HIGHLIGHTS, white=WHITE)

    @property
    def cost(self) -> Cost:
        """See ``Backend``."""
        return self._stream.cost


def open_backend(
    name: str,
    weights: str | Weights | LoadedWeights,
    options: ComputeOptions = DEFAULTS,
    *,
    tell: Callable[[str], None] = log,
) -> Backend:
    """Open a backend by its name.

    Args:
        name: one of ``BACKENDS``.
        weights: loaded weights, or an argument of `stss.weights.file.load`.
        options: device, precision, memory limit, skipping and accumulation.
        tell: called with lines for the user, for example when a self-test runs; by default the logger ``stss`` gets them as warnings.

    Raises:
        InputError: there is no such backend, or it does not take these options.
        stss_ground.errors.DeviceError: there is no such device.
    """
    require_kind("options", options, ComputeOptions, "ComputeOptions")
    if not callable(tell):
        raise InputError(f"tell: expected a function of a line, got {type(tell).__name__}")
    require_choice("backend", name, BACKENDS)
    weights = load(weights) if isinstance(weights, (str, os.PathLike)) else weights
    mixes = accumulates(weights, options) if isinstance(weights, LoadedWeights) else bool(options.accumulate)
    weights = weights.weights if isinstance(weights, LoadedWeights) else weights
    require_kind("weights", weights, (Weights, Mapping), "a name, a file, or weights that are loaded")
    weights = check(weights)
    if name == "cl":
        backend = OpenCLBackend(weights, options, tell)
        return Accumulation(backend, backend.accumulate) if mixes else backend
    if options.device is not None or options.precision != "float32":
        raise InputError("backend ref: expected neither a device nor another precision than float32")
    reference = ReferenceBackend(weights)
    return Accumulation(reference, accumulate_arrays) if mixes else reference
