# SPDX-License-Identifier: MIT
"""The network's graph, made from the table of layers: its operations in order, for every engine.

The host's plan, the networks in PyTorch for training and for the benchmark, and the ONNX model follow from these nodes. `stss_ref` and
the ports in C++ and WGSL are written out, since people read them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from stss_ref.weights import ATTENTION, BY_NAME, Layer

T = TypeVar("T")

UPSAMPLED = ".upsampled"
"""Suffix of a layer's name: the part of its input that is upsampled first."""


@dataclass(frozen=True)
class Convolution:
    """A layer that reads the results ``reads``, side by side."""

    layer: Layer
    reads: tuple[str, ...]

    @property
    def name(self) -> str:
        """The layer's."""
        return self.layer.name

    @property
    def joins_images(self) -> bool:
        """Whether it reads results of all three frames of the history, side by side."""
        return self.layer.repeats == 1 and any(name in BY_NAME and BY_NAME[name].repeats > 1 for name in self.reads)


@dataclass(frozen=True)
class Upsampling:
    """The results ``reads``, side by side, at twice the size with corners aligned."""

    name: str
    reads: tuple[str, ...]


@dataclass(frozen=True)
class Attention:
    """The ERM's means over its window: of the values and keys that ``reads`` names, in this order, and the mask."""

    name: str = "reshaded"
    reads: tuple[str, ...] = ATTENTION


Node = Convolution | Upsampling | Attention


def nodes(layers: Mapping[str, Layer] = BY_NAME) -> Iterator[Node]:
    """The nodes of a network, each after those that it reads.

    Args:
        layers: the layers that run, in order, with their remaining inputs (`stss_cl.liveness.find_live`).
    """
    is_reshaded = False
    for layer in layers.values():
        if "reshaded" in layer.reads and not is_reshaded:
            is_reshaded = True
            yield Attention()
        small = tuple(name for name in layer.reads if divisor_of(name) > layer.divisor)
        larger = layer.name + UPSAMPLED
        if small:
            yield Upsampling(larger, small)
        yield Convolution(layer, tuple(dict.fromkeys(larger if name in small else name for name in layer.reads)))


def divisor_of(name: str) -> int:
    """The divisor of a result or source, which has 1 / divisor of the frame's height and width."""
    return BY_NAME[name].divisor if name in BY_NAME else {"gbuffer": 8, "reshaded": 8}.get(name, 1)


GRAPH = tuple(nodes())
"""The whole network."""


class Operations(Protocol[T]):
    """An engine that computes the network on values of its own type."""

    def convolve(self, x: T, layer: Layer) -> T:
        """A layer with its gate and its ReLU."""
        ...

    def upsample(self, x: T) -> T:
        """Twice the size, bilinear, corners aligned."""
        ...

    def attend(self, light: T, material: T, mask: T) -> T:
        """Stage ``erm`` after its layers: values and keys at an eighth, not yet masked or divided by their length."""
        ...

    def reduce(self, x: T) -> T:
        """An eighth of the size: the means of the middle four pixels of 64."""
        ...

    def multiply(self, x: T, y: T) -> T:
        """The product."""
        ...

    def join(self, values: Sequence[T]) -> T:
        """Side by side."""
        ...

    def join_images(self, x: T) -> T:
        """The three images of the history side by side."""
        ...


def evaluate(
    do: Operations[T],
    color: T,
    gbuffer: T,
    mask: T,
    history: T,
    graph: Sequence[Node] = GRAPH,
    results: Mapping[str, T] | None = None,
) -> dict[str, T]:
    """Compute the network up to the residual at the frame's size, ``outc``.

    Args:
        do: the operations.
        color, gbuffer, mask, history: as in `stss_ref.network.network`, padded to multiples of 8.
        graph: of `nodes`.
        results: further results, by name, that nodes read.

    Returns:
        All results by name.
    """
    values = {
        "input": do.join([color, do.multiply(color, mask), gbuffer]),
        "gbuffer": do.reduce(gbuffer),
        "history": history,
        **(results or {}),
    }
    m = do.reduce(mask)
    for node in graph:
        if isinstance(node, Attention):
            light, material = (values[name] for name in node.reads)
            values[node.name] = do.attend(light, material, m)
            continue
        x = do.join([values[name] for name in node.reads])
        if isinstance(node, Upsampling):
            values[node.name] = do.upsample(x)
        else:
            values[node.name] = do.convolve(do.join_images(x) if node.joins_images else x, node.layer)
    return values
