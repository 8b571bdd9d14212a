"""Inputs of noise: of the network, of a frame, and display frames of which chosen parts change from one to the next."""

from dataclasses import fields, replace

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from stss.frames.display_frame import DisplayFrame, schedule_of, window_at
from stss_cl.skip.planes import HALF
from stss_ref.frame import FrameInputs
from stss_ref.weights import Weights
from stss_ref.weights import random as random_weights

WEIGHTS = random_weights(3)
UNREAD = WEIGHTS | {n: w * 0 for n, w in WEIGHTS.items() if n.startswith("lowlevelGated.") and n.endswith(".weight")}
"""The same weights, without reading the history."""
DETAILED = Weights(UNREAD, "detail", hole_fill="reshade")
"""The same again, with detail as the second colour, and with reshaded holes."""
FROM_BELOW = "up2.conv.double_conv.0.weight"
SHIPPED = Weights(
    WEIGHTS | {FROM_BELOW: WEIGHTS[FROM_BELOW] * (np.arange(56) < 24)[:, None, None]}, "detail", hole_fill="reshade"
)
"""Random numbers in the layers that the shipped weights have: two levels of four, neither history nor ERM."""
CHANGES = ("nothing", "nothing", "pixel", "color", "rectangle", "moving", "everything")
SIZE = 24, 40
MIXED = (*5 * ["nothing"], "nothing", "pixel", "moving", "nothing", "rectangle")
"""Changes of a film of which some frames are computed whole, some in part, and some not at all."""


def weights_for(device):
    """All layers on a processor. On a GPU those of the shipped weights: each of the others' kernels takes a second to compile."""
    return WEIGHTS if device.is_cpu else SHIPPED


def network_inputs(size, seed=0, share=0.7):
    """Colour, G-buffer, mask and history; ``share`` of the mask is valid."""
    random = np.random.default_rng(seed)
    color, gbuffer, mask, history = (random.random(shape, np.float32) for shape in ((*size, 6), (*size, 9), size, (3, *size, 4)))
    return [color, gbuffer, (mask < share).astype(np.float32), history]


def frame_inputs(size, seed=0, steps=(1, 3, 5), **others):
    """Inputs of a frame: noise on one still surface, but for ``others``."""
    random = np.random.default_rng(seed)
    planes = {
        "colors": random.random((3, *size, 3)),
        "motions": random.uniform(-3, 3, (5, *size, 2)),
        "gbuffer": random.random((*size, 9)),
        "nov": random.random(size),
        "stencils": np.zeros((4, *size)),
        "normals": np.ones((4, *size, 3)),
        "positions": np.zeros((4, *size, 3)),
    } | others
    return FrameInputs(steps=steps, **{name: np.asarray(array, np.float32) for name, array in planes.items()})


def uneven(size, seed=0):
    """Stencils, normals and positions that show another surface at every pixel."""
    random = np.random.default_rng(seed)
    stencils = random.random((4, *size)) > 0.8
    return {"stencils": stencils, "normals": random.random((4, *size, 3)), "positions": 30 * random.random((4, *size, 3))}


def appearing(size, seed=0):
    """Stencils of squares of 40 pixels, about a third of them uncovered in this frame: wide holes without a sample of their own."""
    squares = np.random.default_rng(seed).random([-(-n // 40) for n in size]) < 0.3
    stencils = np.zeros((4, *size))
    stencils[1:] = 7 * np.kron(squares, np.ones((40, 40)))[: size[0], : size[1]]
    return {"stencils": stencils}


def halve(frame):
    """The same display frame with the planes in half that may be so."""
    planes = {name: getattr(frame, name) for name in HALF}
    return replace(frame, **{name: plane.astype(np.float16) for name, plane in planes.items() if plane is not None})


def first_frame(rng, size, *, rendered=True):
    return DisplayFrame(
        number=0,
        color=rng.random((*size, 3), np.float32) if rendered else None,
        motion=np.zeros((*size, 2), np.float32),
        gbuffer=rng.random((*size, 9), np.float32),
        nov=rng.random(size, np.float32),
        stencil=np.zeros(size, np.float32),
        position=(rng.random((*size, 3), np.float32) * 20).astype(np.float32),
    )


def next_frame(rng, before, color, change, *, rendered):
    """The frame after ``before``, all of it in new arrays; ``color``: of the last frame that had one."""
    height, width = before.nov.shape
    planes = {name: getattr(before, name).copy() for name in ("gbuffer", "nov", "stencil", "position")}
    color, motion = color.copy(), np.zeros((height, width, 2), np.float32)
    y, x = int(rng.integers(height)), int(rng.integers(width))
    where = (
        np.s_[y : y + 1, x : x + 1]
        if change == "pixel"
        else np.s_[y : y + int(rng.integers(1, 9)), x : x + int(rng.integers(1, 9))]
    )
    where = np.s_[:, :] if change == "everything" else where
    if change != "nothing":
        color[where] = rng.random(color[where].shape, np.float32)
    if change in {"pixel", "rectangle", "everything"}:
        name = str(rng.choice(list(planes)))
        planes[name][where] = (
            rng.integers(0, 3, planes[name][where].shape) if name == "stencil" else rng.random(planes[name][where].shape)
        )
    if change in {"moving", "everything"}:
        motion[where] = rng.normal(0, 2, motion[where].shape)
        planes["stencil"][where] = 1
    return DisplayFrame(before.number + 1, color if rendered else None, motion, **planes), color


def film(changes=MIXED, size=SIZE, seed=4, rendered=(True, False)):
    """A first frame, and one more for each change; which have a colour, in turns."""
    rng = np.random.default_rng(seed)
    frames = [first_frame(rng, size)]
    color = frames[0].color
    for i, change in enumerate(changes, start=1):
        frame, color = next_frame(rng, frames[-1], color, change, rendered=rendered[i % len(rendered)])
        frames.append(frame)
    return frames


def calls_of(frames):
    """The window and the steps of each frame."""
    windows = [window_at(frames, i) for i in range(len(frames))]
    return [(window, schedule_of(window).steps) for window in windows]


def on(device, frame):
    """The same frame on the device, as an engine's buffers wrapped into arrays."""
    arrays = {}
    for name in (field.name for field in fields(frame) if field.name not in ("number", "carried")):
        array = getattr(frame, name)
        if array is not None:
            buffer = cl.Buffer(device.context, cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR, hostbuf=array)
            arrays[name] = cla.Array(device.queue, array.shape, array.dtype, data=buffer)
    return replace(frame, **arrays)


def assert_same(got, want):
    """The bits of an image, and its mask."""
    np.testing.assert_array_equal(got[0].view(np.uint32), want[0].view(np.uint32))
    np.testing.assert_array_equal(got[1], want[1])
