# SPDX-License-Identifier: MIT
"""Matrix units of processors (Intel's AMX): whether this one has them, may use them, and computes rightly (kernels/amx.clh)."""

from __future__ import annotations

import ctypes
import os
import platform
from functools import cache

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import FLAGS, constant, from_bfloat16, to_bfloat16
from stss_cl.device.discovery import Device, Properties
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_cl.device.proof import are_right
from stss_ground.machine import cpu_flags

CPU_FLAGS = frozenset({"amx_tile", "amx_bf16", "avx512_bf16", "avx512vl"})
"""Flags of a processor with tiles that multiply bfloat16, and with conversions to it; Linux lists a flag only if its kernel supports it."""
ARCH_PRCTL, REQUEST_PERMISSION, TILE_DATA = 158, 0x1023, 18
"""Linux's system call on x86-64 with which a process requests the tiles' 8 KiB of state, once for all its threads."""


def missing(device: Properties) -> str:
    """The reason to emulate products of bfloat16 on this device; "" if none is known before a test."""
    if device.kind != "CPU" or not device.is_cpu:
        return "no processor"
    if platform.machine() != "x86_64" or not cpu_flags() >= CPU_FLAGS:
        return "the processor has no matrix units for bfloat16 (AMX)"
    if not device.is_pocl_processor:  # Intel's refuses the assembler, Oclgrind's ends the process
        return "the runtime's compiler takes no assembler of matrix units (AMX); PoCL's does"
    return "" if request_tiles() else "the system refuses its matrix units (AMX)"


def are_used(device: Device) -> bool:
    """Whether products run on matrix units: a test product was right to the last bit."""
    return not missing(device) and are_right(device, "amx", lambda: product_is_right(device, emulate=False))


def why_emulated(device: Device) -> str:
    """The reason why products of bfloat16 are emulated; "" if they are not."""
    return missing(device) or ("" if are_used(device) else "a product of its matrix units (AMX) was wrong, or did not build")


@cache
def request_tiles() -> bool:
    """Ask Linux for the tiles; it refuses them to a process with a thread whose signal stack is too small."""
    if os.name != "posix":
        return False
    return ctypes.CDLL(None).syscall(ARCH_PRCTL, REQUEST_PERMISSION, TILE_DATA) == 0


def product_is_right(device: Device, *, emulate: bool) -> bool:
    """Whether a test product has the right bits."""
    random = np.random.default_rng(0)
    a, b = (to_bfloat16(random.normal(size=size)) for size in ((16, 32), (16, 16, 2)))
    bias = random.normal(size=16).astype(np.float32)
    return bool((product(device, bias, a, b, emulate=emulate) == multiply(np.broadcast_to(bias, (16, 16)), a, b)).all())


def product(device: Device, bias: np.ndarray, a: np.ndarray, b: np.ndarray, *, emulate: bool) -> np.ndarray:
    """``bias`` (16) + ``a`` (16, 32) ``b`` (16, 16, 2), as the device computes it."""
    got = np.empty((16, 16), np.float32)
    output = cl.Buffer(device.context, FLAGS.WRITE_ONLY, got.nbytes)
    program = program_for(device, "matrix_amx.cl", {"EMULATE": emulate})
    inputs = {name: constant(device, array) for name, array in {"a": a, "b": b, "bias": bias}.items()}
    Kernel(program, "matrix_amx", {**inputs, "sums": output}).enqueue(device.queue, (1,), (1,))
    cl.enqueue_copy(device.queue, got, output)
    return got


def multiply(sums: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``sums`` (P, 16) + ``a`` (P, 32) ``b`` (16, 16, 2), with the units' roundings.

    Even and odd places have separate sums; each product is added with one rounding, and subnormal numbers are 0. Source: Intel's Software
    Developer's Manual, TDPBF16PS.
    """
    wide = [from_bfloat16(x).astype(np.float64) for x in (a, b)]
    partial = np.zeros((*sums.shape, 2), np.float32)
    for k in range(16):  # products are exact in float64; sums of 16 and 24 bits, rounded twice, are as if rounded once
        partial = flush(partial + wide[0][:, None, 2 * k : 2 * k + 2] * wide[1][k])
    return flush(flush(sums) + flush(partial[..., 0] + partial[..., 1]))


def flush(numbers: np.ndarray) -> np.ndarray:
    """In float32, with 0 in place of subnormal numbers."""
    rounded = numbers.astype(np.float32)
    return np.where(np.abs(rounded) < np.finfo(np.float32).tiny, np.copysign(np.float32(0), rounded), rounded)
