# SPDX-License-Identifier: MIT
"""The network's 92 named arrays: their table, their check, and weights for tests and baselines.

Source: spec 7, 8, 10; paper, Tab. "Cost analysis for each component".
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from math import prod, sqrt
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from stss_ref.arrays import Array
from stss_ref.constants import HoleFill, HoleTest

Tensors = Mapping[str, Array]
"""Arrays by name, of the network or of some layers: a convolution's weight is (out, in, kh, kw), its bias (out,)."""

Component = Literal["backbone", "history", "erm"]

SecondColor = Literal["newest", "detail"]
"""The content of the second of the network's two colours: the newest colour frame warped, as the authors' weights expect it, or the
detail of all warped frames (`stss_ref.frame.prepare`)."""
SECOND_COLORS: tuple[SecondColor, ...] = get_args(SecondColor)


@dataclass(frozen=True, eq=False)
class Weights(Mapping[str, Array]):
    """The network's arrays by name, and the choices of their training (spec 10). ``dataclasses.replace`` changes a part and keeps the rest.

    Attributes:
        tensors: for each name in `TENSORS` a float32 array of the shape given there: kernels (outputs, inputs, side, side), biases
            (outputs,).
        second_color: the second colour that they were trained with.
        hole_test: the hole test that they were trained with.
        hole_fill: the stage that filled the holes in training.
    """

    tensors: Tensors = field(repr=False)
    second_color: SecondColor = "newest"
    hole_test: HoleTest = "footprint"
    hole_fill: HoleFill = "occlusion_warp"

    def __getitem__(self, name: str) -> Array:
        return self.tensors[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.tensors)

    def __len__(self) -> int:
        return len(self.tensors)

    def __or__(self, tensors: Tensors) -> Weights:
        """The same weights with ``tensors`` in place of the arrays of the same names."""
        return replace(self, tensors={**self.tensors, **tensors})

    def convert(self, change: Callable[[Array], Array]) -> Weights:
        """The same weights, with ``change(array)`` in place of each array."""
        return replace(self, tensors={name: change(tensor) for name, tensor in self.tensors.items()})


class WeightsError(ValueError):
    """Weights do not fit the network; the message names the tensor, the expected and the found value."""


def _ceil8(length: int) -> int:
    return -(-length // 8) * 8


@dataclass(frozen=True)
class Layer:
    """One convolution of the network.

    Attributes:
        name: module path in the authors' checkpoint, without ``.weight`` and ``.bias``.
        reads: its inputs, side by side in this order: layers, and ``SOURCES``. Inputs of half the size are upsampled first. A
            layer that runs once reads all three results of one that runs for each of the three colour frames.
        inputs: channels in.
        outputs: channels out, without the gate's one.
        component: the layer's row in the paper's cost table.
        divisor: the output is (H / divisor, W / divisor); the input grid is ``stride`` times finer.
        kernel: side of the window, in pixels of the input grid.
        stride: step of the window, in pixels of the input grid.
        gated: whether the output is multiplied by the sigmoid of a second convolution, to one channel (spec 7, ``G``).
        relu: whether a ReLU follows.
        repeats: its runs for one frame: the history's layers run for each of the three colour frames.
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
        """The number of its parameters."""
        return sum(prod(shape) for _, shape in self.tensors())

    def multiply_adds(self, height: int, width: int) -> int:
        """Multiply-adds for one frame of (height, width): see `multiply_adds` of the module."""
        pixels = (_ceil8(height) // self.divisor) * (_ceil8(width) // self.divisor)
        outputs = self.outputs + (1 if self.gated else 0)
        return self.repeats * pixels * outputs * self.inputs * self.kernel**2


SOURCES = {"input": 21, "gbuffer": 9, "history": 4, "reshaded": 64}
"""Inputs of layers besides each other, with their channels: the frame's colours and G-buffer (spec 7), the G-buffer at an eighth, a colour
frame of the history, and the attention's result, of ``ATTENTION``."""
ATTENTION = ("latentEncoder.4", "KEncoder.4")
"""The layers that the attention reads, besides the mask."""


def _down(name: str, source: str, inputs: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    strided, first = f"{name}.downsample", f"{name}.conv1"
    return (
        Layer(strided, (source,), inputs, inputs, "backbone", divisor, stride=2, gated=True, relu=False),
        Layer(first, (strided,), inputs, outputs, "backbone", divisor, gated=True),
        Layer(f"{name}.conv2", (first,), outputs, outputs, "backbone", divisor, gated=True),
    )


def _up(name: str, reads: tuple[str, ...], inputs: int, middle: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    first = f"{name}.conv.double_conv.0"
    return (
        Layer(first, reads, inputs, middle, "backbone", divisor),
        Layer(f"{name}.conv.double_conv.2", (first,), middle, outputs, "backbone", divisor),
    )


def _history(name: str, source: str, inputs: int, outputs: int, divisor: int) -> tuple[Layer, ...]:
    return (
        Layer(f"{name}.0", (source,), inputs, outputs, "history", divisor, stride=2, repeats=3),
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

    Convolutions and gates are counted; biases, activations and the operations between layers are not. The paper's
    31.50 G is this count at 968 x 544 (its authors pad a width of 960 by 8 more) plus 11 for each number that the
    decoder's three upsamplings produce.
    """
    return {layer.name: layer.multiply_adds(height, width) for layer in LAYERS}


def check(tensors: Weights | Mapping[str, NDArray[Any]]) -> Weights:
    """Check that ``tensors`` are those of this network, and copy them.

    Source: spec 10.

    Args:
        tensors: array by name, of the shapes in `TENSORS`; `Weights` keep the choices of their training.

    Returns:
        The same numbers, in the order of `TENSORS`, as C-contiguous read-only arrays of float32.

    Raises:
        WeightsError: a tensor is missing, not of this network, misshapen, not float32 in the machine's byte order, or
            holds NaN or infinity. The message names it.
    """
    if not isinstance(tensors, (Weights, Mapping)):
        raise WeightsError(f"weights: expected {len(TENSORS)} tensors by name, got {type(tensors).__name__}")
    require_names(tensors)
    arrays = {name: _check_one(name, tensors[name]) for name in TENSORS}
    return replace(tensors, tensors=arrays) if isinstance(tensors, Weights) else Weights(arrays)


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
    if not isinstance(tensor, np.ndarray):
        raise WeightsError(f"{name}: expected an array, got {type(tensor).__name__}")
    require_shape(name, tensor.shape)
    if tensor.dtype != np.float32:
        raise WeightsError(f"{name}: expected dtype float32, got {tensor.dtype}")
    finite = np.isfinite(tensor)
    if not finite.all():
        bad = np.argwhere(~finite)
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

    def cast(tensor: Array) -> Array:
        changed = tensor.astype(dtype, order="C", copy=False)
        if changed is tensor:
            return _frozen(tensor)
        changed.flags.writeable = False
        return changed

    return weights.convert(cast)
