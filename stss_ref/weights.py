# SPDX-License-Identifier: MIT
"""The network's 92 named arrays: their table, their check, and weights for tests and baselines.

Source: spec 7, 8, 10; paper, Tab. "Cost analysis for each component".
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import prod, sqrt
from typing import Any, Literal, NamedTuple, TypeVar, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stss_ref.arrays import Array
from stss_ref.constants import HOLE_TESTS, HoleTest

Tensors = Mapping[str, Array]
"""Arrays by name, of the network or of some layers: a convolution's weight is (out, in, kh, kw), its bias (out,)."""

Component = Literal["backbone", "history", "erm"]

SecondColor = Literal["newest", "detail"]
"""What the second of the network's two colours shows: the newest colour frame warped, as the authors' weights expect it, or what all
warped ones show within the pixel (`stss_ref.frame.prepare`)."""
SECOND_COLORS: tuple[SecondColor, ...] = get_args(SecondColor)


@dataclass(frozen=True, eq=False)
class Weights(Mapping[str, Array]):
    """The network's arrays by name, and what else was settled in training. ``dataclasses.replace`` changes a part and keeps the rest.

    Attributes:
        tensors: the array of each name in `TENSORS`.
        second_color: the second colour that they were trained with.
        hole_test: the hole test that they were trained with.
    """

    tensors: Tensors = field(repr=False)
    second_color: SecondColor = "newest"
    hole_test: HoleTest = "footprint"

    def __getitem__(self, name: str) -> Array:
        return self.tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tensors)

    def __len__(self) -> int:
        return len(self.tensors)

    def __or__(self, tensors: Tensors) -> Weights:
        """The same weights with ``tensors`` in place of those of their names."""
        return replace(self, tensors={**self.tensors, **tensors})

    def convert(self, change: Callable[[Array], Array]) -> Weights:
        """The same weights with ``change`` of each array."""
        return replace(self, tensors={name: change(tensor) for name, tensor in self.tensors.items()})


class WeightsError(ValueError):
    """Weights are not what the network takes; the message names the tensor, what was expected and what was found."""


VERSION_KEY, SECOND_COLOR_KEY, HOLE_TEST_KEY = "stss_weights_version", "second_color", "hole_test"
NEWEST_ALONE, WITH_HOLE_TEST, WITH_DETAIL = "1", "3", "4"
"""Versions of a weights file: with the newest frame as the second colour and the footprint's hole test; with the hole test that the
metadata name; and with detail as the second colour. Who knows the earlier versions alone refuses what it would compute wrongly. Version 2
had a second colour that is no more (decision 37)."""
VERSIONS = (NEWEST_ALONE, WITH_HOLE_TEST, WITH_DETAIL)


def format_metadata(weights: Weights) -> dict[str, str]:
    """The entries that the metadata of a weights file must have (spec 10)."""
    if (weights.second_color, weights.hole_test) == ("newest", "footprint"):
        return {VERSION_KEY: NEWEST_ALONE}
    version = WITH_HOLE_TEST if weights.second_color == "newest" else WITH_DETAIL
    return {VERSION_KEY: version, SECOND_COLOR_KEY: weights.second_color, HOLE_TEST_KEY: weights.hole_test}


def take_format(metadata: dict[str, str]) -> Weights:
    """Take these entries out of a file's metadata.

    Returns:
        Weights without tensors, which have what the entries say.

    Raises:
        WeightsError: the entries are not those of a known version.
    """
    version = metadata.pop(VERSION_KEY, None)
    if version not in VERSIONS:
        found = "no such entry" if version is None else repr(str(version)[:20])
        raise WeightsError(f"expected {VERSION_KEY} 1, 3 or 4 in the metadata, found {found}")
    if version == NEWEST_ALONE:
        for key in (SECOND_COLOR_KEY, HOLE_TEST_KEY):
            if key in metadata:
                raise WeightsError(f"{key}: expected no such entry in the metadata of {VERSION_KEY} {version}")
        return Weights({})
    seconds = SECOND_COLORS if version == WITH_DETAIL else SECOND_COLORS[:1]
    second: SecondColor = _named(metadata, SECOND_COLOR_KEY, seconds)
    return Weights({}, second, _named(metadata, HOLE_TEST_KEY, HOLE_TESTS))


Name = TypeVar("Name", bound=str)


def _named(metadata: dict[str, str], key: str, names: tuple[Name, ...]) -> Name:
    named = metadata.pop(key, "")
    for known in names:
        if named == known:
            return known
    raise WeightsError(f"{key}: expected one of {', '.join(names)} in the metadata, found {str(named)[:20]!r}")


def _padded(length: int) -> int:
    return -(-length // 8) * 8


@dataclass(frozen=True)
class Layer:
    """One convolution of the network.

    Attributes:
        name: module path in the authors' checkpoint, without ``.weight`` and ``.bias``.
        reads: what it reads, side by side in this order: layers, and ``SOURCES``. What has half the size is upsampled first; of what ran
            for each of the three colour frames, a layer that runs once reads all three.
        inputs: channels in.
        outputs: channels out, without the gate's one.
        component: the layer's row in the paper's cost table.
        divisor: the output is (H / divisor, W / divisor); the input grid is ``stride`` times finer.
        kernel: side of the window, in pixels of the input grid.
        stride: step of the window, in pixels of the input grid.
        gated: whether the output is multiplied by the sigmoid of a second convolution, to one channel (spec 7, ``G``).
        relu: whether a ReLU follows.
        repeats: how often it runs for one frame: the history's layers run for each of the three colour frames.
    """

    name: str
    reads: tuple[str, ...]
    inputs: int
    outputs: int
    component: Component
    divisor: int
    kernel: int = 3
    stride: int = 1
    gated: bool = False
    relu: bool = True
    repeats: int = 1

    @property
    def stage(self) -> str:
        """The stage that it belongs to."""
        if self.component != "backbone":
            return self.component
        return "decoder" if self.name.startswith(("up", "outc")) else "encoder"

    def tensors(self) -> Iterator[tuple[str, tuple[int, ...]]]:
        """Name and shape of each of its arrays, in the checkpoint's order."""
        branches = {"": self.outputs}
        if self.gated:
            branches = {".conv_feature": self.outputs, ".conv_mask.0": 1}
        for branch, outputs in branches.items():
            yield f"{self.name}{branch}.weight", (outputs, self.inputs, self.kernel, self.kernel)
            yield f"{self.name}{branch}.bias", (outputs,)

    @property
    def parameters(self) -> int:
        """How many numbers its arrays hold."""
        return sum(prod(shape) for _, shape in self.tensors())

    def multiply_adds(self, height: int, width: int) -> int:
        """Multiply-adds for one frame of (height, width): see `multiply_adds` of the module."""
        pixels = (_padded(height) // self.divisor) * (_padded(width) // self.divisor)
        outputs = self.outputs + (1 if self.gated else 0)
        return self.repeats * pixels * outputs * self.inputs * self.kernel**2


SOURCES = {"input": 21, "gbuffer": 9, "history": 4, "reshaded": 64}
"""What layers read besides each other, with its channels: the frame's colours and G-buffer (spec 7), the G-buffer at an eighth, a colour
frame of the history, and the attention's result, of ``ATTENTION``."""
ATTENTION = ("latentEncoder.4", "KEncoder.4")
"""The layers that the attention reads, besides the mask."""


def _down(name: str, read: str, inputs: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    strided, first = f"{name}.downsample", f"{name}.conv1"
    return (
        Layer(strided, (read,), inputs, inputs, "backbone", divisor, stride=2, gated=True, relu=False),
        Layer(first, (strided,), inputs, outputs, "backbone", divisor, gated=True),
        Layer(f"{name}.conv2", (first,), outputs, outputs, "backbone", divisor, gated=True),
    )


def _up(name: str, reads: tuple[str, ...], inputs: int, middle: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    first = f"{name}.conv.double_conv.0"
    return (
        Layer(first, reads, inputs, middle, "backbone", divisor),
        Layer(f"{name}.conv.double_conv.2", (first,), middle, outputs, "backbone", divisor),
    )


def _history(name: str, read: str, inputs: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    return (
        Layer(f"{name}.0", (read,), inputs, outputs, "history", divisor, stride=2, repeats=3),
        Layer(f"{name}.2", (f"{name}.0",), outputs, outputs, "history", divisor, repeats=3),
        Layer(f"{name}.4", (f"{name}.2",), outputs, outputs, "history", divisor, repeats=3),
    )


def _encoder(name: str, reads: tuple[str, ...], inputs: int, outputs: int) -> tuple[Layer, ...]:
    return (
        Layer(f"{name}.0", reads, inputs, outputs, "erm", 8),
        Layer(f"{name}.2", (f"{name}.0",), outputs, outputs, "erm", 8),
        Layer(f"{name}.4", (f"{name}.2",), outputs, outputs, "erm", 8, relu=False),
    )


LAYERS: tuple[Layer, ...] = (
    Layer("conv1", ("input",), 21, 24, "backbone", 1, gated=True),
    Layer("conv2", ("conv1",), 24, 24, "backbone", 1, gated=True),
    *_down("down1", "conv2", 24, 24, 2),
    *_down("down2", "down1.conv2", 24, 32, 4),
    *_down("down3", "down2.conv2", 32, 32, 8),
    *_history("convHis1", "history", 4, 24, 2),
    *_history("convHis2", "convHis1.4", 24, 32, 4),
    *_history("convHis3", "convHis2.4", 32, 32, 8),
    Layer("lowlevelGated", ("convHis3.4",), 96, 32, "history", 8, gated=True, relu=False),
    *_encoder("latentEncoder", ("down3.conv2", "gbuffer"), 41, 64),
    *_encoder("KEncoder", ("gbuffer",), 9, 32),
    *_up("up1", ("down2.conv2", "reshaded", "lowlevelGated"), 128, 64, 32, 4),
    *_up("up2", ("down1.conv2", "up1.conv.double_conv.2"), 56, 28, 24, 2),
    *_up("up3", ("conv2", "up2.conv.double_conv.2"), 48, 24, 24, 1),
    Layer("outc", ("up3.conv.double_conv.2",), 24, 12, "backbone", 1, kernel=1, relu=False),
)
"""Every convolution, in the order of computation."""
BY_NAME = {layer.name: layer for layer in LAYERS}

TENSORS: dict[str, tuple[int, ...]] = {name: shape for layer in LAYERS for name, shape in layer.tensors()}
"""Shape of each of the 92 arrays."""


def multiply_adds(height: int, width: int) -> dict[str, int]:
    """Multiply-adds of each layer for one frame of (height, width) padded to multiples of 8, by the layer's name.

    Convolutions and gates are counted; biases, activations and whatever lies between the layers are not. The paper's
    31.50 G is this count at 968 x 544 (its authors pad a width of 960 by 8 more) plus 11 for each number that the
    decoder's three upsamplings produce.
    """
    return {layer.name: layer.multiply_adds(height, width) for layer in LAYERS}


def check(tensors: Weights | Mapping[str, NDArray[Any]]) -> Weights:
    """Check that ``tensors`` are those of this network, and copy them.

    Args:
        tensors: array by name; if they are `Weights`, the rest of these is kept.

    Returns:
        The same numbers, in the order of `TENSORS`, as C-contiguous read-only arrays of float32.

    Raises:
        WeightsError: a tensor is missing, not of this network, misshapen, not float32 in the machine's byte order, or
            holds NaN or infinity. The message names it.
    """
    require_names(tensors)
    checked = {name: _check_one(name, tensors[name]) for name in TENSORS}
    return replace(tensors, tensors=checked) if isinstance(tensors, Weights) else Weights(checked)


def require_names(names: Collection[str]) -> None:
    """Raise WeightsError unless ``names`` are those of `TENSORS`, in any order."""
    missing = [name for name in TENSORS if name not in names]
    extra = sorted(name for name in names if name not in TENSORS)
    if missing:
        raise WeightsError(f"{missing[0]}: missing{_more(missing)}, of {len(TENSORS)} tensors")
    if extra:
        raise WeightsError(f"{extra[0][:80]!r}: not a tensor of this network{_more(extra)}")


def require_shape(name: str, shape: tuple[int, ...]) -> None:
    """Raise WeightsError unless the tensor ``name`` of the network has ``shape``."""
    if shape != TENSORS[name]:
        raise WeightsError(f"{name}: expected shape {TENSORS[name]}, got {shape}")


def _more(names: list[str]) -> str:
    return f" (and {len(names) - 1} more)" if len(names) > 1 else ""


def _check_one(name: str, tensor: NDArray[Any]) -> Array:
    require_shape(name, tensor.shape)
    if tensor.dtype != np.float32:
        raise WeightsError(f"{name}: expected dtype float32, got {tensor.dtype}")
    bad = np.argwhere(~np.isfinite(tensor))
    if len(bad):
        first = tuple(int(i) for i in bad[0])
        raise WeightsError(f"{name}: {len(bad)} non-finite values, first at index {first}")
    return _frozen(tensor)


def _frozen(tensor: NDArray[Any]) -> Array:
    if tensor.flags.c_contiguous and not tensor.flags.writeable:
        return tensor
    copy = np.array(tensor, order="C")
    copy.flags.writeable = False
    return copy


def zeros() -> Weights:
    """Weights of the method ``bilinear``: the network adds nothing to the upsampled colour, whatever its inputs."""
    return Weights({name: _frozen(np.zeros(shape, np.float32)) for name, shape in TENSORS.items()})


Mask = NDArray[np.bool_]
GROUP = 16
"""Units are left out by so many, the groups in which kernels sum; a layer of 24 is one group."""


class Needed(NamedTuple):
    """What the image depends on.

    Attributes:
        layers: those that must run, in order, with what they still read and how many units they still have.
        once: names of those whose result no frame changes.
        tensors: their arrays.
    """

    layers: Mapping[str, Layer]
    once: Collection[str]
    tensors: Tensors


def find_needed(weights: Tensors) -> Needed:
    """What must run with these weights for the image to be exact: units and layers that nobody reads, or that are always 0, need not.

    A kernel that is exactly 0 reads nothing, and nobody needs to read a unit that is always 0.
    """
    zero = {name: np.zeros(channels, np.bool_) for name, channels in SOURCES.items()}
    reads: dict[str, Mask] = {}
    for layer in LAYERS:
        arrays = [weights[name] for name, _ in layer.tensors()]
        given = np.concatenate([np.tile(zero[read], times) for read, _, times in _parts(layer)])
        kernels: list[Mask] = [kernel.any(axis=(2, 3)) & ~given for kernel in arrays[::2]]
        none: Mask = arrays[1] <= 0 if layer.relu else arrays[1] == 0
        zero[layer.name] = none & ~kernels[0].any(axis=1)
        reads[layer.name] = (kernels[0] | kernels[-1]) & ~zero[layer.name][:, None]
        if layer.name in ATTENTION:
            zero["reshaded"] = zero[ATTENTION[0]] | zero.get(ATTENTION[1], zero["reshaded"]).all()
    needed = {name: np.zeros(len(units), np.bool_) for name, units in zero.items()}
    needed[LAYERS[-1].name][:] = True
    live: dict[str, list[str]] = {}
    for layer in reversed(LAYERS):
        columns: Mask = np.logical_or.reduce(reads[layer.name][needed[layer.name]], axis=0)
        live[layer.name] = []
        for read, first, times in _parts(layer):
            units = columns[first : first + times * len(zero[read])].reshape(times, -1).any(axis=0)
            needed[read] |= units
            live[layer.name] += [read] if units.any() else []
        if needed["reshaded"].any():
            needed[ATTENTION[0]] |= needed["reshaded"]
            needed[ATTENTION[1]] |= ~zero[ATTENTION[1]]
    return _cut(weights, needed, live)


def _cut(weights: Tensors, needed: Mapping[str, Mask], reads: Mapping[str, Collection[str]]) -> Needed:
    """Cut out the groups without a needed unit, and of each layer what it does not read."""
    kept = {name: _in_groups(units) for name, units in needed.items()} | {n: np.ones(c, np.bool_) for n, c in SOURCES.items()}
    kept["reshaded"] = kept[ATTENTION[0]]
    varies = dict.fromkeys(SOURCES, True)
    layers: dict[str, Layer] = {}
    tensors: dict[str, Array] = {}
    for layer in (each for each in LAYERS if needed[each.name].any()):
        units, live = kept[layer.name], reads[layer.name]
        columns = np.concatenate([np.tile(kept[read] & (read in live), times) for read, _, times in _parts(layer)])
        varies[layer.name] = any(varies[read] for read in live)
        for name, shape in layer.tensors():
            rows = weights[name][units] if shape[0] == layer.outputs else weights[name]
            tensors[name] = rows if len(shape) == 1 else rows[:, columns]
        read = tuple(name for name in layer.reads if name in live)
        layers[layer.name] = replace(layer, reads=read, inputs=int(columns.sum()), outputs=int(units.sum()))
    return Needed(layers, {name for name in layers if not varies[name]}, tensors)


def _in_groups(units: Mask) -> Mask:
    size = GROUP if len(units) % GROUP != 8 else len(units)
    return np.logical_or.reduceat(units, np.arange(0, len(units), size)).repeat(size)[: len(units)]


def _parts(layer: Layer) -> Iterator[tuple[str, int, int]]:
    """What a layer reads: name, first input channel, and how many images of it lie side by side."""
    first = 0
    for read in layer.reads:
        source = BY_NAME.get(read)
        times = 1 if source is None else source.repeats // layer.repeats
        yield read, first, times
        first += times * (SOURCES[read] if source is None else source.outputs)


def reads_history(weights: Tensors) -> bool:
    """Whether the image depends on the history: not if kernels on every way from it are exactly 0, such as those of its last layer."""
    return any("history" in layer.reads for layer in find_needed(weights).layers.values())


def colors_read(weights: Weights) -> int:
    """How many of the three colour frames, from the newest on, the image depends on."""
    return 3 if weights.second_color == "detail" or reads_history(weights) else 1


def has_residual(weights: Tensors) -> bool:
    """Whether the network adds anything: if its last layer is all zeros, the image is the upsampled frame, whatever else is computed."""
    return bool(np.any(weights["outc.weight"]) or np.any(weights["outc.bias"]))


def random(seed: int) -> Weights:
    """Weights that keep the size of a signal from layer to layer (He et al. 2015), the same for the same ``seed``.

    Biases are drawn as well, with standard deviation 0.1, so that a port that forgets a bias fails.
    """
    generator = np.random.default_rng(seed)

    def draw(shape: tuple[int, ...]) -> Array:
        scale = sqrt(2 / prod(shape[1:])) if len(shape) == 4 else 0.1
        return _frozen((generator.standard_normal(shape) * scale).astype(np.float32))

    return Weights({name: draw(shape) for name, shape in TENSORS.items()})


def astype(weights: Weights, dtype: DTypeLike) -> Weights:
    """The same weights in another floating point ``dtype``; float64 for the truth."""
    return weights.convert(lambda tensor: _frozen(tensor.astype(dtype, copy=False)))
