# SPDX-License-Identifier: MIT
"""Count and time the networks of each pipeline for display sizes: parameters, multiply-adds, milliseconds in PyTorch and OpenVINO."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from functools import partial
from timeit import timeit
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from stss_ground.optional import require
from stss_lab.bench.torch_network import TorchNetwork
from stss_ref.weights import random
from training.command import command
from training.rivals.networks import EARLIER, PLANES, between, rife
from training.rivals.train import make

Inputs = tuple[Tensor, ...]
ROWS = ("stss", "extranet", "nsrr", "nsrr+extranet", "rife")
"""What is timed: `nsrr+extranet` is the second stage of the swapped order, `stss` the yardstick of `stss bench` in PyTorch."""


class Called(nn.Module):
    """A function as a module."""

    def __init__(self, function: Callable[..., Tensor]):
        super().__init__()
        self.forward = function


def build(row: str) -> tuple[nn.Module, int]:
    """The network of a row, for use, and its number of parameters."""
    if row == "stss":
        return Called(TorchNetwork(weights := random(0))), sum(tensor.size for tensor in weights.values())
    network = rife() if row == "rife" else make(row.rpartition("+")[2]).eval()
    return Called(partial(between, network)) if row == "rife" else network, sum(tensor.numel() for tensor in network.parameters())


def inputs_of(row: str, width: int, height: int) -> Inputs:
    """Noise for a row whose output is ``width`` x ``height``; small frames are padded to multiples of 8, RIFE's to 128."""
    multiple, scale = 128 if row == "rife" else 8, 1 if "+" in row else 2
    w, h = (-(-n // (multiple * scale)) * multiple for n in (width, height))
    if row == "nsrr":
        return (torch.cat([torch.rand(1, PLANES, h, w), torch.randn(1, 2 * EARLIER, h, w)], 1),)
    history = (3, 4, h, w) if row == "stss" else (1, 3, 4, h, w)
    shapes = [(1, 6, h, w)] if row == "rife" else [(1, 6, h, w), (1, 9, h, w), (1, 1, h, w), history]
    return tuple(torch.rand(shape) for shape in shapes)


def runner(engine: str, network: nn.Module, inputs: Inputs, threads: int) -> Callable[[], Any]:
    """A function that computes the network with PyTorch or, in float32, with OpenVINO."""
    if engine == "openvino":
        openvino = require("openvino")
        options = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
        converted = openvino.convert_model(network, example_input=inputs)
        converted.reshape({port: list(x.shape) for port, x in zip(converted.inputs, inputs, strict=True)})
        compiled, arrays = openvino.Core().compile_model(converted, "CPU", options), [x.numpy() for x in inputs]
        return lambda: compiled(arrays)
    bound = tuple(x.contiguous(memory_format=torch.channels_last) if x.ndim == 4 else x for x in inputs)

    def run() -> Any:
        with torch.no_grad():
            return network(*bound)

    return run


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.cost``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.cost", description=__doc__)
    parser.add_argument("--size", nargs="+", default=["1280x720", "1920x1080"], metavar="WxH", help="of the output")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument("--engines", nargs="+", default=("pytorch", "openvino"))
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(chosen.threads)
    for size in chosen.size:
        runs: dict[str, Callable[[], object]] = {}
        for row in chosen.rows:
            network, parameters = build(row)
            inputs = inputs_of(row, *(int(n) for n in size.split("x")))
            with FlopCounterMode(display=False) as counter, torch.no_grad():
                network(*inputs)
            adds = counter.get_total_flops() / 2e9
            sys.stdout.write(f"{size} {row}: {parameters / 1e6:.3f} M parameters, {adds:.2f} G multiply-adds\n")
            runs |= {f"{row}, {engine}": runner(engine, network, inputs, chosen.threads) for engine in chosen.engines}
        times: dict[str, list[float]] = {key: [] for key in runs}
        for _ in range(chosen.repeat + 1):
            for key, run in runs.items():
                times[key].append(timeit(run, number=1) * 1e3)
        for key, (_, *found) in times.items():
            sys.stdout.write(f"{size} {key}: {min(found):.1f} / {statistics.median(found):.1f} ms\n")


if __name__ == "__main__":
    command(main)
