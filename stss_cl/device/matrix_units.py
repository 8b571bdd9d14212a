# SPDX-License-Identifier: MIT
"""Whether a device has matrix units, and whether they compute what our kernels assume (kernels/mma.clh)."""

from __future__ import annotations

from contextlib import suppress
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import FLAGS, constant
from stss_cl.device.discovery import Device
from stss_cl.device.program import build
from stss_cl.errors import DeviceError

_proved: WeakKeyDictionary[cl.Context, bool] = WeakKeyDictionary()


def are_emulated(device: Device) -> bool:
    """Whether matrix units are emulated: on all devices but NVIDIA's, where tests run the same code slowly."""
    return device.maker != "nvidia"


def proved(device: Device) -> bool:
    """Whether one product came out right to the last bit; tested once for each context."""
    if device.context not in _proved:
        right = False
        with suppress(DeviceError, cl.Error):  # older ones: their compiler does not know the instruction
            right = _product_is_right(device)
        _proved[device.context] = right
    return _proved[device.context]


def _product_is_right(device: Device) -> bool:
    random = np.random.default_rng(0)
    a, b = (random.integers(-8, 9, size).astype(np.float16) for size in ((16, 16), (16, 8)))
    lane, number = np.arange(32)[:, None], np.arange(8)
    rows, columns = lane // 4 + 8 * (number // 2 % 2), 2 * (lane % 4) + number % 2 + 8 * (number // 4)
    held_a, held_b = a[rows, columns], b[columns[:, [0, 1, 4, 5]], lane // 4]
    want = 1 + (a.astype(np.float32) @ b.astype(np.float32))[rows[:, :4], 2 * (lane % 4) + number[:4] % 2]
    made, got = cl.Buffer(device.context, FLAGS.WRITE_ONLY, 4 * want.nbytes), np.empty((4, *want.shape), np.float32)
    kernel = cl.Kernel(build(device, "matrix.cl", {"HALF": True, "EMULATE": are_emulated(device)}), "matrix")
    kernel(device.queue, (32, 4), (32, 4), constant(device, held_a), constant(device, held_b), made)
    cl.enqueue_copy(device.queue, got, made)
    return bool((got == want).all())
