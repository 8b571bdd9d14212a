# SPDX-License-Identifier: MIT
"""Whether a processor's kernels use what it has, where the compiler may not know it: docs/devices.md."""

from __future__ import annotations

from stss_cl.device.discovery import Properties
from stss_ground.machine import cpu_flags

AVX2 = frozenset({"haswell", "broadwell", "skylake", "alderlake", "raptorlake", "znver1", "znver2", "znver3", "x86-64-v3"})
"""LLVM's names of processors with AVX2 and no AVX-512; for those that it does not know see ``stss_cl.device.known_processor``."""
REMEDY = (
    "another runtime may know it: pip install intel-opencl-rt intel-cmplr-lib-rt, "
    "OCL_ICD_VENDORS=<full path of libintelocl.so>, --device intel (docs/devices.md)"
)


def remark(device: Properties, name: str) -> str:
    """A line for the user with what to do; empty where there is nothing to say.

    Args:
        device: any.
        name: as ``stss devices`` shows it.
    """
    unused = device.kind == "CPU" and device.target in AVX2 and "avx512f" in cpu_flags()
    return f"{name}: kernels are compiled for {device.target} and do not use this processor's AVX-512; {REMEDY}" * unused
