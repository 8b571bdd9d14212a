# SPDX-License-Identifier: MIT
"""The storage of activations: float, half or bfloat16, converted by the device's own instructions if it has them."""

from __future__ import annotations

import platform
from typing import Any

import numpy as np
import pyopencl as cl

from stss_cl.device import amx
from stss_cl.device.buffers import FLAGS, constant, storage
from stss_cl.device.discovery import Device, Properties
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_cl.device.proof import are_right
from stss_ground.machine import cpu_flags

LARGEST = 65504.0
"""Half's largest number; larger numbers are stored as this one."""


def storage_options(device: Device, dtype: np.dtype[Any]) -> dict[str, object]:
    """The options of kernels (kernels/common.clh) for activations of this dtype."""
    kind = storage(dtype)
    if kind == "BFLOAT16":
        return {"STORED": kind, "CONVERTS": "X86" if amx.are_used(device) else None}
    return {"STORED": kind, "CONVERTS": instructions(device) if kind == "HALF" and converts_half(device) else None}


def instructions(device: Properties) -> str | None:
    """The instructions that convert half, if the compiler knows them: x86-64's F16C, NVIDIA's; None: there are none."""
    if device.maker == "nvidia":
        return "PTX"
    return "X86" if device.is_pocl_processor and platform.machine() == "x86_64" and "f16c" in cpu_flags() else None


def converts_half(device: Device) -> bool:
    """Whether the device's own instructions convert half: a test found all conversions right."""
    kind = instructions(device)
    return kind is not None and are_right(device, "half", lambda: conversions_are_right(device, kind))


def conversions_are_right(device: Device, kind: str | None) -> bool:
    """Whether every half, numbers half-way between two or a little beside, and too large numbers are converted rightly by ``kind``."""
    halves = np.arange(0x7C00, dtype=np.uint16).view(np.float16).astype(np.float32)
    ties = (halves[:-1] + halves[1:]) / 2  # exact in float32
    positive = np.concatenate([halves, ties, np.nextafter(ties, 0), np.nextafter(ties, np.inf), [LARGEST + 16, 1e6, 3e38]])
    values = np.concatenate([positive, -positive]).astype(np.float32)
    values = np.pad(values, (0, -values.size % 8))
    narrowed, widened = np.empty(values.shape, np.uint16), np.empty(values.shape, np.float32)
    program = program_for(device, "convert_half.cl", {"STORED": "HALF", "CONVERTS": kind})
    results = [cl.Buffer(device.context, FLAGS.READ_WRITE, array.nbytes) for array in (narrowed, widened)]
    arguments = {"values": constant(device, values), "narrowed": results[0], "widened": results[1]}
    Kernel(program, "convert_half", arguments).enqueue(device.queue, (values.size // 8,), None)
    for array, result in zip((narrowed, widened), results, strict=True):
        cl.enqueue_copy(device.queue, array, result)
    nearest = np.clip(values, -LARGEST, LARGEST).astype(np.float16)
    right = (narrowed == nearest.view(np.uint16)) & (widened.view(np.uint32) == nearest.astype(np.float32).view(np.uint32))
    return bool(right.all())
