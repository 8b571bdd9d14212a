# SPDX-License-Identifier: MIT
"""NVIDIA's matrix units: whether a device has them, the order of their operands, and whether they compute as kernels/mma.clh assumes."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import FLAGS, constant
from stss_cl.device.discovery import Device, Properties
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_cl.device.proof import are_right

LANES, UNIT, PARTS, HELD = 32, 16, 4, 2
"""Work-items that multiply together, a wave; pixels of a product; ``PARTS`` x ``HELD`` outputs: a work-item has the sums of one part."""
WAVES = 64 // UNIT
"""Waves in a work-group."""
BYTES = 2 * 16 * PARTS * HELD
"""Of a product's weights, in half."""

_trial: ContextVar[bool | None] = ContextVar("_trial", default=None)


@contextmanager
def trial(there: bool) -> Generator[None]:
    """Within the block, and in this thread, every device has matrix units, or none has."""
    token = _trial.set(there)
    try:
        yield
    finally:
        _trial.reset(token)


def may_have(device: Properties) -> bool:
    """Whether the device may have matrix units: NVIDIA's GPUs; processors emulate them."""
    trial = _trial.get()
    return device.maker == "nvidia" or not device.is_gpu if trial is None else trial


def are_emulated(device: Device) -> bool:
    """Whether matrix units are emulated: on processors, where tests run the same code slowly."""
    return device.maker != "nvidia"


def arrange(weight: NDArray[Any]) -> NDArray[Any]:
    """Weights in the order in which work-items read them.

    Args:
        weight: (..., 16 channels, PARTS, HELD).

    Returns:
        (..., 16 * PARTS * HELD): channel c is 8 i + 2 q + j; work-items by output and q, each with all i and j.
    """
    before = weight.shape[:-3]
    weight = weight.reshape(*before, 2, 4, 2, PARTS, HELD)
    return weight.transpose(*range(len(before)), *(len(before) + i for i in (3, 4, 1, 0, 2))).reshape(*before, -1)


def prove(device: Device) -> bool:
    """Whether a test product is right to the last bit."""
    return may_have(device) and are_right(device, "matrix units", lambda: _product_is_right(device))


def _product_is_right(device: Device) -> bool:
    random = np.random.default_rng(0)
    pixels, weight = (random.integers(-8, 9, size).astype(np.float16) for size in ((UNIT, 16), (16, PARTS, HELD)))
    want = 1 + pixels.astype(np.float32) @ weight.astype(np.float32).reshape(16, -1)
    got = np.empty((WAVES, *want.shape), np.float32)
    output = cl.Buffer(device.context, FLAGS.WRITE_ONLY, got.nbytes)
    inputs = constant(device, np.ascontiguousarray(pixels.reshape(UNIT, 2, 8).swapaxes(0, 1)))
    program = program_for(device, "matrix.cl", {"STORED": "HALF", "EMULATE": are_emulated(device)})
    size = LANES, WAVES
    arguments = {"pixels": inputs, "weight": constant(device, arrange(weight)), "d": output}
    Kernel(program, "matrix", arguments).enqueue(device.queue, size, size)
    cl.enqueue_copy(device.queue, got, output)
    return bool((got == want).all())
