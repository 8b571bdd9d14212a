# SPDX-License-Identifier: MIT
"""Results of layers, which a port may return so that the judge can name the layer where a wrong answer begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from conformance.protocol.array_specs import ArraySpec, Label, array_spec, check_shapes
from conformance.protocol.port import Arrays, Outputs
from conformance.protocol.stages import STAGES, check_inputs
from conformance.protocol.watch import Activations
from stss_ref.arrays import ArrayError
from stss_ref.weights import LAYERS, SOURCES, Layer

_FRAME_SIZED = {"color": "H W 6", "mask": "H W", "history": "3 H W 4"}
"""The inputs that stage ``frame`` makes for the network; not yet padded."""
PADDED = ("network", "frame")
"""Stages that take frames of any size, and pad them to multiples of 8 inside."""


def _spec(layer: Layer) -> ArraySpec:
    over = f"/{layer.divisor}" if layer.divisor > 1 else ""
    return array_spec(f"{'3 ' if layer.repeats == 3 else ''}H{over} W{over} {layer.outputs}")


def _specs(stages: Sequence[str]) -> dict[str, ArraySpec]:
    return {layer.name: _spec(layer) for layer in LAYERS if layer.stage in stages}


_WHOLE = {
    **_specs(("encoder", "history", "erm")),
    "reshaded": array_spec(f"H/8 W/8 {SOURCES['reshaded']}"),
    **_specs(("decoder",)),
}
LAYERS_OF: Mapping[str, Mapping[str, ArraySpec]] = {
    "history": _specs(("history",)),
    "encoder": _specs(("encoder",)),
    "erm": _specs(("erm",)),
    "decoder": _specs(("decoder",)),
    "network": _WHOLE,
    "frame": {**{name: array_spec(text) for name, text in _FRAME_SIZED.items()}, **_WHOLE},
}
"""For each stage that has layers, in the order of computation: names and shapes. Each result is after gate and ReLU."""


def choose(stage: str, record: Activations) -> Outputs:
    """The layers of a stage among all recorded arrays."""
    layers: Outputs = {}
    for name in LAYERS_OF.get(stage, {}):
        if arrays := record.arrays.get(name):
            layers[name] = np.ascontiguousarray(np.stack(arrays) if len(arrays) > 1 else arrays[0])
    return layers


def check_layers(stage: str, layers: Arrays, inputs: Arrays, label: Label = str) -> None:
    """Check that ``layers`` are layers of a stage, of the right shapes, in float32. The stage's outputs may be among them.

    Raises:
        ArrayError: one is not.
    """
    specs, sizes = LAYERS_OF.get(stage, {}), check_inputs(stage, inputs)
    padded = {letter: -(-size // 8) * 8 for letter, size in sizes.items()} if stage in PADDED else sizes
    for name, array in layers.items():
        if name in STAGES[stage].outputs:
            continue
        if name not in specs:
            raise ArrayError(f"{label(name)}: not a layer of stage {stage}")
        check_shapes({name: specs[name]}, {name: array}, sizes if name in _FRAME_SIZED else padded, "float32", label)
