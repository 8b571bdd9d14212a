# SPDX-License-Identifier: MIT
"""Count and time the networks of each pipeline for display sizes: parameters, multiply-adds, milliseconds in PyTorch and OpenVINO."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from stss_ground.optional import require
from stss_lab.bench.torch_network import TorchNetwork
from stss_ref.weights import random
from training.command import command
from training.rivals.networks import EARLIER, PLANES, between, rife
from training.rivals.train import make

ROWS = ("stss", "extranet", "nsrr", "nsrr+extranet", "rife")
"""The timed networks: `nsrr+extranet` is the second stage of the swapped order, `stss` the yardstick of `stss bench` in PyTorch."""


def build(row: str) -> tuple[nn.Module, int]:
    """The network of a row, for use, and its number of parameters."""
    module = nn.Module()
    if row == "stss":
        module.forward = TorchNetwork(weights := random(0))
        return module, sum(tensor.size for tensor in weights.values())
    network = rife() if row == "rife" else make(row.rpartition("+")[2]).eval().requires_grad_(False)
    module.forward = partial(between, network) if row == "rife" else network.forward
    return module, sum(tensor.numel() for tensor in network.parameters())


def inputs_of(row: str, width: int, height: int) -> tuple[Tensor, ...]:
    """Noise for a row whose output is ``width`` x ``height``; small frames are padded to multiples of 8, RIFE's to 128."""
    multiple, scale = 128 if row == "rife" else 8, 1 if "+" in row else 2
    w, h = (-(-n // (multiple * scale)) * multiple for n in (width, height))
    if row == "nsrr":
        return (torch.cat([torch.rand(1, PLANES, h, w), torch.randn(1, 2 * EARLIER, h, w)], 1),)
    history = (3, 4, h, w) if row == "stss" else (1, 3, 4, h, w)
    shapes = [(1, 6, h, w)] if row == "rife" else [(1, 6, h, w), (1, 9, h, w), (1, 1, h, w), history]
    return tuple(torch.rand(shape) for shape in shapes)


def runner(engine: str, network: nn.Module, inputs: tuple[Tensor, ...], threads: int) -> Callable[[], object]:
    """A function that computes the network with PyTorch or, in float32, with OpenVINO."""
    if engine == "openvino":
        openvino = require("openvino")
        options = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
        converted = openvino.convert_model(network, example_input=inputs)
        converted.reshape({port: list(x.shape) for port, x in zip(converted.inputs, inputs, strict=True)})
        compiled, arrays = openvino.Core().compile_model(converted, "CPU", options), [x.numpy() for x in inputs]
        return lambda: compiled(arrays)
    bound = tuple(x.contiguous(memory_format=torch.channels_last) if x.ndim == 4 else x for x in inputs)
    return partial(network, *bound)


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.cost``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.cost", description=__doc__)
    parser.add_argument(
        "--size", nargs="+", default=["1280x720", "1920x1080", "3840x2160"], metavar="WxH", help="sizes of the output"
    )
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument("--engines", nargs="+", default=("pytorch", "openvino"))
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    # One engine at a time: OpenVINO's memory for 3840x2160 leaves PyTorch no room in 23 GB.
    for size, engine in product(options.size, options.engines):
        runs: dict[str, Callable[[], object]] = {}
        for row in options.rows:
            network, parameters = build(row)
            inputs = inputs_of(row, *map(int, size.split("x")))
            if engine == options.engines[0]:
                with FlopCounterMode(display=False) as counter:
                    network(*inputs)
                cost = f"{parameters / 1e6:.3f} M parameters, {counter.get_total_flops() / 2e9:.2f} G multiply-adds"
                sys.stdout.write(f"{size} {row}: {cost}\n")
            runs[row] = runner(engine, network, inputs, options.threads)
        times: dict[str, list[tuple[float, float]]] = {row: [] for row in runs}
        for _ in range(options.repeat + 1):
            for row, run in runs.items():
                before = time.perf_counter(), time.process_time()
                run()
                times[row].append((time.perf_counter() - before[0], (time.process_time() - before[1]) / options.threads))
        for row, (_, *runs_of) in times.items():
            wall, processor = (min(values) * 1e3 for values in zip(*runs_of, strict=True))
            sys.stdout.write(f"{size} {row}, {engine}: {wall:.1f} ms, {processor:.1f} ms of processor time a thread\n")
        sys.stdout.flush()


if __name__ == "__main__":
    command(main)
