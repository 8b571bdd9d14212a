# SPDX-License-Identifier: MIT
"""An engine's loop: one display frame in, one out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from threading import Lock
from typing import NoReturn, get_args

import numpy as np

from stss.frames.backends import Backend, open_backend
from stss.frames.buffers import Buffers
from stss.frames.check_buffers import check_buffers
from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW, DisplayFrame, make_display_frame
from stss.frames.output import Output, compute
from stss.images.color import transfer as transfer_named
from stss.images.headers import MAX_SIDE
from stss.weights.file import REALTIME, LoadedWeights
from stss_cl.options import Precision, Skip
from stss_ground.arguments import require_choice, require_kind
from stss_ground.errors import InputError
from stss_ground.terminal import log
from stss_ref.depth import DepthMode
from stss_ref.weights import Weights


class Supersampler:
    """Makes twice the resolution and twice the frame rate from display frames, which the caller passes one by one.

    It keeps copies of up to six display frames, 76 bytes a pixel each, so the caller may reuse its arrays.
    """

    def __init__(
        self,
        weights: str | Weights | LoadedWeights = "auto",
        *,
        backend: str | Backend = "cl",
        device: str | None = None,
        precision: Precision = "float32",
        memory_limit: int | None = None,
        skip: Skip = "exact",
        accumulate: bool | None = None,
        transfer: str = "srgb",
        depth: DepthMode = "scale",
        copy: bool = True,
        check: bool = True,
        tell: Callable[[str], None] = log,
    ):
        """Open the backend.

        Args:
            weights: ``auto`` (``realtime``, since nothing is known of the frames), ``realtime``, ``antialiased``, ``bilinear``, a
                ``.safetensors`` file, or loaded weights.
            backend: ``cl``, ``ref`` or one from `open_backend`; then the options up to ``accumulate`` are its own.
            device: part of an OpenCL device's name; None: ``$STSS_DEVICE``, or the fastest.
            precision: of ``stss_cl.options.PRECISIONS``.
            memory_limit: bytes for the network's buffers; larger frames are computed in strips, with the same bits.
            skip: ``exact``: unchanged parts are not computed again, with the same bits; ``off``.
            accumulate: mix each image with the two before it (`stss_ref.accumulate`): less flicker; None: if the weights are made for
                aliased input, as ``realtime`` is.
            transfer: ``srgb``: scene-linear; the part above 1 is carried past the network. ``none``: display-referred.
            depth: ``scale`` or ``clip`` (spec 0).
            copy: False: motion, NoV, stencil and position are not copied; the caller must not write to them for six frames.
            check: False: planes are not checked before use.
            tell: called with lines for the user, for example when a device is tested, which takes half a minute or more; by default the
                logger ``stss`` gets them as warnings.

        Raises:
            InputError: an option has another value, or weights cannot be read.
            DeviceError: there is no such device.
        """
        require_choice("depth", depth, get_args(DepthMode))
        for name, value in (("copy", copy), ("check", check)):  # a word such as "no" would count as True
            require_kind(name, value, (bool, np.bool_), "True or False")
        self._curve, self._copy, self._check = transfer_named(transfer), copy, check
        self._depth: DepthMode = depth
        if isinstance(backend, str):
            options = ComputeOptions(device, precision, memory_limit, skip, accumulate)
            is_auto = isinstance(weights, str) and weights == "auto"
            backend = open_backend(backend, REALTIME if is_auto else weights, options, tell=tell)
        if not all(callable(getattr(backend, name, None)) for name in ("compute", "deliver", "expect")):
            raise InputError(f"backend: expected a name or one from open_backend, got {type(backend).__name__}")
        self.backend = backend
        self._busy = Lock()
        self._window: deque[DisplayFrame] = deque(maxlen=WINDOW)

    def push(self, buffers: Buffers) -> Output | None:
        """Take the next display frame and return its output, without waiting for a later frame.

        A frame begins a new history if it has ``cut``, another size, or a number that does not follow the previous one.

        Args:
            buffers: the frame; ``color`` is None where it was not rendered.

        Returns:
            The output; None for a frame that was not rendered, if no rendered frame precedes it directly.

        Raises:
            InputError: a plane does not fit `Buffers`, or another thread is within ``push``. After this and any other exception the
                frame was not taken.
        """
        if not self._busy.acquire(blocking=False):
            raise InputError(
                "Supersampler: another thread is within push, and frames have an order; expected one for each thread: they may share a "
                "backend from open_backend"
            )
        try:
            # The program around it may have NumPy raise errors for arithmetic that is done here on purpose.
            with np.errstate(all="ignore"):
                return self._push(buffers)
        finally:
            self._busy.release()

    def _push(self, buffers: Buffers) -> Output | None:
        if self._check:
            check_buffers(buffers)
        frame = make_display_frame(buffers, self._curve, self._depth, copy=self._copy)
        last = self._window[-1] if self._window else None
        if last is not None and (buffers.cut or frame.number != last.number + 1 or frame.nov.shape != last.nov.shape):
            self.reset()
        output = compute((*self._window, frame)[-WINDOW:], self.backend, self._curve)
        self._window.append(frame)  # now: a call that was interrupted, or ran out of memory, may be made again
        return output

    def __call__(self, frames: Iterable[Buffers]) -> Iterator[Output]:
        """Push frame after frame; yields each output before it reads the next frame.

        Raises:
            InputError: as ``push``, or ``frames`` is not an iterable.
        """
        require_kind("frames", frames, Iterable, "an iterable of Buffers")
        for buffers in frames:
            output = self.push(buffers)
            if output is not None:
                yield output

    def reset(self) -> None:
        """Forget all earlier frames, as at a cut."""
        self._window.clear()

    def warm_up(self, size: tuple[int, int]) -> None:
        """Build kernels and buffers for frames of (H, W), so that the first one does not wait for them.

        Raises:
            InputError: ``size`` is not two whole numbers from 1 to 16384.
        """
        require_kind("size", size, (tuple, list), "(H, W)")
        for n in size:
            require_kind("size", n, (int, np.integer), "(H, W) of whole numbers")
        if len(size) != 2 or not all(1 <= n <= MAX_SIDE for n in size):
            raise InputError(f"size: expected (H, W), each from 1 to {MAX_SIDE}, got {size!r}")
        self.backend.expect((int(size[0]), int(size[1])))

    def __reduce__(self) -> NoReturn:
        """Refuse to be pickled or copied: a device and its buffers belong to one process."""
        raise InputError("Supersampler: cannot be pickled or copied; expected one for each process, opened there")


def supersample(
    frames: Iterable[Buffers], backend: Backend, *, transfer_name: str = "srgb", depth: DepthMode = "scale"
) -> Iterator[Output]:
    """Compute every display frame at twice its size, those that were not rendered too.

    Args:
        frames: display frames in order; ``color`` is None where a frame was not rendered.
        backend: from `open_backend`.
        transfer_name: as ``transfer`` of `Supersampler`.
        depth: ``clip`` or ``scale`` (spec 0).

    Returns:
        An iterator with an `Output` for every frame, except for one with neither colour nor a rendered frame just before it.

    Raises:
        InputError: an option or a plane is wrong.
    """
    return Supersampler(backend=backend, transfer=transfer_name, depth=depth)(frames)
