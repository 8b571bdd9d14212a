# SPDX-License-Identifier: MIT
"""The network's steps in order and the buffers between them, from its graph; no device is needed."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, product

from stss_cl.device.grid import ceil8
from stss_cl.graph import UPSAMPLED, Attention, Convolution, Node, Upsampling, nodes
from stss_ref.weights import ATTENTION, BY_NAME, LAYERS, SOURCES, Layer

FEATURES = {"conv2": "x1", "down1.conv2": "x2", "down2.conv2": "x3", "down3.conv2": "x4", "reshaded": "reshaded"}
"""Results that stay after the network has run, by the names of ``stss_ref``; the history's feature lies behind ``reshaded``."""
JOINED = ("reshaded", "lowlevelGated"), 3 * ("convHis3.4",)
"""Results that lie side by side in one buffer; all three images of the last one."""
LAST = LAYERS[-2].name
"""The last layer of 3 x 3, before the image."""


@dataclass(frozen=True)
class Slot:
    """One buffer: ``number``, of 1 / ``divisor`` of the frame's size, with its channels and images."""

    number: int
    divisor: int
    channels: int
    images: int = 1


@dataclass(frozen=True)
class Conv:
    """A convolution of ``inputs`` side by side into the channels from ``first`` on of ``out``.

    ``inputs``: slots, and the number of real channels in each. ``image``: the image of the history to read; None: all of them in one
    launch.
    """

    layer: Layer
    inputs: tuple[tuple[Slot, int], ...]
    out: Slot
    first: int = 0
    image: int | None = 0


@dataclass(frozen=True)
class Upsample:
    """``source`` at twice the size."""

    source: Slot
    out: Slot


@dataclass(frozen=True)
class Attend:
    """The attention; ``unit``: the keys divided by their lengths, if they are stored."""

    key: Slot
    value: Slot
    unit: Slot | None
    out: Slot


Step = Conv | Upsample | Attend


@dataclass(frozen=True)
class Plan:
    """The steps of a network and their buffers.

    Attributes:
        slots: all buffers; the first three are the network's input, its history and its input at an eighth.
        steps: of each frame.
        once: before the first frame.
        features: the slots of ``FEATURES``, by the names of ``stss_ref``.
        last: the features of the image: the result of ``LAST``, or any finite activations if no layer reads it.
        fused: whether ``last`` is the input of ``LAST`` instead, which makes the image itself.
    """

    slots: tuple[Slot, ...]
    steps: tuple[Step, ...]
    once: tuple[Step, ...]
    features: Mapping[str, Slot]
    last: Slot
    fused: bool


def plan_network(
    layers: Mapping[str, Layer] = BY_NAME, once: Collection[str] = (), *, keep: bool, fused: bool, local: bool, together: bool
) -> Plan:
    """Plan a network.

    Args:
        layers, once: see ``stss_cl.liveness.Live``.
        keep: every step has its own output.
        fused: ``LAST`` makes the image itself.
        local: the attention is one kernel.
        together: the history's images are computed in one launch for each layer.
    """
    fused = fused and LAST in layers
    left_out = {LAYERS[-1].name, LAST} if fused else {LAYERS[-1].name}
    order = [(node, image) for node, image in _order(layers, together) if node.name not in left_out]
    last = BY_NAME[LAST].reads[0] if fused else LAST
    result = last if last in layers else "input"
    buffers = _Buffers(layers, {*FEATURES, "history", "gbuffer", result}, once, keep)
    steps: list[Step] = []
    before: list[Step] = []
    for (node, image), last_read in zip(order, _last_reads(order), strict=True):
        layer = node.name.removesuffix(UPSAMPLED)
        (before if layer in once else steps).append(_step(buffers, node, image, local))
        buffers.free(last_read)
    features = {FEATURES[name]: buffers[name] for name in FEATURES if name in buffers}
    return Plan(tuple(buffers.slots), tuple(steps), tuple(before), features, buffers[result], fused)


def _order(layers: Mapping[str, Layer], together: bool) -> Iterator[tuple[Node, int | None]]:
    """Nodes in the order of computation, with the history's image: its branch runs for one image after the other, or for all at once."""
    for repeats, branch in groupby(nodes(layers), lambda node: node.layer.repeats if isinstance(node, Convolution) else 1):
        images = (0,) if repeats == 1 else (None,) if together else range(repeats)
        yield from product(tuple(branch), images) if repeats == 1 else ((n, i) for i, n in product(images, tuple(branch)))


def _last_reads(order: Sequence[tuple[Node, int | None]]) -> list[set[str]]:
    """For each node the names that no later node reads before they are computed again."""
    live: set[str] = set()
    last: list[set[str]] = []
    for node, _ in reversed(order):
        live.discard(node.name)
        last.append({*node.reads} - live)
        live |= {*node.reads}
    return last[::-1]


def _step(buffers: _Buffers, node: Node, image: int | None, local: bool) -> Step:
    if isinstance(node, Attention):
        value, key = (buffers[name] for name in node.reads)
        unit = None if local else buffers.take(key.divisor, key.channels)
        out, _ = buffers.place(node.name, 8, buffers.channels(node.name))
        if unit is not None:
            buffers.give_back(unit)
        return Attend(key, value, unit, out)
    if isinstance(node, Upsampling):
        source = buffers[node.reads[0]]
        return Upsample(source, buffers.place(node.name, source.divisor // 2, source.channels)[0])
    layer, images = node.layer, 3 if image is None else 1
    inputs = buffers.inputs(node, images)
    out, first = buffers.place(node.name, layer.divisor, layer.outputs, images)
    if node.name in JOINED[1]:
        first = layer.outputs * (image or 0)
    return Conv(layer, inputs, out, first, image if "history" in layer.reads or image is None else 0)


class _Buffers:
    """The slots of results; a slot is used again after its last reader.

    Args:
        layers: those that run.
        stay: names of results whose slot is not reused afterwards.
        once: names of results whose slot no other result shares.
        keep: no slot is reused.

    Attributes:
        slots: all of them.
    """

    def __init__(self, layers: Mapping[str, Layer], stay: Collection[str], once: Collection[str], keep: bool):
        self.slots: list[Slot] = []
        self._layers, self._stay, self._once, self._keep = layers, stay, once, keep
        self._free: list[Slot] = []
        # The place of each result: a slot, and the first channel there.
        self._results = {
            name: (self._new(*size), 0) for name, size in (("input", (1, 24)), ("history", (1, 4, 3)), ("gbuffer", (8, 16)))
        }

    def __contains__(self, name: str) -> bool:
        return name in self._results

    def __getitem__(self, name: str) -> Slot:
        return self._results[name][0]

    def channels(self, name: str, repeats: int = 1) -> int:
        """Channels of a result that is read by a layer that runs ``repeats`` times; 0: it is not computed."""
        if name in SOURCES and name != "reshaded":
            return SOURCES[name]
        source = self._layers.get(ATTENTION[0] if name == "reshaded" else name)
        return 0 if source is None else source.outputs * (source.repeats // repeats)

    def inputs(self, node: Convolution, images: int) -> tuple[tuple[Slot, int], ...]:
        """The slots that a layer reads, and the number of real channels in each."""
        inputs: dict[Slot, int] = {}
        for name in node.layer.reads:
            source = name if name in node.reads else node.name + UPSAMPLED
            inputs[self[source]] = inputs.get(self[source], 0) + self.channels(name, node.layer.repeats)
        if inputs:
            return tuple(inputs.items())
        # A layer without inputs still needs a buffer, for kernels of 0; its values are finite.
        unread = self.take(node.layer.divisor // node.layer.stride, 8, images)
        self.give_back(unread)
        return ((unread, 0),)

    def place(self, name: str, divisor: int, channels: int, images: int = 1) -> tuple[Slot, int]:
        """The slot of a result, and its first channel there."""
        together = next((names for names in JOINED if name in names), ())
        sizes = [self.channels(each, BY_NAME[each].repeats if each in BY_NAME else 1) for each in together]
        buffer = next((self._results[each][0] for each in together if each in self._results), None)
        if together:
            slot = buffer or self._new(8, sum(sizes))
            self._results[name] = slot, sum(sizes[: together.index(name)])
        else:
            size = divisor, ceil8(channels), images
            self._results[name] = (self._new(*size) if name in self._once else self.take(*size)), 0
        return self._results[name]

    def free(self, names: Collection[str]) -> None:
        """Free the slots of results that no later node reads."""
        joined = {each for names in JOINED for each in names}
        for name in sorted({*names} - {*self._stay, *self._once} - joined):
            self.give_back(self._results.pop(name)[0])

    def take(self, divisor: int, channels: int, images: int = 1) -> Slot:
        """A free slot, or a new one."""
        for slot in self._free:
            if (slot.divisor, slot.channels, slot.images) == (divisor, channels, images):
                self._free.remove(slot)
                return slot
        return self._new(divisor, channels, images)

    def give_back(self, slot: Slot) -> None:
        """Free the slot for other results."""
        if not self._keep:
            self._free.append(slot)

    def _new(self, divisor: int, channels: int, images: int = 1) -> Slot:
        self.slots.append(Slot(len(self.slots), divisor, channels, images))
        return self.slots[-1]
