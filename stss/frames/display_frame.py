# SPDX-License-Identifier: MIT
"""Display frames as stage ``frame`` takes them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from stss.frames.buffers import Buffers
from stss.frames.carried_planes import HIGHLIGHTS, add_highlights, carry, highlights
from stss.images.color import BLOCK, Transfer
from stss_ground.cores import for_blocks
from stss_ref.arrays import Array, Image, Mask, Plane, require_shape
from stss_ref.depth import DepthMode, normalise_depth
from stss_ref.frame import FrameInputs
from stss_ref.holes import holes
from stss_ref.schedule import Schedule, schedule

BackendImage = Any
"""An image where its backend has it: a NumPy array, or for OpenCL on a GPU a ``pyopencl.array`` there."""
WINDOW = 6
"""Stage ``frame`` reads its own display frame and the five before it, and nothing else."""
CHANNELS = {
    "color": (3,),
    "motion": (2,),
    "normal": (3,),
    "position": (3,),
    "stencil": (),
    "nov": (),
    "base_color": (3,),
    "roughness": (),
    "metallic": (),
}
"""The last axis of a display frame's planes; () for a plane (H, W)."""


@dataclass(frozen=True)
class DisplayFrame:
    """A display frame as stage ``frame`` takes it, made once and used by several outputs.

    ``color`` (H, W, 3) display-referred or None, ``motion`` (H, W, 2), ``gbuffer`` (H, W, 9), ``nov`` and ``stencil`` (H, W),
    ``position`` (H, W, 3) in cm; float32, or float16 but for motion and position. ``carried``: planes (H, W, C) of a rendered frame that
    do not go through the network, see `stss.frames.carried_planes`.
    """

    number: int
    color: Image | None
    motion: Image
    gbuffer: Image
    nov: Plane
    stencil: Plane
    position: Image
    carried: Mapping[str, Image] = field(default_factory=dict[str, Image])


def make_display_frame(buffers: Buffers, to_display: Transfer, depth: DepthMode, *, copy: bool = True) -> DisplayFrame:
    """Make a display frame: colour through the transfer, depth normalised to [0, 1], G-buffer stacked.

    ``copy`` False: motion, NoV, stencil and position stay the caller's arrays where they are float32; the caller must not write to them
    while the frame is in use.

    Raises:
        ArrayError: a plane has another shape than `Buffers` says.
    """
    height, width = size = buffers.size
    for name, channels in CHANNELS.items():
        if name != "color" or buffers.color is not None:
            require_shape(name, getattr(buffers, name), (*size, *channels))
    color, normal, base_color = buffers.color, np.moveaxis(buffers.normal, -1, 0), np.moveaxis(buffers.base_color, -1, 0)
    shown, above, gbuffer = (np.empty((*size, n), np.float32) for n in (3, 3, 9))
    # One channel at a time: NumPy is slow where the axis that lies together has three numbers.
    z = buffers.depth if buffers.depth.dtype in (np.float32, np.float64) else buffers.depth.astype(np.float32)
    planes = [*normal, normalise_depth(z, depth), buffers.roughness, buffers.metallic, *base_color]
    fills = [(gbuffer[..., i], plane) for i, plane in enumerate(planes)]

    def own(plane: Array) -> Array:
        if not copy and plane.dtype == np.float32 and plane.flags.c_contiguous:
            return np.asarray(plane)
        fills.append((np.empty(plane.shape, np.float32), plane))
        return fills[-1][0]

    motion, nov, stencil, position = map(own, (buffers.motion, buffers.nov, buffers.stencil, buffers.position))

    def fill(rows: slice) -> bool:
        for owned, plane in fills:
            owned[rows] = plane[rows]
        if color is None:
            return False
        shown[rows] = to_display.encode(color[rows])
        bright = highlights(color[rows]) if to_display.clips else None
        above[rows] = 0 if bright is None else bright
        return bright is not None

    has_highlights = any(for_blocks(height, max(1, BLOCK // width), fill))
    carried = {} if color is None else {name: np.array(plane, np.float32, order="C") for name, plane in buffers.carried.items()}
    if has_highlights:
        carried[HIGHLIGHTS] = above
    return DisplayFrame(
        number=int(buffers.number),  # the next of a NumPy number of 8 bits may be negative
        color=None if color is None else shown,
        motion=motion,
        gbuffer=gbuffer,
        nov=nov,
        stencil=stencil,
        position=position,
        carried=carried,
    )


def same_surface(before: DisplayFrame, now: DisplayFrame) -> Mask:
    """(H, W) True where the motion of ``now`` leads to the same surface in the frame ``before`` it (stage ``holes``)."""
    return holes(
        now.motion,
        stencil_previous=before.stencil,
        stencil=now.stencil,
        normal_previous=before.gbuffer[..., :3],
        normal=now.gbuffer[..., :3],
        position_previous=before.position,
        position=now.position,
        nov=now.nov,
        depth=now.gbuffer[..., 3],
    )


def window_at(frames: Sequence[DisplayFrame], position: int) -> Sequence[DisplayFrame]:
    """The frames that the output of ``frames[position]`` depends on: that frame and up to five before it; ``frames`` are consecutive."""
    return frames[max(0, position - WINDOW + 1) : position + 1]


def schedule_of(window: Sequence[DisplayFrame]) -> Schedule | None:
    """The schedule of the newest frame of ``window``; None for an EF with no rendered frame just before it."""
    window = window[-WINDOW:]
    newest = window[-1].number
    rendered = {frame.number for frame in window if frame.color is not None}
    return schedule(newest, rendered, reach=newest - window[0].number)


def frame_inputs(window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> FrameInputs:
    """Stack the inputs of stage ``frame`` for the newest frame of ``window``.

    Args:
        window: consecutive display frames, oldest first, at least ``max(steps) + 1`` of them.
        steps: how many frames back the three colour frames lie, newest first.

    Returns:
        The inputs, float32 also where planes are float16.
    """
    back = window[::-1]
    colors = [back[step].color for step in steps]
    views = (back[0], *(back[step] for step in steps))

    def stack(arrays: list[Array]) -> Array:
        return np.stack([_wide(array) for array in arrays]) if arrays else np.empty((0, *back[0].motion.shape), np.float32)

    return FrameInputs(
        colors=stack([color for color in colors if color is not None]),
        steps=steps,
        motions=stack([prepared.motion for prepared in back[: max(steps)]]),
        gbuffer=_wide(back[0].gbuffer),
        nov=_wide(back[0].nov),
        stencils=stack([prepared.stencil for prepared in views]),
        normals=stack([prepared.gbuffer[..., :3] for prepared in views]),
        positions=stack([prepared.position for prepared in views]),
    )


def _wide(plane: Array) -> Array:
    return plane.astype(np.float32) if plane.dtype == np.float16 else plane


class OnHost:
    """The part of a backend (``stss.frames.backends.Backend``) behind stage ``frame``, in NumPy."""

    def deliver(
        self, image: Image, curve: Transfer, planes: Mapping[str, Image], motion: Image | None
    ) -> tuple[Image, dict[str, Image]]:
        """See ``Backend``."""
        color, carried = curve.decode(image), {name: carry(plane, motion) for name, plane in planes.items()}
        if (above := carried.pop(HIGHLIGHTS, None)) is not None:
            add_highlights(color, image, above)
        return color, carried


class OnArrays(OnHost, ABC):
    """A backend (``stss.frames.backends.Backend``) that computes every frame from stacked arrays, without earlier results."""

    cost: None = None
    window: int | None = WINDOW

    def expect(self, size: tuple[int, int]) -> None:
        """See ``Backend``: nothing needs to be prepared."""
        del size

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See ``Backend``."""
        return self.frame(frame_inputs(window, steps))

    @abstractmethod
    def frame(self, inputs: FrameInputs) -> tuple[Image, Mask]:
        """The same for stacked arrays."""
