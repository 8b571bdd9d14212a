# SPDX-License-Identifier: MIT
"""A temporal upsampler of FSR 3's kind that others made: the shaders of github.com/pmndrs/upscaler (MIT), run by `wgpu`.

They are read from a checkout that is fetched to be measured, never copied. Their README says where they are simpler than AMD's: one
reduction in place of the luminance pyramid, variance clipping, no scatter of the depth. Settings are their defaults: accumulation 24,
locks, shading changes, auto-exposure. Their sharpening is left out, for it ends in a film's curve that the truth does not have.
A texture of depth cannot be written by the host, so depth is a texture of numbers here.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from stss_ground.errors import InputError
from stss_ground.optional import require
from stss_ref.arrays import Array, Image
from training.rivals.jittered import Jittered

RESET, LOCKS, AUTO_EXPOSURE, SHADING_CHANGE = 1, 32, 64, 128
"""Bits of their constant ``flags``; not perspective: depth is linear already."""
ACCUMULATION, RATE = 24, 60
CHUNK = re.compile(r"/\* wgsl \*/ `(.*?)`", re.S)
NAMED = re.compile(r"export const (\w+) = /\* wgsl \*/ `(.*?)`", re.S)


def shader(folder: Path, name: str) -> str:
    """The text of a pass: the chunks of ``common.ts`` that it lists, and its own.

    Raises:
        InputError: the folder is no checkout of theirs.
    """
    try:
        common, own = ((folder / "src" / "shaders" / f"{file}.ts").read_text(encoding="utf-8") for file in ("common", name))
    except OSError as error:
        raise InputError(f"{folder}: expected a checkout of github.com/pmndrs/upscaler ({error.strerror})") from error
    listed = own.partition("assembleShader(")[2].partition("/* wgsl */")[0]
    chunks = [text for word, text in NAMED.findall(common) if word in listed]
    text = "\n".join([*chunks, CHUNK.findall(own)[-1]])
    text = text.replace("texture_depth_2d", "texture_2d<f32>")
    return re.sub(r"(textureLoad\(sceneDepth, \w+, 0\))", r"\1.r", text)


class WgslUpscaler:
    """Their passes exposure, reconstruct and accumulate; an `training.rivals.jittered.Upsampler`.

    Args:
        folder: a checkout of github.com/pmndrs/upscaler.

    Raises:
        InputError: wgpu is not installed, there is no adapter, or the folder is no checkout.
    """

    PASSES = ("luminancePyramid", "reconstruct", "accumulate")

    def __init__(self, folder: Path):
        self._wgpu = require("wgpu")
        try:
            self._device = self._wgpu.gpu.request_adapter_sync().request_device_sync()
        except RuntimeError as error:
            raise InputError(f"wgpu: no adapter ({error}); a software Vulkan such as lavapipe or SwiftShader will do") from error
        self._pipelines = {name: self._compile(name, shader(folder, name)) for name in self.PASSES}
        self._textures: dict[str, Any] = {}
        self._size, self._turn = (0, 0), 0
        self._sampler = self._device.create_sampler(mag_filter="linear", min_filter="linear")

    def _compile(self, name: str, code: str) -> Any:
        module = self._device.create_shader_module(code=code, label=name)
        return self._device.create_compute_pipeline(layout="auto", compute={"module": module, "entry_point": "main"})

    def __call__(self, frame: Jittered) -> Image:
        """See `training.rivals.jittered.Upsampler`."""
        height, width, _ = frame.color.shape
        if self._size != (height, width):
            self._size, self._textures = (height, width), self._allocate(height, width)
        now, then = self._turn, 1 - self._turn
        self._turn = then
        self._write("color", _half(frame.color))
        self._write("velocity", _half(-frame.motion / np.array((width, height), np.float32)))
        self._write("depth", frame.depth.astype(np.float32))
        constants = self._device.create_buffer_with_data(data=self._constants(frame), usage="UNIFORM")
        t, sampler = self._textures, self._sampler
        groups = {
            "luminancePyramid": [t["color"], sampler, t[f"exposure{then}"], t[f"exposure{now}"], t["nothing"]],
            "reconstruct": [t["depth"], t["velocity"], t[f"depth{then}"], t[f"depth{now}"], t["motion"], t["masks"]],
            "accumulate": [
                *(t["color"], t["motion"], t["masks"], t[f"history{then}"], sampler, t[f"history{now}"]),
                *(t[f"locks{then}"], t[f"locks{now}"], t[f"exposure{now}"], t["nothing"]),
            ],
        }
        encoder = self._device.create_command_encoder()
        for name, size in zip(self.PASSES, ((8, 8), (width, height), (2 * width, 2 * height)), strict=True):
            self._encode(encoder, name, [{"buffer": constants}, *groups[name]], size)
        self._device.queue.submit([encoder.finish()])
        exposure = float(self._read(f"exposure{now}", 1, 1)[0, 0, 0])
        history = self._read(f"history{now}", 2 * height, 2 * width)[..., :3]
        largest = np.minimum(history.max(axis=-1, keepdims=True), 0.999)
        return history / (1 - largest) / np.float32(max(exposure, 1e-4))

    def _encode(self, encoder: Any, name: str, resources: list[Any], size: tuple[int, int]) -> None:
        pipeline = self._pipelines[name]
        views = [r.create_view() if hasattr(r, "create_view") else r for r in resources]
        entries = [{"binding": i, "resource": view} for i, view in enumerate(views)]
        group = self._device.create_bind_group(layout=pipeline.get_bind_group_layout(0), entries=entries)
        step = encoder.begin_compute_pass()
        step.set_pipeline(pipeline)
        step.set_bind_group(0, group)
        step.dispatch_workgroups(-(-size[0] // 8), -(-size[1] // 8))
        step.end()

    def _constants(self, frame: Jittered) -> bytes:
        height, width = self._size
        flags = LOCKS | AUTO_EXPOSURE | SHADING_CHANGE | (RESET if frame.first else 0)
        floats = [width, height, 2 * width, 2 * height, 1 / width, 1 / height, 0.5 / width, 0.5 / height]
        # Theirs is the camera's shift, ours the picture's.
        floats += [-v for v in (*frame.offset, *frame.before)] + [1, 1, 0, 1, 0, ACCUMULATION, 1, 1 / RATE]
        return np.array(floats, np.float32).tobytes() + np.array([flags, 0, 0, 0], np.uint32).tobytes()

    def _allocate(self, height: int, width: int) -> dict[str, Any]:
        small, large, one = (width, height, 1), (2 * width, 2 * height, 1), (1, 1, 1)
        kinds = {"color": (small, "rgba16float"), "velocity": (small, "rgba16float"), "depth": (small, "r32float")}
        kinds |= {"motion": (small, "rgba16float"), "masks": (small, "rgba8unorm"), "nothing": (one, "rgba16float")}
        for i in (0, 1):
            kinds |= {f"history{i}": (large, "rgba16float"), f"locks{i}": (large, "rgba16float")}
            kinds |= {f"depth{i}": (small, "r32float"), f"exposure{i}": (one, "rgba16float")}
        usage = self._wgpu.TextureUsage
        every = usage.TEXTURE_BINDING | usage.STORAGE_BINDING | usage.COPY_DST | usage.COPY_SRC
        return {
            name: self._device.create_texture(size=size, format=kind, usage=every, label=name)
            for name, (size, kind) in kinds.items()
        }

    def _write(self, name: str, planes: Array) -> None:
        height, width = planes.shape[:2]
        layout = {"bytes_per_row": planes.strides[0], "rows_per_image": height}
        self._device.queue.write_texture({"texture": self._textures[name]}, planes, layout, (width, height, 1))

    def _read(self, name: str, height: int, width: int) -> Image:
        layout = {"bytes_per_row": 8 * width, "rows_per_image": height}
        raw = self._device.queue.read_texture({"texture": self._textures[name]}, layout, (width, height, 1))
        return np.frombuffer(raw, np.float16).reshape(height, width, 4).astype(np.float32)


def _half(planes: Image) -> Array:
    """(H, W, 4) float16; missing channels are 0."""
    height, width, channels = planes.shape
    padded = np.zeros((height, width, 4), np.float16)
    padded[..., :channels] = planes.clip(-65504, 65504)
    return padded
