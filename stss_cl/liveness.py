# SPDX-License-Identifier: MIT
"""The layers and units that must run with given weights: the others are left out, and the image keeps its bits."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stss_ref.arrays import Array, Mask
from stss_ref.weights import ATTENTION, BY_NAME, LAYERS, SOURCES, Layer, Tensors, Weights

GROUP = 16
"""Units are left out in groups of this size, in which kernels sum; a layer of 24 channels is one group."""

TINY = 2.0**-100
"""Weights and biases below this can count as 0: a layer of 1152 products of inputs up to 65504 changes by less than 2^-73. Products of
those that stay are normal numbers for inputs from 2^-26 on; of smaller ones they are subnormal, and then some processors take a hundred
cycles for each."""


def is_tiny(tensor: NDArray[Any]) -> Mask:
    """True where a number is not 0, but below ``TINY``."""
    return (tensor != 0) & (np.abs(tensor) < TINY)


def drop_tiny(weights: Weights) -> Weights:
    """The same weights with 0 in place of numbers below ``TINY``."""
    return weights.convert(lambda tensor: np.where(is_tiny(tensor), np.float32(0), tensor))


class Live(NamedTuple):
    """The part of the network on which the image depends.

    Attributes:
        layers: those that must run, in order, with their remaining inputs and units.
        once: names of the layers whose result no frame changes.
        tensors: their arrays.
    """

    layers: Mapping[str, Layer]
    once: Collection[str]
    tensors: Tensors

    @property
    def reads_history(self) -> bool:
        """Whether the image depends on the history: not if kernels on every path from it are exactly 0."""
        return any("history" in layer.reads for layer in self.layers.values())


def find_live(weights: Tensors) -> Live:
    """Find the layers and units that must run for the image to be exact.

    A unit that no other reads, or that is always 0, need not run. A kernel that is exactly 0 reads nothing.
    """
    zero = {name: np.zeros(channels, np.bool_) for name, channels in SOURCES.items()}
    reads: dict[str, Mask] = {}
    for layer in LAYERS:
        arrays = [weights[name] for name, _ in layer.tensors()]
        zero_inputs = np.concatenate([np.tile(zero[source], times) for source, _, times in _parts(layer)])
        kernels: list[Mask] = [kernel.any(axis=(2, 3)) & ~zero_inputs for kernel in arrays[::2]]
        none: Mask = arrays[1] <= 0 if layer.relu else arrays[1] == 0
        zero[layer.name] = none & ~kernels[0].any(axis=1)
        reads[layer.name] = (kernels[0] | kernels[-1]) & ~zero[layer.name][:, None]
        if layer.name in ATTENTION:
            zero["reshaded"] = zero[ATTENTION[0]] | zero.get(ATTENTION[1], zero["reshaded"]).all()
    needs = {name: np.zeros(len(units), np.bool_) for name, units in zero.items()}
    needs[LAYERS[-1].name][:] = True
    live: dict[str, list[str]] = {}
    for layer in reversed(LAYERS):
        columns: Mask = np.logical_or.reduce(reads[layer.name][needs[layer.name]], axis=0)
        live[layer.name] = []
        for source, first, times in _parts(layer):
            units = columns[first : first + times * len(zero[source])].reshape(times, -1).any(axis=0)
            needs[source] |= units
            live[layer.name] += [source] if units.any() else []
        if needs["reshaded"].any():
            needs[ATTENTION[0]] |= needs["reshaded"]
            needs[ATTENTION[1]] |= ~zero[ATTENTION[1]]
    return _cut(weights, needs, live)


def _cut(weights: Tensors, needs: Mapping[str, Mask], reads: Mapping[str, Collection[str]]) -> Live:
    """Cut out the groups without a live unit, and the inputs that a layer does not read."""
    masks = {name: _in_groups(units) for name, units in needs.items()} | {n: np.ones(c, np.bool_) for n, c in SOURCES.items()}
    masks["reshaded"] = masks[ATTENTION[0]]
    varies = dict.fromkeys(SOURCES, True)
    layers: dict[str, Layer] = {}
    tensors: dict[str, Array] = {}
    for layer in (each for each in LAYERS if needs[each.name].any()):
        units, live = masks[layer.name], reads[layer.name]
        columns = np.concatenate([np.tile(masks[source] & (source in live), times) for source, _, times in _parts(layer)])
        varies[layer.name] = any(varies[source] for source in live)
        for name, shape in layer.tensors():
            rows = weights[name][units] if shape[0] == layer.outputs else weights[name]
            tensors[name] = rows if len(shape) == 1 else rows[:, columns]
        inputs = tuple(name for name in layer.reads if name in live)
        layers[layer.name] = replace(layer, reads=inputs, inputs=int(columns.sum()), outputs=int(units.sum()))
    return Live(layers, {name for name in layers if not varies[name]}, tensors)


def _in_groups(units: Mask) -> Mask:
    size = GROUP if len(units) % GROUP != 8 else len(units)
    return np.logical_or.reduceat(units, np.arange(0, len(units), size)).repeat(size)[: len(units)]


def _parts(layer: Layer) -> Iterator[tuple[str, int, int]]:
    """For each input of a layer: its name, its first channel, and the number of its images that lie side by side."""
    first = 0
    for name in layer.reads:
        source = BY_NAME.get(name)
        times = 1 if source is None else source.repeats // layer.repeats
        yield name, first, times
        first += times * (SOURCES[name] if source is None else source.outputs)


def colors_read(weights: Weights, live: Live) -> int:
    """The number of colour frames, from the newest on, on which the image depends."""
    return 3 if weights.second_color == "detail" or live.reads_history else 1


def has_residual(weights: Tensors) -> bool:
    """Whether the network adds anything: if its last layer is all zeros, the image is the upsampled frame."""
    return bool(np.any(weights["outc.weight"]) or np.any(weights["outc.bias"]))
