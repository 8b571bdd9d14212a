# SPDX-License-Identifier: MIT
"""The network's steps in order and the buffers between them, from the table of layers; no device is needed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from stss_cl.device.grid import ceil8
from stss_ref.weights import ATTENTION, BY_NAME, LAYERS, SOURCES, Layer

FEATURES = {"conv2": "x1", "down1.conv2": "x2", "down2.conv2": "x3", "down3.conv2": "x4", "reshaded": "reshaded"}
"""Results that stay when the network has run, with the names of ``stss_ref``; ``reshaded`` has the history's feature behind it."""
JOINED = ("reshaded", "lowlevelGated"), 3 * ("convHis3.4",)
"""Results that lie side by side in one buffer; of the last one all three images."""
LAST = LAYERS[-2].name
"""The last layer of 3 x 3, after which comes the image."""


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

    ``image``: which of the history's images is read; None: all of them in one launch.
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
    """The attention; ``unit``: the keys divided by their lengths, where they are stored."""

    key: Slot
    value: Slot
    unit: Slot | None
    out: Slot


Step = Conv | Upsample | Attend


@dataclass(frozen=True)
class Plan:
    """What runs.

    Attributes:
        slots: all buffers; the first three are the network's input, its history and its input at an eighth.
        steps: of each frame.
        once: before the first frame.
        features: the slots of ``FEATURES``, by the names of ``stss_ref``.
        last: what the image is made of: the result of ``LAST``, or any finite activations where nothing reads it.
        fused: whether ``last`` is the input of ``LAST`` instead, which makes the image itself.
    """

    slots: tuple[Slot, ...]
    steps: tuple[Step, ...]
    once: tuple[Step, ...]
    features: Mapping[str, Slot]
    last: Slot
    fused: bool


def plan(
    layers: Mapping[str, Layer] = BY_NAME, once: Collection[str] = (), *, keep: bool, fused: bool, local: bool, together: bool
) -> Plan:
    """Plan a network.

    Args:
        layers, once: see ``stss_cl.liveness.Live``.
        keep: every step has an output of its own.
        fused: ``LAST`` makes the image itself.
        local: the attention is one kernel.
        together: the history's images are computed in one launch for each layer.
    """
    return _Planner(layers, once, keep, fused, local, together).plan()


class _Planner:
    def __init__(self, layers: Mapping[str, Layer], once: Collection[str], keep: bool, fused: bool, local: bool, together: bool):
        self._layers, self._once_of, self._keep, self._fused, self._local = layers, once, keep, fused, local
        self._together = together
        self._slots: list[Slot] = []
        self._scratch: list[Slot] = []
        self._steps: list[Step] = []
        self._once: list[Step] = []
        self._joined: dict[tuple[str, ...], Slot] = {}
        # Where results lie: a buffer, and the first channel there.
        self._results: dict[str, tuple[Slot, int]] = {
            name: (self._new(*size), 0) for name, size in (("input", (1, 24)), ("history", (1, 4, 3)), ("gbuffer", (8, 16)))
        }
        if not keep:
            self._scratch.append(self._results["input"][0])  # done with after the first layer

    def plan(self) -> Plan:
        *before, _ = self._layers.values()
        history = [layer for layer in before if layer.repeats > 1]
        for layer in before:
            if layer.repeats > 1:
                if layer is history[0]:
                    self._history(history)
                continue
            if self._fused and layer.name == LAST:
                continue
            if "reshaded" in layer.reads:
                self._attend()
            self._add(layer)
        features = {FEATURES[name]: self._results[name][0] for name in FEATURES if name in self._results}
        fused = self._fused and LAST in self._layers
        shown = self._results.get(BY_NAME[LAST].reads[0] if fused else LAST, self._results["input"])[0]
        return Plan(tuple(self._slots), tuple(self._steps), tuple(self._once), features, shown, fused)

    def _history(self, branch: Sequence[Layer]) -> None:
        """The layers that run for each of the three images: an image after the other, or each for all of them."""
        for image in (None,) if self._together else range(3):
            for layer in branch:
                self._results.pop(layer.name, None)
                self._add(layer, image)

    def _attend(self) -> None:
        value, key = (self._results[name][0] for name in ATTENTION)
        unit = None if self._local else self._take(key.divisor, key.channels, avoid=(key,))
        self._steps.append(Attend(key, value, unit, self._output("reshaded", 8, self._channels("reshaded"))[0]))

    def _add(self, layer: Layer, image: int | None = 0) -> None:
        images = 3 if image is None else 1
        inputs = self._inputs(layer, images)
        out, first = self._output(layer.name, layer.divisor, layer.outputs, images, [slot for slot, _ in inputs])
        if layer.name == "convHis3.4":
            first = layer.outputs * (image or 0)
        if "history" not in layer.reads and image is not None:
            image = 0
        self._steps_with(layer).append(Conv(layer, tuple(inputs), out, first, image))

    def _steps_with(self, layer: Layer) -> list[Step]:
        return self._once if layer.name in self._once_of else self._steps

    def _inputs(self, layer: Layer, images: int) -> list[tuple[Slot, int]]:
        """The buffers that a layer reads, and how many channels of each are real; what is too small is upsampled before."""
        inputs: dict[Slot, int] = {}
        for name in layer.reads:
            slot = self._results[name][0]
            inputs[slot] = inputs.get(slot, 0) + self._channels(name, layer.repeats)
        for small in [slot for slot in inputs if slot.divisor > layer.divisor]:
            larger = self._take(layer.divisor, small.channels, avoid=tuple(inputs))
            self._steps_with(layer).append(Upsample(small, larger))
            inputs = {larger if slot is small else slot: channels for slot, channels in inputs.items()}
        # A layer that reads nothing still needs a buffer, for kernels of 0: its values are finite.
        return list(inputs.items()) or [(self._take(layer.divisor // layer.stride, 8, images), 0)]

    def _channels(self, name: str, repeats: int = 1) -> int:
        """Channels of what is read by a layer that runs ``repeats`` times; 0: it never runs."""
        if name in SOURCES and name != "reshaded":
            return SOURCES[name]
        source = self._layers.get(ATTENTION[0] if name == "reshaded" else name)
        return 0 if source is None else source.outputs * (source.repeats // repeats)

    def _output(self, name: str, divisor: int, channels: int, images: int = 1, avoid: Sequence[Slot] = ()) -> tuple[Slot, int]:
        """Where a result goes."""
        if name in self._results:
            return self._results[name]
        together = next((names for names in JOINED if name in names), ())
        if together:
            sizes = [self._channels(each, BY_NAME[each].repeats if each in BY_NAME else 1) for each in together]
            if together not in self._joined:
                self._joined[together] = self._new(8, sum(sizes))
            self._results[name] = self._joined[together], sum(sizes[: together.index(name)])
        elif name in FEATURES or name in ATTENTION or name in self._once_of:
            self._results[name] = self._new(divisor, ceil8(channels), images), 0
        else:
            self._results[name] = self._take(divisor, ceil8(channels), images, avoid), 0
        return self._results[name]

    def _take(self, divisor: int, channels: int, images: int = 1, avoid: Sequence[Slot] = ()) -> Slot:
        """A buffer for short use: the first of this size that is not to be avoided, or a new one each time if all are kept."""
        for slot in self._scratch:
            if (slot.divisor, slot.channels, slot.images) == (divisor, channels, images) and slot not in avoid:
                return slot
        made = self._new(divisor, channels, images)
        if not self._keep:
            self._scratch.append(made)
        return made

    def _new(self, divisor: int, channels: int, images: int = 1) -> Slot:
        self._slots.append(Slot(len(self._slots), divisor, channels, images))
        return self._slots[-1]
