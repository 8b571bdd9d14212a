# SPDX-License-Identifier: MIT
"""Calls of shaders: written down first, then played on a WebGPU device, here by wgpu-py or in a browser (page.py)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FOLDER = Path(__file__).parent
FOLLOWING = ("motion_chain", "warp", "holes", "detail", "occlusion_warp", "reshade", "accumulate")
SURFACES = ("holes", "reshade")


@dataclass(frozen=True)
class Picture:
    """A buffer of float32 (height, width, channels), by its number in `Calls.buffers`."""

    buffer: int
    height: int
    width: int
    channels: int


@dataclass
class Calls:
    """The calls to be run.

    Attributes:
        buffers: the first content of each, or only its number of numbers: 0 at first.
        calls: file and entry point, work-groups, the uniform's integers, the buffer of each binding.
    """

    buffers: list[NDArray[Any] | int] = field(default_factory=list)
    calls: list[tuple[str, tuple[int, int, int], Sequence[int], dict[int, int]]] = field(default_factory=list)

    def put(self, array: NDArray[Any]) -> Picture:
        """A picture (H, W) or (H, W, C); a mask becomes 0.0 and 1.0."""
        self.buffers.append(np.ascontiguousarray(array, np.float32))
        height, width = array.shape[:2]
        return Picture(len(self.buffers) - 1, height, width, array.size // (height * width))

    def empty(self, height: int, width: int, channels: int = 1) -> Picture:
        """A new picture of zeros."""
        self.buffers.append(height * width * channels)
        return Picture(len(self.buffers) - 1, height, width, channels)

    def add(self, entry: str, over: Picture, depth: int, uniform: Sequence[int], bindings: Mapping[int, Picture]) -> None:
        """Run ``file.entry`` once for each pixel of ``over`` and each of ``depth`` channels."""
        groups = -(-over.width // 8), -(-over.height // 8), depth
        self.calls.append((entry, groups, uniform, {i: picture.buffer for i, picture in bindings.items()}))

    def play(self, results: Sequence[Picture]) -> list[NDArray[Any]]:
        """Run all, and read some pictures."""
        gpu, usage = device(), "STORAGE|COPY_SRC"
        buffers = [
            gpu.create_buffer(size=4 * b, usage=usage) if isinstance(b, int) else gpu.create_buffer_with_data(data=b, usage=usage)
            for b in self.buffers
        ]
        encoder = gpu.create_command_encoder()
        for entry, groups, uniform, bindings in self.calls:
            numbers = gpu.create_buffer_with_data(
                data=np.array([*uniform, *[0] * (12 - len(uniform))], np.int32), usage="UNIFORM"
            )
            bound = {0: numbers} | {i: buffers[b] for i, b in bindings.items()}
            entries = [{"binding": i, "resource": {"buffer": buffer}} for i, buffer in bound.items()]
            compute = encoder.begin_compute_pass()
            compute.set_pipeline(pipeline(entry))
            compute.set_bind_group(0, gpu.create_bind_group(layout=pipeline(entry).get_bind_group_layout(0), entries=entries))
            compute.dispatch_workgroups(*groups)
            compute.end()
        gpu.queue.submit([encoder.finish()])
        pictures = [
            np.frombuffer(gpu.queue.read_buffer(buffers[r.buffer]), "f4").reshape(r.height, r.width, r.channels) for r in results
        ]
        for buffer in buffers:
            buffer.destroy()
        return pictures


def code(file: str) -> str:
    """The text of a shader, behind the functions for motions and surfaces that it needs; WGSL has no #include."""
    files = ["follow"] * (file in FOLLOWING) + ["surface"] * (file in SURFACES) + [file]
    return "\n".join((FOLDER / f"{name}.wgsl").read_text(encoding="utf-8") for name in files)


@cache
def device() -> Any:
    """The best device that there is, with buffers as large as it allows; opened once. RuntimeError where there is none."""
    import wgpu

    adapter = wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    large = ("max-buffer-size", "max-storage-buffer-binding-size")
    return adapter.request_device_sync(required_limits={name: adapter.limits[name] for name in large})


@cache
def pipeline(entry: str) -> Any:
    """An entry point, compiled once."""
    file, name = entry.split(".")
    module = device().create_shader_module(code=code(file))
    return device().create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": name})
