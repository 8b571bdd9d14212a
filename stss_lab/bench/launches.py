# SPDX-License-Identifier: MIT
"""Time each launch of the network by the device's clock, beside its work: ``stss bench --launches``."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import pyopencl as cl
from rich import box
from rich.console import Console
from rich.table import Table

from stss_cl.device.buffers import Outgoing
from stss_cl.device.discovery import open_device
from stss_cl.network.layer import LayerLaunch
from stss_cl.network.network import Network
from stss_cl.options import Precision
from stss_ground.errors import InputError
from stss_ground.machine import conditions
from stss_lab.bench.contender import Setup
from stss_lab.bench.ours import inputs_for

NETWORKS: dict[str, Precision] = {"cl": "float32", "cl-direct": "float32-direct", "cl-half": "half", "cl-bfloat16": "bfloat16"}
"""Precision of the networks of ``stss bench --ours``."""
PACKAGES = ("numpy", "pyopencl", "pocl-binary-distribution")
TAPS = 9
"""Of a convolution of 3 x 3."""


@dataclass(frozen=True)
class LaunchTiming:
    """The times of one launch, and its work.

    Attributes:
        name: the layer or step.
        kernel: the kernel.
        seconds: of each run.
        products: multiply-adds of the plain convolution over whole eights of channels; 0: it is none.
        bytes: of the buffers that it reads and writes, once each.
    """

    name: str
    kernel: str
    seconds: tuple[float, ...]
    products: int
    bytes: int


@dataclass(frozen=True)
class LaunchTimings:
    """All launches of a network, in order, with its size in pixels, the device's name and the precision."""

    height: int
    width: int
    device: str
    precision: Precision
    launches: tuple[LaunchTiming, ...]


def time_launches(setup: Setup, name: str, repeat: int) -> LaunchTimings:
    """Run a network ``repeat`` times; a time is from the kernel's begin to its end on the device.

    Args:
        setup: weights, size and device.
        name: of ``NETWORKS``.
        repeat: number of runs.

    Raises:
        InputError: the device has too little memory for the whole frame at once, or no network has this name.
    """
    if name not in NETWORKS:
        raise InputError(f"--launches: expected --ours of {', '.join(NETWORKS)}, got {name!r}")
    device, size = open_device(setup.device, timed=True), (setup.height, setup.width)
    network = Network(setup.weights, device, NETWORKS[name])
    network(**vars(inputs_for(name, setup)))
    layers = network.layers(*size)
    if len(layers.strips) > 1:
        raise InputError(f"--size {setup.width}x{setup.height}: {device.name} computes it in strips; take a smaller one")
    image = Outgoing(device, (2 * setup.height, 2 * setup.width, 3), on_device=True)
    launches = layers.ready(image.data)
    events = [[launch.enqueue(device.queue) for launch in launches] for _ in range(repeat)]
    device.queue.finish()
    seconds = [[(event.profile.end - event.profile.start) * 1e-9 for event in run] for run in events]
    rows = tuple(
        LaunchTiming(launch.name, launch.kernel.name, times, _products(launch), _bytes(launch))
        for launch, times in zip(launches, zip(*seconds, strict=True), strict=True)
    )
    return LaunchTimings(*size, device.name, NETWORKS[name], rows)


def _products(launch: LayerLaunch) -> int:
    options, sizes = launch.source.options, launch.arguments
    if "OUT" not in options:
        return 0
    channels = int(str(options["A"])) + int(str(options["B"]))
    return TAPS * channels * int(str(options["OUT"])) * sizes["height"] * sizes["width"] * launch.tiling.images


def _bytes(launch: LayerLaunch) -> int:
    buffers = {id(value): value for value in launch.arguments.values() if isinstance(value, cl.Buffer)}
    return sum(buffer.size for buffer in buffers.values())


def print_launches(timings: LaunchTimings, console: Console) -> None:
    """Print a table; its last line is the sum."""
    launches = timings.launches
    runs = f"{len(launches[0].seconds)} runs"
    title = f"{timings.width} x {timings.height}, {timings.precision}, {timings.device}, {runs}; 10^9 multiply-adds"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=0)
    for column in ("launch", "kernel"):
        table.add_column(column, no_wrap=True)
    for column in ("us\nmin", "\nmedian", "10^9\n", "\na ms", "MB\n", "\na ms"):
        table.add_column(column, justify="right", no_wrap=True)
    for each in launches:
        table.add_row(each.name, each.kernel, *_numbers(each))
    seconds = tuple(sum(each) for each in zip(*(each.seconds for each in launches), strict=True))
    whole = LaunchTiming("all", "", seconds, sum(each.products for each in launches), sum(each.bytes for each in launches))
    table.add_row(whole.name, whole.kernel, *_numbers(whole))
    console.print(table, markup=False, highlight=False)


def _numbers(timing: LaunchTiming) -> list[str]:
    least, products = min(timing.seconds), timing.products
    return [
        f"{least * 1e6:.1f}",
        f"{statistics.median(timing.seconds) * 1e6:.1f}",
        f"{products * 1e-9:.2f}" if products else "-",
        f"{products / least * 1e-12:.2f}" if products else "-",
        f"{timing.bytes * 1e-6:.1f}",
        f"{timing.bytes / least * 1e-9:.0f}",
    ]


def to_json(tables: Sequence[LaunchTimings], weights: str) -> str:
    """All launches as JSON; ``weights``: their identity."""
    data = {"format": 1, **conditions(PACKAGES), "weights": weights, "tables": [asdict(table) for table in tables]}
    return json.dumps(data, indent=1) + "\n"
