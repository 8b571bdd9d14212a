# SPDX-License-Identifier: MIT
"""Compute display frames one after the other, each only where it changed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import NDArray

from stss_cl.cost import Cost
from stss_cl.device.buffers import Outgoing, Plain, mask_of, on_device
from stss_cl.device.discovery import Device
from stss_cl.device.grid import ceil8
from stss_cl.device.launch import defer_loads
from stss_cl.device.staging import staging
from stss_cl.frame import Frame
from stss_cl.image_space.frame_planes import MOST_STEPS, Sources, check_steps
from stss_cl.network.layer_builder import dtype_of
from stss_cl.network.layers import Layers
from stss_cl.network.strips import bytes_for
from stss_cl.options import SKIPS, Precision, Skip
from stss_cl.skip.arrival import Tiles
from stss_cl.skip.change_control import ChangeControl
from stss_cl.skip.display_frame import DisplayFrame, require_window
from stss_cl.skip.frame_cache import FrameCache, Last
from stss_cl.skip.frames_in_flight import Call, FrameInFlight, one_ahead
from stss_cl.skip.uploaded_frames import UploadedFrame, UploadedFrames, sources
from stss_ground.arguments import require_choice
from stss_ref.arrays import Array, ArrayError, require_dtype, require_shape
from stss_ref.weights import Weights


class Stream:
    """Stage ``frame`` (spec 11) for one display frame after the other; buffers are made once for each size and reused.

    Args:
        weights: the 92 tensors.
        device: to run on; None = ``stss_cl.device.discovery.open_device()``.
        precision: see ``stss_cl.options.PRECISIONS``.
        memory_limit: see ``stss_cl.network.network.Network``; if the data kept between frames do not fit, every frame is computed whole.
        skip: one of ``SKIPS``.

    Raises:
        InputError: as ``Network``, or ``skip`` is unknown.
        DeviceError: as ``Network``.

    Attributes:
        cost: the cost of the last frame.
        control: decides whether to look for changes.
    """

    def __init__(
        self,
        weights: Weights,
        device: Device | None = None,
        precision: Precision = "float32",
        memory_limit: int | None = None,
        skip: Skip = "exact",
    ):
        require_choice("skip", skip, SKIPS)
        self._whole = Frame(weights, device, precision, memory_limit)
        self.device = self._whole.device
        self.precision: Precision = precision
        self.cost = Cost(1.0, "whole")
        self._weights, self._memory = weights, self.device.memory // 2 if memory_limit is None else memory_limit
        self._skip: Skip = skip
        self.control = ChangeControl()
        self._uploaded: UploadedFrames | None = None
        self._caches: dict[bool, FrameCache] = {}
        self._latest: FrameCache | None = None

    def __call__(
        self,
        window: Sequence[DisplayFrame],
        steps: Sequence[int],
        out: NDArray[np.float32] | cla.Array | None = None,
        *,
        stay: bool = False,
    ) -> tuple[Any, Any]:
        """Compute the last frame of ``window``.

        Only the time of a call depends on earlier calls. A frame is recognised in the next window if it is
        the same object. On a CPU the arrays of frames are read in place, and those of a window are compared with the new frames of the
        next one. So the arrays of a frame must not change between two calls whose windows both have the frame; before the first call
        whose window lacks it they may be filled again. A caller that passes windows of six frames thus needs six sets of arrays, and an
        object for each frame.

        Args:
            window: consecutive display frames of one size, oldest first; ``DisplayFrame`` gives shapes and units.
            steps: the distances of the three colour frames, in frames back, newest first; ``window`` holds these frames.
            out: (2H, 2W, 3) float32, C-contiguous: receives a copy of the image; None: the stream returns its own array, on the device if
                the last frame's G-buffer is there.
            stay: on a GPU let the stream's own array of the image stay there, though not that of ``valid``; without ``out``.

        Returns:
            image: (2H, 2W, 3) float32, not clipped: ``out``, or the stream's array, which is read-only if frames are kept. It does not
                change while the caller holds it or a view of it. On a GPU an array there may not yet be complete.
            valid: (H, W) False in the warping holes of the newest colour frame; read-only likewise. On the device uint8.

        Raises:
            ArrayError: shapes, dtypes or steps do not fit, ``out`` has not the image's shape and dtype, or an array other than motion and
                position is not finite.
        """
        if out is None:
            return self.begin(window, steps, stay=stay).finish()
        require_window(window)
        height, width = window[-1].nov.shape
        require_shape("out", out, (2 * height, 2 * width, 3))
        if isinstance(out, cla.Array):
            on_device(self.device, "out", out)
            return self.begin(window, steps, out).finish()
        require_dtype("out", out, np.dtype(np.float32))
        if not (out.flags.c_contiguous and out.flags.writeable):
            raise ArrayError("out: expected a C-contiguous array that can be written to")
        image, valid = self.begin(window, steps, on_host=True).finish()
        np.copyto(out, image)
        return out, valid

    def frames(self, calls: Iterable[Call]) -> Iterator[tuple[Any, Any]]:
        """Compute many frames: ``(image, valid)`` of each ``(window, steps)`` of ``calls`` in turn, with the bits of single calls.

        On a GPU each frame starts before the previous one is returned: while a frame is computed, the planes of the next one are
        uploaded, and the previous image is downloaded. So ``calls`` is read one ahead. The error of a call is raised in its turn, after
        all frames before it. Neither an error nor closing the iterator early harms the stream. ``cost`` is that of the frame returned
        last, ``activity`` that of the frame started last.

        On a CPU nothing is uploaded or downloaded: each frame is computed when the caller asks for it, and its call is read then.
        """
        if self.device.is_cpu:
            for window, steps in calls:
                yield self(window, steps)
            return
        yield from one_ahead(calls, self.begin, self._finish)

    def begin(
        self,
        window: Sequence[DisplayFrame],
        steps: Sequence[int],
        out: cla.Array | None = None,
        *,
        on_host: bool = False,
        stay: bool = False,
    ) -> FrameInFlight:
        """Begin a frame. Its image goes to ``out``; without ``out`` to the device if the frame's G-buffer is there, unless ``on_host``.

        ``stay``: see ``__call__``.
        """
        require_window(window)
        if out is None and not on_host and not stay and isinstance(window[-1].gbuffer, cla.Array):
            height, width = window[-1].nov.shape
            out = cla.empty(self.device.queue, (2 * height, 2 * width, 3), np.float32, allocator=self.device.pool)
        try:
            frame = self._enqueue(window, steps, out, stay=stay and not self.device.is_cpu)
        except BaseException:
            self.device.queue.finish()  # commands read arrays in place, which the caller may drop now
            raise
        assert self._uploaded is not None
        try:
            self._uploaded.require_finite()
        except ArrayError:
            frame.finish()
            for cache in self._caches.values():
                cache.last = None  # it may have been computed from non-finite values
            raise
        return frame

    def _finish(self, frame: FrameInFlight) -> tuple[Any, Any]:
        self.cost = frame.cost
        return frame.finish()

    def _enqueue(
        self, window: Sequence[DisplayFrame], steps: Sequence[int], out: cla.Array | None, *, stay: bool
    ) -> FrameInFlight:
        distances = check_steps(steps)
        if len(window) <= distances[2]:
            raise ArrayError(f"window: expected the {distances[2] + 1} frames that the steps lead to, got {len(window)}")
        if any(window[-1 - step].color is None for step in distances):
            raise ArrayError(f"window: expected a colour {', '.join(map(str, distances))} frames back")
        shape: Any = window[-1].nov.shape
        window, size = window[-MOST_STEPS - 1 :], shape
        uploaded, cache = self._arriving(size), self._keep(size, extrapolates=distances[0] > 0)
        looking = self.control.begin()
        frames = uploaded.take(window, compare=cache is not None and looking)
        self._latest = cache
        if cache is None:
            self.cost = Cost(1.0, "whole")
            return self._compute_whole(sources(frames, distances), size, out, stay=stay)
        dirty = self._dirty(uploaded, cache, frames, cache.read(distances)) if looking else None
        valid = self._compute(cache, frames, distances, dirty, looking)
        return self._hand_out(cache, frames, distances, out, valid, stay=stay)

    def expect(self, size: tuple[int, int], back_from: float | None = None) -> None:
        """Build all kernels and buffers for frames of (H, W), for example while the first is read, so that no call builds any.

        An exception: the first call with a plane of half builds the kernel that widens it.

        Args:
            size: of the frames.
            back_from: build the kernels before this share of them first, and all in reverse order. Processes that do so from different
                ones share the work with one that does not, if the compiler has a cache.
        """
        with defer_loads() as loads:
            self._arriving(size).load()
            if None in [self._keep(size, extrapolates=kind) for kind in (False, True)]:
                self._whole.expect(size)
        once = {load.key: load for load in reversed(loads)}
        order = [load for load in loads if once[load.key] is load]
        if back_from is not None:
            end = round(back_from * len(order))
            order = [*order[:end][::-1], *order[end:][::-1]]
        for load in (*order, *(load for load in loads if once[load.key] is not load)):
            load.run()
        self.device.queue.finish()  # some runtimes compile only when the queue runs
        if not self.device.is_cpu:
            staging(self.device).uploads.finish()

    def motion_on_device(self, motion: Array) -> Plain:
        """The array, or on a GPU its uploaded copy, if it is the motion of a frame of the last window. Until the next call."""
        buffer = None if self.device.is_cpu or self._uploaded is None else self._uploaded.find_motion(motion)
        return motion if buffer is None else cla.Array(self.device.queue, motion.shape, motion.dtype, data=buffer)

    def activity(self) -> NDArray[np.float32]:
        """The share of the network that the last frame needed, for each 4 x 4 of its pixels: from 0, nothing, to 1, everything.

        For a frame computed only where something changed, this is the share of the stored activations that changed.
        """
        assert self._uploaded is not None, "no frame was computed yet"
        rows, columns = (-(-length // 4) for length in self._uploaded.size)
        network = self.cost.network
        if self._latest is None or network != "changed":
            return np.full((rows, columns), network != "none", np.float32)
        return self._latest.partial.activity()[:rows, :columns]

    def _compute(
        self,
        cache: FrameCache,
        frames: list[UploadedFrame],
        steps: tuple[int, int, int],
        dirty: Tiles | None,
        looking: bool,
    ) -> Outgoing | None:
        """Plan the frame, execute the plan, learn from its cost. ``dirty``, ``looking``: see ``FrameCache.prepare_inputs``.

        Returns:
            The mask ``valid`` if it is the last one and on the host; None: it is on the device.
        """
        if cache.last is not None and dirty is not None and not dirty.any():
            self.cost = Cost(0.0, "none")
            return cache.last.valid
        changed = cache.prepare_inputs(sources(frames, steps), dirty, looking=looking)
        network = self.control.plan(changed)
        cache.execute(network)
        self.control.learn(network)
        self.cost = Cost(changed, network)
        return None

    def _hand_out(
        self,
        cache: FrameCache,
        frames: list[UploadedFrame],
        steps: tuple[int, int, int],
        out: cla.Array | None,
        valid: Outgoing | None,
        *,
        stay: bool,
    ) -> FrameInFlight:
        """The image and ``valid``, see ``_compute``; the frame becomes the last SF or EF."""
        if out is not None:
            cache.image.copy_to(out)
            cache.last = _last(frames, cache.read(steps), valid)
            there = mask_of(self.device, cache.prepare.mask, cache.layers.size, on_device=True)
            return FrameInFlight(out, there.array, self._commands(), self.cost)
        if valid is None:
            valid = mask_of(self.device, cache.prepare.mask, cache.layers.size, on_device=False)
        cache.last = _last(frames, cache.read(steps), valid)
        coming: tuple[Outgoing, ...] = (valid,)
        if stay:
            array: Any = cache.image.lend_there()
        else:
            array, image = cache.image.lend()
            coming = image, valid
        valid.send()
        mask = valid.array.view(np.bool_)
        mask.flags.writeable = False
        return FrameInFlight(array, mask, coming, self.cost)

    def _compute_whole(self, planes: Sources, size: tuple[int, int], out: cla.Array | None, *, stay: bool) -> FrameInFlight:
        """Compute a frame without keeping anything for the next one."""
        there = out is not None
        image = Outgoing(self.device, (2 * size[0], 2 * size[1], 3), on_device=there or stay)
        valid = mask_of(self.device, self._whole.start(planes, size, image.data), size, on_device=there)
        if out is not None:
            to: Any = out.base_data
            cl.enqueue_copy(self.device.queue, to, image.data, byte_count=out.nbytes, dst_offset=out.offset)
            return FrameInFlight(out, valid.array, self._commands(), self.cost)
        image.send()
        valid.send()
        return FrameInFlight(image.array, valid.array.view(np.bool_), (image, valid), self.cost)

    def _commands(self) -> tuple[cl.CommandQueue, ...]:
        """The commands that a frame on the device waits for, on a CPU: they use memory of the host, which others may free afterwards."""
        return (self.device.queue,) if self.device.is_cpu else ()

    def _arriving(self, size: tuple[int, int]) -> UploadedFrames:
        if self._uploaded is None or self._uploaded.size != size:
            self._caches.clear()
            self._uploaded = UploadedFrames(self.device, *size)
        return self._uploaded

    def _keep(self, size: tuple[int, int], *, extrapolates: bool) -> FrameCache | None:
        """The cache of SF, or of EF; None if nothing is kept."""
        if self._skip == "off":
            return None
        if extrapolates not in self._caches:
            if not self._can_keep(size):
                self._skip = "off"
                return None
            layers = Layers(self.device, self._weights, size, self.precision, self._memory, keep=True)
            self._caches[extrapolates] = cache = FrameCache(self.device, layers)
            cache.load()  # here rather than at the first change
        return self._caches[extrapolates]

    def _can_keep(self, size: tuple[int, int]) -> bool:
        """Whether the memory limit allows a cache for SF and one for EF."""
        height, width = map(ceil8, size)
        return 2 * bytes_for(height, height, width, dtype_of(self.precision), keep=True) <= self._memory

    def _dirty(
        self, uploaded: UploadedFrames, cache: FrameCache, frames: list[UploadedFrame], steps: tuple[int, ...]
    ) -> Tiles | None:
        """The tiles in which the network's inputs may differ from those of the last SF or EF; None: everywhere.

        They are equal where nothing moves, and surface and colours are the same in all frames that the two read.
        """
        last = cache.last
        if last is None or _are_missing(steps) != _are_missing(last.steps):
            return None
        oldest, newest = min(last.oldest, frames[-1 - steps[-1]].number), max(last.number, frames[-1].number)
        moved = uploaded.changed(oldest, newest)
        if moved is None:
            return None
        for step, before in zip(steps, last.colors, strict=True):
            recolored = uploaded.color_changed(frames[-1 - step].number, before)
            if recolored is None:
                return None
            moved = moved | recolored
        return moved


def _last(frames: list[UploadedFrame], steps: tuple[int, ...], valid: Outgoing | None) -> Last:
    return Last(frames[-1].number, frames[-1 - steps[-1]].number, steps, tuple(frames[-1 - step].number for step in steps), valid)


def _are_missing(steps: tuple[int, ...]) -> list[bool]:
    """For each older colour frame, whether it replaces a missing one."""
    return [older == newer for newer, older in pairwise(steps)]
