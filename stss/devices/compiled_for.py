# SPDX-License-Identifier: MIT
"""Whether a processor's kernels use what it has, where the compiler may not know it: docs/devices.md."""

from __future__ import annotations

from stss_cl.device.discovery import Properties
from stss_ground.machine import cpu_flags

BASELINE = frozenset({"generic", "x86-64", "x86-64-v2"})
"""What LLVM calls x86-64 processors that it does not know, and its levels without AVX2."""
AVX2 = frozenset({
    *("x86-64-v3", "haswell", "broadwell", "skylake", "alderlake", "raptorlake"),
    *("znver1", "znver2", "znver3"),
})  # fmt: skip
"""Its names of processors with AVX2 and no AVX-512."""
REMEDY = (
    "another runtime may know it: pip install intel-opencl-rt intel-cmplr-lib-rt, "
    "OCL_ICD_VENDORS=<full path of libintelocl.so>, --device intel (docs/devices.md)"
)


def unused(target: str, flags: frozenset[str]) -> str:
    """The widest vectors that a processor has and kernels compiled for ``target`` do not use; empty where there are none, or none known."""
    for flag, name, without in (("avx512f", "AVX-512", BASELINE | AVX2), ("avx2", "AVX2", BASELINE)):
        if flag in flags and target in without:
            return name
    return ""


def remark(device: Properties, name: str) -> str:
    """A line for the user with what to do; empty where there is nothing to say.

    Args:
        device: any.
        name: as ``stss devices`` shows it.
    """
    left = unused(device.target, cpu_flags()) if device.kind == "CPU" else ""
    return left and f"{name}: kernels are compiled for {device.target} and do not use this processor's {left}; {REMEDY}"
