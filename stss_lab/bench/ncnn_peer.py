# SPDX-License-Identifier: MIT
"""ncnn as a peer: the network is traced by PyTorch, translated by pnnx and computed by ncnn on the CPU."""

from __future__ import annotations

import subprocess
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from stss_ground.errors import InputError
from stss_ground.machine import versions
from stss_ground.optional import require
from stss_lab.bench.contender import Peer, Setup
from stss_lab.bench.torch_network import TorchNetwork
from stss_ref.arrays import Array
from stss_ref.weights import Weights

INPUTS = {"color": (6,), "gbuffer": (9,), "mask": (1,), "history": (4, 4, 4)}
"""Channels of each input's images. ncnn has no batches, so the three images of the history are three inputs."""


class _OneByOne(TorchNetwork):
    """The history's images one after the other, as an engine without batches needs them."""

    def _history(self, x: Any) -> Any:
        for name in ("convHis1", "convHis2", "convHis3"):
            x = [self._chain(image, name, (2, 1, 1)) for image in x]
        return self._gated(self._torch.cat(x, 1), "lowlevelGated")


class Ncnn(Peer):
    """ncnn in float32 on the CPU; its default would store bfloat16 or half.

    Args:
        setup: weights, size and threads.
    """

    def __init__(self, setup: Setup):
        super().__init__(setup)
        self._ncnn: Any = require("ncnn")
        self._net = self._ncnn.Net()
        options = self._net.opt
        options.num_threads, options.use_vulkan_compute = setup.threads, False
        for kind in ("fp16_packed", "fp16_storage", "fp16_arithmetic", "bf16_storage"):
            setattr(options, f"use_{kind}", False)
        with TemporaryDirectory(prefix="stss-") as folder:
            _translate(setup.weights, -(-setup.height // 8) * 8, -(-setup.width // 8) * 8, Path(folder))
            if self._net.load_param(f"{folder}/net.ncnn.param") or self._net.load_model(f"{folder}/net.ncnn.bin"):
                raise InputError("ncnn does not read what pnnx has written: other versions of the two may fit together")
        self.details = {
            **versions(("ncnn", "pnnx")),
            "precision": "float32",
            "formulation": "gates merged, window as slices",
            "threads": str(setup.threads),
        }

    def _bind(self, inputs: dict[str, Array]) -> None:
        images = [image for name in INPUTS for image in inputs[name]]
        # ncnn uses the arrays in place and does not own them, so we must.
        self._inputs = [(name, self._ncnn.Mat(image), image) for name, image in zip(self._net.input_names(), images, strict=True)]

    def run(self) -> None:
        """See `Contender`."""
        extractor = self._net.create_extractor()
        for name, image, _ in self._inputs:
            extractor.input(name, image)
        fault, self._image = extractor.extract(self._net.output_names()[0])
        if fault:
            raise InputError(f"ncnn ends with {fault}")

    def _result(self) -> Array:
        return np.array(self._image)[None]


def _translate(weights: Weights, height: int, width: int, folder: Path) -> None:
    """Write ``net.ncnn.param`` and ``net.ncnn.bin`` for images of one size into a folder."""
    torch, pnnx = require("torch"), require("pnnx")
    network = _OneByOne(weights, tuned=True)

    class Traced(torch.nn.Module):
        def forward(self, color: Any, gbuffer: Any, mask: Any, *history: Any) -> Any:
            return network(color, gbuffer, mask, history)

    zeros = tuple(torch.zeros(1, channels, height, width) for each in INPUTS.values() for channels in each)
    with torch.inference_mode(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of traces; they are what pnnx reads
        torch.jit.trace(Traced().eval(), zeros, check_trace=False).save(f"{folder}/net.pt")
    words = [pnnx.EXEC_PATH, "net.pt", "fp16=0"]
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    if done.returncode or not (folder / "net.ncnn.bin").exists():
        raise InputError(f"pnnx ends with {done.returncode}: {(done.stderr.strip() or done.stdout.strip())[-200:]}")
