# SPDX-License-Identifier: MIT
"""A WebGPU device, its buffers and dispatches, by wgpu-py: each call has its namesake in JavaScript's ``navigator.gpu``."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import wgpu  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

FOLDER = Path(__file__).parent


@cache
def device() -> Any:
    """The best device that there is; it is opened once. RuntimeError where there is none."""
    return wgpu.gpu.request_adapter_sync(power_preference="high-performance").request_device_sync()


@cache
def pipeline(files: tuple[str, ...], entry: str) -> Any:
    """The entry point of some .wgsl files, which are put together; compiled once."""
    code = "\n".join((FOLDER / name).read_text(encoding="utf-8") for name in files)
    module = device().create_shader_module(code=code)
    return device().create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": entry})


def uniform(*numbers: int) -> Any:
    """A struct of integers; uniform buffers are multiples of 16 bytes."""
    padded = np.zeros(-(-len(numbers) // 4) * 4, np.int32)
    padded[: len(numbers)] = numbers
    return device().create_buffer_with_data(data=padded, usage="UNIFORM")


def uploaded(array: NDArray[Any]) -> Any:
    """A buffer with these numbers."""
    return device().create_buffer_with_data(data=np.ascontiguousarray(array), usage="STORAGE")


def empty(count: int) -> Any:
    """A buffer for so many numbers of 4 bytes."""
    return device().create_buffer(size=4 * count, usage="STORAGE|COPY_SRC")


class Pass:
    """Dispatches one after the other, sent to the device together."""

    def __init__(self):
        self._encoder = device().create_command_encoder()

    def dispatch(self, compiled: Any, groups: tuple[int, int, int], buffers: Mapping[int, Any]) -> None:
        """Run an entry point on ``groups`` work-groups; ``buffers`` by their binding."""
        entries = [{"binding": i, "resource": {"buffer": buffer}} for i, buffer in buffers.items()]
        group = device().create_bind_group(layout=compiled.get_bind_group_layout(0), entries=entries)
        compute = self._encoder.begin_compute_pass()
        compute.set_pipeline(compiled)
        compute.set_bind_group(0, group)
        compute.dispatch_workgroups(*groups)
        compute.end()

    def read(self, buffer: Any, dtype: str, shape: tuple[int, ...]) -> NDArray[Any]:
        """Submit, wait, and read a buffer."""
        device().queue.submit([self._encoder.finish()])
        self._encoder = device().create_command_encoder()
        return np.frombuffer(device().queue.read_buffer(buffer), dtype).reshape(shape).copy()


def tiles(width: int, height: int, depth: int = 1) -> tuple[int, int, int]:
    """Work-groups of 8 x 8 that cover a frame."""
    return -(-width // 8), -(-height // 8), depth
