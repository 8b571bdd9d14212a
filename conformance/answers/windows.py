# SPDX-License-Identifier: MIT
"""Right answers in a few windows of a large frame, which as a whole would take minutes in float64.

Windows lie around corners that tiles of 64, 128, 256 and 512 have in common, around those of halves and of thirds, and in the last corner.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from conformance.answers.by_stage import expect
from conformance.answers.expected import Expected
from conformance.answers.network import SAMPLE, SPARSE, expect_with_weights
from conformance.answers.port_arithmetic import Arithmetic, in_float64
from conformance.protocol.array_specs import ArraySpec
from conformance.protocol.layers import PADDED
from conformance.protocol.port import Outputs
from conformance.protocol.reference_copy import Plant, load, put
from conformance.protocol.stages import STAGES, check_inputs, network_inputs
from stss_ref.resample import lerp_along, pad_to_8
from stss_ref.weights import Weights, astype

Size = tuple[int, int]
Part = tuple[slice, slice]
"""Rows and columns of a frame."""
Inputs = dict[str, NDArray[Any]]
REACH = {"history": 48, "encoder": 40, "erm": 40, "decoder": 32, "reshade": 80}
"""Input pixels, at most, from an output pixel to the inputs of its value, in multiples of 8: 43 of history, 37 of encoder, 40 of erm, 30 of
decoder, and 74 of reshade: its widest ring and the samples there."""
FROM_IMAGE = {"encoder": 112, "erm": 72, "history": 80, "decoder": 32}
"""The same from a pixel of the image of the whole network, whose stages these are, in their order: what follows each, and its own."""
IMAGE_REACH = 32
"""The same for the other image stages with motion of up to 8 pixels: a chain of three, or a splat, its look-up and the reading there."""
SIDE = 32
"""Rows and columns of a window; input pixels."""
TILE = 512
"""Columns and rows of the largest tile."""


@dataclass(frozen=True)
class Window:
    """Rows and columns of the inputs, and each output's place and right answers there."""

    rows: slice
    columns: slice
    outputs: dict[str, tuple[tuple[slice, ...], Expected]]


def places(height: int, width: int) -> list[Part]:
    """The windows of a frame: the first and the last corner of tiles in it, the first of halves and of thirds, and the last rows' end."""
    half = SIDE // 2
    corners = [(y - half, x - half) for y in range(TILE, height - half + 1, TILE) for x in range(TILE, width - half + 1, TILE)]
    parts = [((height // n - half) // 8 * 8, (width // n - half) // 8 * 8) for n in (2, 3)]
    begins = [*corners[:1], *corners[1:][-1:], *parts, (height - SIDE, width - SIDE)]
    return [(slice(top, top + SIDE), slice(left, left + SIDE)) for top, left in begins]


def expect_windows(
    stage: str, inputs: Inputs, weights: Weights | None, arithmetic: Arithmetic, outputs: Outputs
) -> Iterator[Window]:
    """The right answers of a stage in the windows of a large frame.

    Args:
        stage: its name; of ``frame`` the motion is in whole pixels and parts of them that no sum rounds.
        inputs: as the port gets them, larger than two windows and their reach both ways; motion is no longer than 8 pixels.
        weights: float32.
        arithmetic: of the port.
        outputs: the port's answer, since one output may depend on the port's own choice in another.
    """
    sizes = check_inputs(stage, inputs)
    height, width = sizes["H"], sizes["W"]
    windows = places(height, width)
    if weights is None:
        yield from (_image_window(stage, inputs, arithmetic, outputs, window) for window in windows)
        return
    network = "network" if stage == "frame" else stage
    first = slice(0, SAMPLE * SPARSE.get(network, 1))
    bounds = expect_with_weights(network, _part(stage, inputs, weights, (first, first)), weights, arithmetic)
    whole = (-(-height // 8) * 8, -(-width // 8) * 8) if stage in PADDED else (height, width)
    specs, network_part = STAGES[network].outputs, NetworkPart(network, astype(weights, np.dtype(np.float64)), whole)
    for window in windows:
        around = network_part.around(window)
        got = network_part.run(_part(stage, inputs, weights, around), window)
        yield Window(
            *window, {name: (place_of(specs[name], window), replace(bounds[name], want=want)) for name, want in got.items()}
        )


def _part(stage: str, inputs: Inputs, weights: Weights, around: Part) -> Inputs:
    """A part of the inputs in float64; of stage ``frame``, of its network's. It is padded where the frame is."""
    if stage == "frame":
        height, width = inputs["nov"].shape
        wide = _around(around, (height, width), IMAGE_REACH)
        part = _cut("network", network_inputs(_cut(stage, inputs, wide), weights), around, wide)
    else:
        part = _cut(stage, inputs, around)
    return pad_inputs(part) if stage in PADDED else part


def pad_inputs(inputs: Inputs) -> Inputs:
    """The network's inputs, as it pads them."""
    return {name: pad_to_8(array[..., None])[..., 0] if name == "mask" else pad_to_8(array) for name, array in inputs.items()}


class NetworkPart:
    """The network, or a stage of it, in windows: each of its stages is computed no further around than the window's numbers depend on.

    Most of its work is the decoder's, at a seventh of the pixels that the encoder needs.

    Args:
        stage: its name.
        weights: of the inputs' dtype.
        whole: (H, W) of the frame.
        plants: changes of the reference, but of ``upsample_corners``.
    """

    def __init__(self, stage: str, weights: Weights, whole: Size, plants: Sequence[Plant] = ()):
        self._stages = FROM_IMAGE if stage == "network" else {stage: REACH[stage]}
        self._weights, self._whole = weights, whole
        self._corners = _Corners(whole)
        self._port = load("window", *plants, put("resample.upsample_corners", self._corners.upsample))

    def around(self, window: Part) -> Part:
        """The inputs that a window's numbers depend on."""
        return _around(window, self._whole, max(self._stages.values()))

    def run(self, inputs: Inputs, window: Part) -> Inputs:
        """The outputs in a window, from the inputs ``around`` it."""
        arrays, origins = dict(inputs), dict.fromkeys(inputs, self.around(window))
        outputs: Mapping[str, ArraySpec] = {}
        for stage, reach in self._stages.items():
            around, specs, outputs = _around(window, self._whole, reach), STAGES[stage].inputs, STAGES[stage].outputs
            part = {name: arrays[name][place_of(spec, around, origins[name])] for name, spec in specs.items()}
            self._corners.part = around
            arrays |= self._port.run(stage, part, self._weights)
            origins |= dict.fromkeys(outputs, around)
        return {name: arrays[name][place_of(spec, window, origins[name])] for name, spec in outputs.items()}


def _image_window(stage: str, inputs: Inputs, arithmetic: Arithmetic, outputs: Outputs, window: Part) -> Window:
    sizes = check_inputs(stage, inputs)
    around = _around(window, (sizes["H"], sizes["W"]), REACH.get(stage, IMAGE_REACH))
    specs = STAGES[stage].outputs
    answer = {name: array[place_of(specs[name], around)] for name, array in outputs.items()}
    right = expect(stage, _cut(stage, inputs, around), None, arithmetic, answer)
    parts: dict[str, tuple[tuple[slice, ...], Expected]] = {}
    for name, expected in right.items():
        parts[name] = place_of(specs[name], window), expected.part(place_of(specs[name], window, around))
    return Window(*window, parts)


def _around(window: Part, whole: tuple[int, int], reach: int) -> Part:
    """The window and the inputs that it depends on, in whole blocks of 8."""
    high, wide = (
        slice(max(0, s.start - reach) // 8 * 8, min(n, -(-(s.stop + reach) // 8) * 8)) for s, n in zip(window, whole, strict=True)
    )
    return high, wide


def _cut(stage: str, inputs: Inputs, around: Part, origin: Part | None = None) -> Inputs:
    """A part of the inputs in float64; they are those of the part ``origin``, or of the whole frame."""
    specs = STAGES[stage].inputs
    return in_float64(
        {name: np.ascontiguousarray(array[place_of(specs[name], around, origin)]) for name, array in inputs.items()}
    )


def place_of(spec: ArraySpec, window: Part, origin: Part | None = None) -> tuple[slice, ...]:
    """The place of this window in an array of a part of the frame that begins at ``origin``."""
    first = {"H": 0, "W": 0} if origin is None else {"H": origin[0].start, "W": origin[1].start}
    slices: list[slice] = []
    for dim in spec.dims:
        if dim.letter not in first:
            slices.append(slice(None))
            continue
        own = window[0 if dim.letter == "H" else 1]
        slices.append(slice(*((at - first[dim.letter]) * dim.times // dim.over for at in (own.start, own.stop))))
    return tuple(slices)


class _Corners:
    """`stss_ref.resample.upsample_corners` of a part of a frame: it reads where the whole, (H, W), does."""

    def __init__(self, whole: Size):
        self._whole = whole
        self.part: Part = (slice(0, whole[0]), slice(0, whole[1]))

    def upsample(self, x: NDArray[Any]) -> NDArray[Any]:
        """An image of the part, at this or at a smaller size."""
        for axis, (part, whole) in enumerate(zip(self.part, self._whole, strict=True)):
            length, size = x.shape[axis], part.stop - part.start
            n, begin = whole * length // size, part.start * length // size
            at = (np.arange(2 * length) + 2 * begin) * ((n - 1) / (2 * n - 1)) - begin
            x = lerp_along(x, np.clip(at, 0, length - 1), axis)
        return x
