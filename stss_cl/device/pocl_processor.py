# SPDX-License-Identifier: MIT
"""Name a processor for PoCL's compiler, if the processor is newer than the compiler.

LLVM 14, in the wheel's PoCL 3.0, calls Zen 5 ``generic``, which its own front end refuses: no kernel builds. PoCL reads the name from its
record of the device whenever it compiles. So the name of an older processor replaces it there; this processor has all instructions of
that one.
"""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache

import pyopencl as cl

from stss_ground.machine import cpu_flags

UNKNOWN = "generic"
AVX2 = frozenset({"avx", "avx2", "fma", "bmi1", "bmi2", "f16c", "movbe", "abm"})
AVX512 = AVX2 | {"avx512f", "avx512cd", "avx512bw", "avx512dq", "avx512vl"}
ICE_LAKE = AVX512 | {
    *("avx512ifma", "avx512vbmi", "avx512_vbmi2", "avx512_vnni", "avx512_bitalg", "avx512_vpopcntdq"),
    *("gfni", "vaes", "vpclmulqdq", "sha_ni"),
}
PROCESSORS = (("icelake-client", ICE_LAKE), ("skylake-avx512", AVX512), ("haswell", AVX2), ("x86-64", frozenset[str]()))
"""Names, the best first, and the features that such a processor must have, by Linux's names, since the compiler uses all of them."""
RECORD = 2048
"""Bytes of a device's record that are searched for the name; in PoCL 3.0 it is at 640."""

given_names: dict[int, ctypes.Array[ctypes.c_char]] = {}
"""The new name, by the address of the device's record; it must live as long as the process."""


@cache
def substitute() -> str:
    """A name to use for this processor if its own is unknown; "" on a system that cannot list its instructions."""
    flags = cpu_flags()
    return next(name for name, features in PROCESSORS if flags >= features) if flags and sys.platform == "linux" else ""


def name_processor(handle: cl.Device) -> None:
    """Let PoCL compile for ``substitute()`` if its compiler does not know the processor."""
    if not handle.version.rstrip().endswith(f"-{UNKNOWN}") or not substitute() or handle.int_ptr in given_names:
        return
    for place in range(handle.int_ptr, handle.int_ptr + RECORD, 8):
        pointer = int.from_bytes(read_memory(place, 8), "little")
        if pointer and read_memory(pointer, len(UNKNOWN) + 1) == UNKNOWN.encode() + b"\0":
            given_names[handle.int_ptr] = name = ctypes.create_string_buffer(substitute().encode())
            ctypes.c_void_p.from_address(place).value = ctypes.addressof(name)
            return


def given_name(handle: cl.Device) -> str:
    """The name that the processor was given; "" if it has its own."""
    name = given_names.get(getattr(handle, "int_ptr", 0))
    return name.value.decode() if name else ""


class _Piece(ctypes.Structure):
    _fields_ = (("start", ctypes.c_void_p), ("size", ctypes.c_size_t))


def read_memory(address: int, size: int) -> bytes:
    """Memory of this process, read through the system, which refuses a wrong address; empty in that case."""
    buffer = ctypes.create_string_buffer(size)
    pieces = (ctypes.byref(_Piece(where, size)) for where in (ctypes.addressof(buffer), address))
    got = ctypes.CDLL(None).process_vm_readv(os.getpid(), next(pieces), 1, next(pieces), 1, 0)
    return buffer.raw if got == size else b""
