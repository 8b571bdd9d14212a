# SPDX-License-Identifier: MIT
"""`stss weights inspect`: the layers of weights, and the cost of the network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from stss_cl.liveness import TINY, drop_tiny, find_live, is_tiny
from stss_ground.errors import InputError
from stss_ref.constants import HoleFill, HoleTest
from stss_ref.weights import LAYERS, Layer, SecondColor, Weights


@dataclass(frozen=True)
class LayerRow:
    """One layer of the table: its multiply-adds for a frame, its largest weight or bias, when it runs, and how many units then."""

    layer: Layer
    multiply_adds: int
    largest: float
    use: Literal["frame", "once", "never"]
    units: int


@dataclass(frozen=True)
class ComponentRow:
    """One row of the paper's cost table."""

    name: str
    parameters: int
    multiply_adds: int


@dataclass(frozen=True)
class Inspection:
    """The layers of weights, and the network's cost for frames of (height, width), padded to multiples of 8.

    ``tiny``: the count of numbers that are not 0 but that the backend drops (``stss_cl.liveness.drop_tiny``); ``subnormal``: how many of
    these are subnormal.
    """

    height: int
    width: int
    layers: tuple[LayerRow, ...]
    components: tuple[ComponentRow, ...]
    second_color: SecondColor
    hole_test: HoleTest
    hole_fill: HoleFill
    tiny: int
    subnormal: int


def inspect(weights: Weights, height: int, width: int) -> Inspection:
    """Inspect ``weights`` and count the network's cost for frames of (height, width); InputError below 1 x 1."""
    if height < 1 or width < 1:
        raise InputError(f"size {width}x{height}: expected at least 1x1")
    live = find_live(drop_tiny(weights))
    tiny = np.concatenate([np.abs(tensor[is_tiny(tensor)]) for tensor in weights.values()])
    runs = {name: layer.outputs for name, layer in live.layers.items()}
    rows = tuple(
        LayerRow(
            layer,
            layer.multiply_adds(height, width),
            max(float(np.abs(weights[name]).max()) for name, _ in layer.tensors()),
            "never" if layer.name not in runs else "once" if layer.name in live.once else "frame",
            runs.get(layer.name, 0),
        )
        for layer in LAYERS
    )
    return Inspection(
        -(-height // 8) * 8,
        -(-width // 8) * 8,
        rows,
        component_costs(height, width),
        weights.second_color,
        weights.hole_test,
        weights.hole_fill,
        len(tiny),
        int((tiny < np.finfo(np.float32).smallest_normal).sum()),
    )


def component_costs(height: int, width: int) -> tuple[ComponentRow, ...]:
    """The paper's cost table (Tab. "Cost analysis for each component"), for frames of (height, width).

    A row counts its component: the history and the ERM also widen the input of ``up1``, by 32 channels each.
    Besides the convolutions, 11 operations are counted for each number that the decoder's three upsamplings produce. The
    paper's own numbers are for 968 x 544: its authors pad a width of 960 by 8 more.
    """
    rows: list[ComponentRow] = []
    parameters = multiply_adds = 0
    layers: list[Layer] = []
    for name, component, inputs in (
        ("Backbone", "backbone", 64),
        ("HistoryEmbedding", "history", 96),
        ("ERM", "erm", 128),
    ):
        layers += [layer for layer in LAYERS if layer.component == component and not layer.name.startswith("up1")]
        all_layers = [*layers, *_up1(inputs)]
        before = parameters, multiply_adds
        parameters = sum(layer.parameters for layer in all_layers)
        multiply_adds = sum(layer.multiply_adds(height, width) for layer in all_layers)
        multiply_adds += _upsampling(height, width, inputs)
        rows.append(ComponentRow(name, parameters - before[0], multiply_adds - before[1]))
    return (*rows, ComponentRow("Full", parameters, multiply_adds))


def _up1(inputs: int) -> list[Layer]:
    first, second = (layer for layer in LAYERS if layer.name.startswith("up1"))
    return [replace(first, inputs=inputs, outputs=inputs // 2), replace(second, inputs=inputs // 2)]


def _upsampling(height: int, width: int, inputs: int) -> int:
    pixels = -(-height // 8) * -(-width // 8)
    channels_of_up = (inputs - 32, 32, 24)
    return sum(11 * channels * pixels * 4**step for step, channels in enumerate(channels_of_up, start=1))


def print_inspection(inspection: Inspection, console: Console) -> None:
    """Print the layers, and the components as in the paper's cost table."""
    layers = _table(
        f"Layers; multiply-adds in millions for one frame of {inspection.width} x {inspection.height}",
        ("layer", "component", "weight"),
        ("parameters", "mult-adds", "largest"),
    )
    for row in inspection.layers:
        layer = row.layer
        shape = f"{layer.outputs}x{layer.inputs}x{layer.kernel}x{layer.kernel}" + (" gated" if layer.gated else "")
        layers.add_row(
            *(layer.name, layer.component, shape),
            *(f"{layer.parameters:,}", f"{row.multiply_adds / 1e6:,.1f}", f"{row.largest:.4g}"),
        )
    components = _table(
        "Parameters and cost of each component, upsampling included", ("component",), ("parameters, K", "mult-adds, G")
    )
    for part in inspection.components:
        components.add_row(part.name, f"{part.parameters / 1e3:.2f}", f"{part.multiply_adds / 1e9:.2f}")
    console.print(layers, components)
    for use, what in (
        ("never", "left out, since they are 0 or only kernels of 0 read them"),
        ("once", "run once, since all their kernels that read a frame are 0"),
    ):
        if names := [row.layer.name for row in inspection.layers if row.use == use]:
            console.print(f"{what}: {', '.join(names)}")
    parts = [(row.units, row.layer) for row in inspection.layers if 0 < row.units < row.layer.outputs]
    if parts:
        console.print("units that run:", ", ".join(f"{units} of {layer.outputs} of {layer.name}" for units, layer in parts))
    if inspection.tiny:
        console.print(f"taken for 0: {inspection.tiny} numbers below {TINY:.0e}, of which {inspection.subnormal} are subnormal")
    what = "the details of warped frames within a pixel" if inspection.second_color == "detail" else "the newest frame"
    console.print(f"second colour: {inspection.second_color}, {what}")
    console.print(f"hole test: {inspection.hole_test}; holes are filled by: {inspection.hole_fill}")


def _table(title: str, words: tuple[str, ...], numbers: tuple[str, ...]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for column in words:
        table.add_column(column, no_wrap=True)
    for column in numbers:
        table.add_column(column, justify="right", no_wrap=True)
    return table
