# SPDX-License-Identifier: MIT
"""Arm's Neural Super Sampling 0.1.1, int8, in NumPy: twice the size, with jitter.

Source: the data graph `nss_v0_1_1_int8.vgf` and the shaders' mathematics of github.com/arm/neural-graphics-sdk-for-game-engines (MIT);
TOSA 1.0. The file is fetched to be measured, never copied. The graph is executed as it stands in the file, integers to the bit. The two
shaders are their 32-bit kind in float32; the history is kept in float32, where theirs has 11 bits. Exposure is 1, depth the view's own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ground.regular_file import require_regular
from stss_ref.arrays import Image, Plane
from stss_ref.resample import upsample_centres
from training.rivals.jittered import Jittered

Ints = NDArray[np.int64]
MAX_BYTES = 16 * 2**20

# SPIR-V: instructions, and TOSA's of its extended set.
TYPE_INT, CONSTANT_TRUE, CONSTANT_FALSE, CONSTANT, COMPOSITE, NULL, REPLICATE = 21, 41, 42, 43, 44, 46, 4461
EXTENDED, GRAPH_CONSTANT, GRAPH_INPUT, GRAPH_OUTPUT = 12, 4181, 4184, 4185
CONV2D, TABLE, CONCAT, RESIZE, RESCALE = 2, 30, 54, 63, 65
SINGLE_ROUND, NEAREST = 1, 1

FEEDBACK, TEMPORAL, K3, K2, K1, K0 = range(6)
"""The graph's outputs, as their `ffx_nss.cpp` binds them."""


@dataclass(frozen=True)
class Node:
    """One operator: its kind, its operands by number, the number of its result."""

    kind: int
    operands: tuple[int, ...]
    result: int


class Graph:
    """A quantised TOSA graph of one input, in a VGF file.

    Args:
        path: the file.

    Raises:
        InputError: it can't be read, it is no VGF of such a graph, or `ai-ml-sdk-vgf-library` is not installed.
    """

    def __init__(self, path: Path):
        code, constants = _open(path)
        self.values: dict[int, Any] = {}
        self.nodes: list[Node] = []
        self.outputs: dict[int, int] = {}
        self._input, signed = 0, set[int]()
        at = 5
        while at < len(code):
            count, kind = code[at] >> 16, code[at] & 0xFFFF
            words, at = code[at + 1 : at + count], at + max(count, 1)
            if kind == TYPE_INT:
                signed.add(words[0])
            elif kind in (CONSTANT_TRUE, CONSTANT_FALSE):
                self.values[words[1]] = kind == CONSTANT_TRUE
            elif kind == CONSTANT and words[0] in signed:
                self.values[words[1]] = words[2]
            elif kind == COMPOSITE:
                self.values[words[1]] = [self.values.get(word, 0) for word in words[2:]]
            elif kind == NULL:
                self.values[words[1]] = 0
            elif kind == REPLICATE:
                self.values[words[1]] = self.values[words[2]]
            elif kind == GRAPH_CONSTANT:
                self.values[words[1]] = constants[words[2]]
            elif kind == GRAPH_INPUT:
                self._input = words[1]
            elif kind == EXTENDED:
                if words[3] not in OPERATORS:
                    raise InputError(f"{path}: expected operators {sorted(OPERATORS)} of TOSA alone, found {words[3]}")
                self.nodes.append(Node(words[3], tuple(words[4:]), words[1]))
            elif kind == GRAPH_OUTPUT:
                self.outputs[self.values[words[1]]] = words[0]

    def __call__(self, tensor: Ints) -> list[Ints]:
        """The outputs (H, W, C) of an input (H, W, C), in order; all int8 values."""
        values = {**self.values, self._input: tensor}
        for node in self.nodes:
            values[node.result] = OPERATORS[node.kind]([values[operand] for operand in node.operands])
        return [values[number] for _, number in sorted((values_at, result) for values_at, result in self.outputs.items())]


def _open(path: Path) -> tuple[list[int], list[Ints]]:
    """The words of the graph's SPIR-V, and its constants."""
    vgf = require("vgfpy")
    try:
        if require_regular(path) > MAX_BYTES:
            raise InputError(f"{path}: larger than {MAX_BYTES >> 20} MiB, so not this network")
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    header = vgf.CreateHeaderDecoder(data, vgf.HeaderSize(), len(data)) if len(data) >= vgf.HeaderSize() else None
    if header is None or not (header.IsValid() and header.CheckVersion()):
        raise InputError(f"{path}: expected a VGF file, such as nss_v0_1_1_int8.vgf")

    def table(name: str, make: Any) -> Any:
        start, size = (getattr(header, f"Get{name}{what}")() for what in ("Offset", "Size"))
        return make(data[start : start + size], size)

    modules = table("ModuleTable", vgf.CreateModuleTableDecoder)
    stored = table("Constants", vgf.CreateConstantDecoder)
    resources = table("ModelResourceTable", vgf.CreateModelResourceTableDecoder)
    constants: list[Ints] = []
    for i in range(stored.size()):
        shape = [*resources.getTensorShape(stored.getConstantMrtIndex(i))]
        raw = bytes(stored.getConstant(i))
        kind = np.int8 if len(raw) == np.prod(shape) else np.dtype("<i4")
        constants.append(np.frombuffer(raw, kind).reshape(shape).astype(np.int64))
    return [int(word) for word in modules.getSPIRVModuleCode(0)], constants


def signed8(value: Any) -> Ints:
    """Numbers whose lowest 8 bits are those of an int8."""
    return np.asarray(value, np.int64).astype(np.int8).astype(np.int64)


def signed32(value: Any) -> Ints:
    """Numbers whose lowest 32 bits are those of an int32."""
    return np.asarray(value, np.int64).astype(np.int32).astype(np.int64)


def conv2d(operands: list[Any]) -> Ints:
    """TOSA CONV2D: pad, stride, dilation, accumulator, bound, input, weight (out, kh, kw, in), bias, zero points. A sum is exact."""
    pad, stride, dilation, _, _, x, weight, bias, zero, weight_zero = operands
    top, bottom, left, right = np.broadcast_to(pad, 4)
    down, across = np.broadcast_to(stride, 2)
    if np.any(np.not_equal(dilation, 1)):
        raise InputError(f"CONV2D: expected no dilation, found {dilation}")
    # Below 2^53: sums of int8 products in float64 are exact.
    x = np.pad((x - signed8(zero).ravel()[0]).astype(np.float64), ((top, bottom), (left, right), (0, 0)))
    kernel = (weight - signed8(weight_zero).ravel()[0]).astype(np.float64)
    outputs, height, width, _ = kernel.shape
    rows, columns = (x.shape[0] - height) // down + 1, (x.shape[1] - width) // across + 1
    total = np.zeros((rows, columns, outputs))
    for j in range(height):
        for i in range(width):
            part = x[j : j + down * (rows - 1) + 1 : down, i : i + across * (columns - 1) + 1 : across]
            total += part @ kernel[:, j, i].T
    return total.astype(np.int64) + signed32(bias)


def rescale(operands: list[Any]) -> Ints:
    """TOSA RESCALE to int8: ``(x - zero) multiplier / 2^shift``, half up, plus the output's zero."""
    _, rounding, _, input_unsigned, output_unsigned, x, multiplier, shift, zero, output_zero = operands
    if rounding != SINGLE_ROUND or input_unsigned or output_unsigned:
        raise InputError("RESCALE: expected signed numbers, each rounded once")
    shift = np.asarray(shift, np.int64)
    half = np.left_shift(np.int64(1), shift - 1)
    scaled = ((x - signed32(zero)) * np.asarray(multiplier, np.int64) + half) >> shift
    return np.clip(scaled + signed8(output_zero), -128, 127)


def resize(operands: list[Any]) -> Ints:
    """TOSA RESIZE to the nearest."""
    mode, x, scale, offset, border = operands
    if mode != NEAREST:
        raise InputError(f"RESIZE: expected the nearest pixel, found mode {mode}")
    for axis in (0, 1):
        n, d = scale[2 * axis : 2 * axis + 2]
        start, edge = int(np.broadcast_to(signed32(offset), 2)[axis]), int(np.broadcast_to(signed32(border), 2)[axis])
        length = x.shape[axis]
        place = np.arange(((length - 1) * n - start + edge) // d + 1) * d + start
        whole, rest = np.divmod(place, n)
        x = x.take(np.clip(whole + (2 * rest >= n), 0, length - 1), axis)
    return x


def concat(operands: list[Any]) -> Ints:
    """TOSA CONCAT along an axis of (1, H, W, C)."""
    return np.concatenate(operands[1:], axis=operands[0] - 1)


def look_up(operands: list[Any]) -> Ints:
    """TOSA TABLE of 256 int8 values."""
    x, table = operands
    return signed8(table)[x + 128]


OPERATORS: Mapping[int, Any] = {
    CONV2D: conv2d,
    RESCALE: rescale,
    RESIZE: resize,
    CONCAT: concat,
    TABLE: look_up,
}
"""TOSA's number -> function of the operands. Tensors are (H, W, C): the batch's axis is left out."""

# The shaders' constants, and `ffx_nss.cpp`'s.
INPUT_STEP, OUTPUT_STEP, OUTPUT_ZERO = 0.003921568859368563, 0.003937007859349251, -127
STILL, CALM, CALM_SCALE = 0.01, 0.25, 0.725223958492279
FIELD = np.tan(np.radians(30))
"""Half a vertical field of view of 60 degrees: it scales a threshold of depth, from 1.5 to 1.7 over common cameras."""
LUMINANCE = (0.2126, 0.7152, 0.0722)
EPSILON, LARGEST = 1e-7, 65504.0
NEIGHBOURS = ((0, 0), (0, 1), (1, 0), (-1, 0), (0, -1), (1, -1), (1, 1), (-1, -1), (-1, 1))
"""(x, y), in the order in which the nearest depth is looked for."""
TAPS = (
    ((-1, 1, -1, 1), (-1, -1, 1, 1)),
    ((0, 2, 0, 2), (-1, -1, 1, 1)),
    ((-1, 1, -1, 1), (0, 0, 2, 2)),
    ((0, 2, 0, 2), (0, 0, 2, 2)),
)
"""Of each of 2 x 2 output pixels: (x, y) of the four samples that its kernel weighs, in output pixels."""
SWIZZLE = tuple(((a, i), (b, i), (a, i + 2), (b, i + 2)) for i in (0, 1) for a, b in ((K0, K2), (K1, K3)))
"""Of each: output and channel of the four weights."""


def tonemap(x: Image) -> Image:
    """``x / (1 + max(x))``."""
    x = np.clip(x, 0, LARGEST)
    return x / (1 + x.max(axis=-1, keepdims=True))


def tonemap_back(x: Image) -> Image:
    """The inverse of `tonemap`."""
    x = np.clip(x, 0, 1 - EPSILON)
    return x / (1 - x.max(axis=-1, keepdims=True))


def read(image: Image, x: Plane, y: Plane) -> Image:
    """``image`` (H, W, C) bilinear at these pixels, clamped into the frame."""
    height, width, _ = image.shape
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    x0, y0 = x.astype(np.intp), y.astype(np.intp)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = (x - x0)[..., None], (y - y0)[..., None]
    top, bottom = (image[j, x0] * (1 - fx) + image[j, x1] * fx for j in (y0, y1))
    return top * (1 - fy) + bottom * fy


def read_sharply(image: Image, x: Plane, y: Plane) -> Image:
    """As `read`, by Catmull and Rom's kernel in five bilinear taps, its corners left out; where that is below 0, between the taps."""
    x0, y0 = np.floor(x), np.floor(y)
    weights: list[tuple[Plane, Plane, Plane, Plane]] = []
    for f in (x - x0, y - y0):
        before, after = f**2 - 0.5 * (f**3 + f), 0.5 * (f**3 - f**2)
        second = 1 - before - (1.5 * f**3 - 2.5 * f**2 + 1) - after
        middle = 1 - before - after
        weights.append((before, middle, after, second / middle))
    (left, across, right, dx), (up, along, down, dy) = weights
    places = (
        (dx, -1.0, across * up),
        (-1.0, dy, left * along),
        (dx, dy, across * along),
        (2.0, dy, right * along),
        (dx, 2.0, across * down),
    )
    taps = [read(image, x0 + i, y0 + j) for i, j, _ in places]
    total = sum(tap * weight[..., None] for tap, (_, _, weight) in zip(taps, places, strict=True))
    result = total / sum(weight for _, _, weight in places)[..., None]
    ringing = (result < 0).any(axis=-1, keepdims=True)
    return np.where(ringing, np.clip(result, np.min(taps, axis=0), np.max(taps, axis=0)), result)


def nearest_depth(depth: Plane) -> tuple[Plane, Ints, Ints]:
    """The least depth of 3 x 3 pixels, and the offset (x, y) to it."""
    height, width = depth.shape
    wide = np.pad(depth, 1, constant_values=np.inf)
    around = np.stack([wide[1 + j : 1 + j + height, 1 + i : 1 + i + width] for i, j in NEIGHBOURS])
    which = around.argmin(axis=0)  # the first of equals
    x, y = (np.array([offset[axis] for offset in NEIGHBOURS])[which] for axis in (0, 1))
    return around.min(axis=0), x, y


class Nss:
    """The whole method; a `training.rivals.jittered.Upsampler`."""

    def __init__(self, path: Path):
        self._graph = Graph(path)
        self._state: tuple[Image, Image, Image, Plane, Ints, Ints] | None = None

    def __call__(self, frame: Jittered) -> Image:
        """See `training.rivals.jittered.Upsampler`. Any H, W: mirrored to multiples of 8 inside."""
        height, width, _ = frame.color.shape
        edges = ((0, -height % 8), (0, -width % 8))
        color, motion = (np.pad(x, (*edges, (0, 0)), mode="symmetric") for x in (frame.color, frame.motion))
        depth = np.pad(frame.depth, edges, mode="symmetric")
        near, near_x, near_y = nearest_depth(depth)
        y, x = np.indices(depth.shape)
        motion = motion[y + near_y, x + near_x]
        if frame.first or self._state is None or self._state[3].shape != depth.shape:
            flat = np.zeros((*depth.shape, 4), np.float32)
            self._state = (np.zeros((*(2 * n for n in depth.shape), 3), np.float32), flat, flat[..., :2], depth, near_x, near_y)
        keep = 0.0 if frame.first else 1.0
        outputs, luma = self._network(color, motion, near, frame, keep)
        image = self._filter(color, motion, outputs, frame, keep)
        self._state = (image, outputs[FEEDBACK], luma, depth, near_x, near_y)
        return image[: 2 * height, : 2 * width]

    def _network(self, color: Image, motion: Image, near: Plane, frame: Jittered, keep: float) -> tuple[list[Image], Image]:
        """The preprocessing shader and the graph: its outputs, 0 to 1, and the luma's derivative with the luma, (H, W, 2)."""
        assert self._state is not None
        image, feedback, luma, *_ = self._state
        y, x = np.indices(near.shape, np.float32)
        squared = (motion**2).sum(axis=-1)
        moved = motion * (squared > STILL)[..., None]
        there_x, there_y = x + moved[..., 0], y + moved[..., 1]
        hidden = self._hidden(there_x + frame.before[0], there_y + frame.before[1], near)
        hidden *= np.where(squared > CALM, 1, CALM_SCALE)
        toned = tonemap(color)
        changed = self._change(read(luma, there_x, there_y), (toned @ np.array(LUMINANCE, np.float32)), hidden)
        before = tonemap(read(image, 2 * there_x + 0.5, 2 * there_y + 0.5))
        planes = (before, toned, hidden[..., None], keep * read(feedback, there_x, there_y), changed[..., :1])
        tensor = np.clip(np.rint(np.concatenate(planes, axis=-1) / INPUT_STEP - 128), -128, 127).astype(np.int64)
        outputs = [((output - OUTPUT_ZERO) * OUTPUT_STEP).astype(np.float32) for output in self._graph(tensor)]
        return outputs, np.rint(changed.clip(0, 1) * 255) / np.float32(255)

    def _hidden(self, x: Plane, y: Plane, near: Plane) -> Plane:
        """(H, W) from 0 to 1 how surely each surface was hidden: by the depth of the previous frame, as FSR 2 tells it."""
        assert self._state is not None
        *_, depth, near_x, near_y = self._state
        height, width = depth.shape
        diagonal = float(np.hypot(height, width))
        apart = 1.37e-5 * np.sqrt(1 + FIELD**2 * (1 + (width / height) ** 2)) * diagonal
        power = 1 + 2 * min(diagonal / float(np.hypot(1920, 1080)), 1)
        u, v = (np.clip(np.floor(n + 0.5), 0, limit - 1).astype(np.intp) for n, limit in ((x, width), (y, height)))
        x0, y0 = np.floor(x), np.floor(y)
        gathered_x, gathered_y = np.floor(x + near_x[v, u]), np.floor(y + near_y[v, u])
        fx, fy = x - x0, y - y0
        total, weights = np.zeros_like(near), np.zeros_like(near)
        for (i, j), weight in zip(
            ((0, 0), (1, 0), (0, 1), (1, 1)), ((1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy), strict=True
        ):
            # Their offsets of the second and third sample are exchanged, but only off screen.
            at_x, at_y = x0 + j, y0 + i
            on = (at_x >= 0) & (at_y >= 0) & (at_x < width) & (at_y < height)
            rows = np.clip(gathered_y + j, 0, height - 1).astype(np.intp)
            columns = np.clip(gathered_x + i, 0, width - 1).astype(np.intp)
            behind = near - depth[rows, columns]
            counts = on & (weight > 0.1) & (behind > 0)
            share = np.clip(apart * np.maximum(near, depth[rows, columns]) / np.where(counts, behind, 1), 0, 1) ** power
            total += np.where(counts, share * weight, 0)
            weights += np.where(counts | ~on, weight, 0)
        return np.where(weights > 0, np.clip(1 - total / np.where(weights > 0, weights, 1), 0, 1), 0).astype(np.float32)

    @staticmethod
    def _change(before: Image, luma: Plane, hidden: Plane) -> Image:
        """(H, W, 2) how much the luma flickers, a running mean, and the luma."""
        mean, difference = before[..., 0], np.abs(luma - before[..., 1])
        clipped = np.where(difference >= 0.05, np.minimum(difference, 0.3), 0)
        curved = clipped**1.5 / 0.3**1.5
        rate = 0.1 + (0.01 - 0.1) * np.clip(mean, 0, 0.3) / 0.3
        mean = np.where(hidden <= 0.01, mean + (curved - mean) * rate, 0)
        return np.stack([mean, luma], axis=-1).astype(np.float32)

    def _filter(self, color: Image, motion: Image, outputs: list[Image], frame: Jittered, keep: float) -> Image:
        """The postprocessing shader: the kernels' picture, the history, and their mixture, (2H, 2W, 3) linear."""
        assert self._state is not None
        height, width, _ = color.shape
        weights = [np.clip(upsample_centres(output), EPSILON, 1) for output in outputs]
        theta, alpha = (upsample_centres(outputs[TEMPORAL])[..., i] for i in (0, 1))
        y, x = np.indices((2 * height, 2 * width))
        # A sample lies at n + 1/2 + jitter, theirs being the camera's shift and ours the picture's.
        left, up = (int(np.floor((0.5 - shift) * 2)) - 1 for shift in frame.offset)
        tile = (y + up) % 2 * 2 + (x + left) % 2
        picture, newest = np.zeros((2 * height, 2 * width, 3), np.float32), np.zeros((2 * height, 2 * width, 4), np.float32)
        for number, (across, down) in enumerate(TAPS):
            rows, columns = np.nonzero(tile == number)
            places = [((rows + j) // 2, (columns + i) // 2) for i, j in zip(across, down, strict=True)]
            taps = [color[v.clip(0, height - 1), u.clip(0, width - 1)] for v, u in places]
            shares = [weights[output][rows, columns, channel, None] for output, channel in SWIZZLE[number]]
            total = sum(tap * share for tap, share in zip(taps, shares, strict=True))
            picture[rows, columns] = total / sum(shares)
            if across[0] == 0 and down[0] == 0:
                newest[rows, columns] = np.pad(taps[0], ((0, 0), (0, 1)), constant_values=1)
        moved = 2 * motion.repeat(2, axis=0).repeat(2, axis=1)
        moved *= ((moved**2).sum(axis=-1) > STILL)[..., None]
        at_x, at_y = x + moved[..., 0], y + moved[..., 1]
        on = (at_x >= -0.5) & (at_y >= -0.5) & (at_x < 2 * width - 0.5) & (at_y < 2 * height - 0.5)
        history = read_sharply(self._state[0], at_x, at_y)
        mixed = picture + (history - picture) * (keep * theta * on)[..., None]
        share = ((0.35 * alpha + 0.05) * newest[..., 3])[..., None]
        toned = tonemap(mixed)
        return tonemap_back(toned + (tonemap(newest[..., :3]) - toned) * share).astype(np.float32)
