# SPDX-License-Identifier: MIT
"""Count and time the networks of each pipeline for display sizes: parameters, multiply-adds, milliseconds in PyTorch and OpenVINO."""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from types import MethodType
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from stss_ground.optional import require
from stss_ref.weights import TENSORS, Weights
from training.command import command
from training.network import Gated
from training.rivals.networks import EARLIER, PLANES
from training.rivals.train import make

Inputs = tuple[Tensor, ...]
ROWS = ("stss", "extranet", "nsrr", "extranet, large")
"""What is timed: `extranet, large` is the second stage of the swapped order."""


class Whole(nn.Module):
    """STSS by its yardstick in PyTorch, `stss_lab.bench.torch_network`, as a module."""

    def __init__(self):
        super().__init__()
        from stss_lab.bench.torch_network import TorchNetwork

        random = np.random.default_rng(0)
        tensors = {name: random.normal(0, 0.05, shape).astype(np.float32) for name, shape in TENSORS.items()}
        self._network = TorchNetwork(Weights(tensors))
        self.numbers = sum(tensor.size for tensor in tensors.values())

    def forward(self, color: Tensor, gbuffer: Tensor, mask: Tensor, history: Tensor) -> Tensor:
        """The image of (1, 6, H, W), (1, 9, H, W), (1, 1, H, W) and (3, 4, H, W)."""
        return self._network(color, gbuffer, mask, history)


def open_gate(self: Gated, x: Tensor) -> Tensor:
    """`Gated.forward` with the gate as one channel, as is fastest without gradients."""
    gate = cast(nn.Conv2d, self.conv_mask[0])
    weight, bias = torch.cat([self.conv_feature.weight, gate.weight]), torch.cat([bias_of(self.conv_feature), bias_of(gate)])
    y = nn.functional.conv2d(x, weight, bias, self.stride, 1)
    return y[:, :-1] * y[:, -1:].sigmoid()


def bias_of(convolution: nn.Conv2d) -> Tensor:
    """Its bias, which is there."""
    assert convolution.bias is not None
    return convolution.bias


def build(row: str) -> tuple[nn.Module, int]:
    """The network of a row, for use, and its number of parameters."""
    if row == "stss":
        whole = Whole()
        return whole.eval(), whole.numbers
    network = make(row.split(",", maxsplit=1)[0]).to(memory_format=torch.channels_last)
    for module in network.modules():
        if isinstance(module, Gated):
            module.forward = MethodType(open_gate, module)
    return network.eval(), sum(tensor.numel() for tensor in network.parameters())


def inputs_of(row: str, width: int, height: int) -> Inputs:
    """Noise for a row whose output is ``width`` x ``height``; small frames are padded to multiples of 8."""
    w, h = (-(-n // (8 * scale)) * 8 for scale in [1 if "large" in row else 2] for n in (width, height))
    if row == "nsrr":
        return (torch.cat([torch.rand(1, PLANES, h, w), torch.randn(1, 2 * EARLIER, h, w)], 1),)
    history = (3, 4, h, w) if row == "stss" else (1, 3, 4, h, w)
    shapes = [(1, 6, h, w), (1, 9, h, w), (1, 1, h, w), history]
    return tuple(torch.rand(shape) for shape in shapes)


def count(network: nn.Module, inputs: Inputs) -> float:
    """Multiply-adds, 10^9."""
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        network(*inputs)
    return counter.get_total_flops() / 2e9


def with_openvino(network: nn.Module, inputs: Inputs, threads: int) -> Callable[[], Any]:
    """A function that computes the network with OpenVINO in float32."""
    openvino = require("openvino")
    options = {"PERFORMANCE_HINT": "LATENCY", "INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": "f32"}
    converted = openvino.convert_model(network, example_input=inputs)
    converted.reshape({port: list(x.shape) for port, x in zip(converted.inputs, inputs, strict=True)})
    compiled = openvino.Core().compile_model(converted, "CPU", options)
    arrays = [x.numpy() for x in inputs]
    return lambda: compiled(arrays)


def with_pytorch(network: nn.Module, inputs: Inputs) -> Callable[[], Any]:
    """A function that computes the network with PyTorch."""
    bound = tuple(x.contiguous(memory_format=torch.channels_last) if x.ndim == 4 else x for x in inputs)

    def run() -> Any:
        with torch.inference_mode():
            return network(*bound)

    return run


def main(arguments: Sequence[str] | None = None) -> None:
    """``python -m training.rivals.cost``."""
    parser = argparse.ArgumentParser(prog="python -m training.rivals.cost", description=__doc__)
    parser.add_argument("--size", action="append", help="of the output, WxH; may be repeated")
    parser.add_argument("--rows", default=";".join(ROWS), help="some of them, separated by semicolons")
    parser.add_argument("--engines", default="pytorch,openvino")
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(chosen.threads)
    for size in chosen.size or ["1280x720", "1920x1080"]:
        width, height = (int(n) for n in size.split("x"))
        runs: dict[tuple[str, str], Callable[[], Any]] = {}
        for row in chosen.rows.split(";"):
            network, parameters = build(row)
            inputs = inputs_of(row, width, height)
            sys.stdout.write(f"{size} {row}: {parameters / 1e6:.3f} M parameters, {count(network, inputs):.2f} G multiply-adds\n")
            for engine in chosen.engines.split(","):
                runs[row, engine] = (
                    with_pytorch(network, inputs) if engine == "pytorch" else with_openvino(network, inputs, chosen.threads)
                )
        times: dict[tuple[str, str], list[float]] = {key: [] for key in runs}
        for turn in range(chosen.repeat + 1):
            for key, run in runs.items():
                begun = time.perf_counter()
                run()
                if turn:
                    times[key].append((time.perf_counter() - begun) * 1e3)
        for (row, engine), found in times.items():
            sys.stdout.write(f"{size} {row}, {engine}: {min(found):.1f} / {statistics.median(found):.1f} ms\n")
        sys.stdout.flush()


if __name__ == "__main__":
    command(main)
