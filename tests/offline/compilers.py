"""Compilers for GPUs that run anywhere: clang with libclc, behind it ptxas for NVIDIA; Intel's ocloc. Drivers have others."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from stss_cl.device.program import MAKERS_OPTIONS
from tests.offline import intel

BUILTINS = Path(os.environ.get("LIBCLC", "/usr/lib/clc"))
OLDEST = 22
"""Oldest version of clang and libclc: in older ones libclc has no work-item functions for AMD."""
LIMIT = 900
"""Seconds for one program, which takes a compiler one or two."""
SIGNATURE = {
    "sm": ("--target=nvptx64-unknown-nvcl", "-march=", "nvptx64--nvidiacl.bc"),
    "gfx": ("--target=amdgcn-amd-amdhsa", "-mcpu=", "amdgcn-amd-amdhsa.bc"),
}

SQUARE_ROOT = "float __nv_sqrtf(float x) { return __nvvm_sqrt_rn_f(x); }\n"
"""The function that libclc calls from CUDA's own library, which is not installed."""


class MissingError(Exception):
    """A compiler is missing; the message says which one, and how to get it."""


class CompileError(Exception):
    """A kernel does not compile."""


@dataclass(frozen=True)
class Compiled:
    """One kernel for one target.

    Attributes:
        registers: of a work-item.
        stack: bytes of private memory; spilled: bytes or registers that had no room.
        local: bytes of a work-group.
    """

    registers: int
    stack: int
    spilled: int
    local: int


@cache
def clang() -> str:
    """The newest installed clang.

    Raises:
        MissingError: it, or libclc.
    """
    names = [os.environ.get("CLANG", ""), *(f"clang-{version}" for version in range(OLDEST + 8, OLDEST - 1, -1))]
    found = next((path for name in names if name and (path := shutil.which(name))), None)
    if found is None:
        raise MissingError(f"clang-{OLDEST} or newer: apt-get install clang-{OLDEST}, or set CLANG")
    if not (BUILTINS / SIGNATURE["gfx"][2]).exists():
        raise MissingError(f"libclc in {BUILTINS}: apt-get install libclc-{OLDEST}, or set LIBCLC")
    return found


@cache
def ptxas() -> str:
    """NVIDIA's assembler, of its wheel or on the path.

    Raises:
        MissingError: it is not there.
    """
    spec = importlib.util.find_spec("nvidia")
    for place in spec.submodule_search_locations or () if spec else ():
        for path in sorted(Path(place).glob("*/bin/ptxas"), reverse=True):
            return str(path)
    if path := shutil.which("ptxas"):
        return path
    raise MissingError("ptxas: pip install nvidia-cuda-nvcc")


def ocloc() -> str:
    """Intel's compiler, ``$OCLOC`` or on the path.

    Raises:
        MissingError: it is not there.
    """
    if path := shutil.which(os.environ.get("OCLOC", "ocloc")):
        return path
    raise MissingError("ocloc: apt-get install intel-opencl-icd, or set OCLOC")


def is_intel(target: str) -> bool:
    """Whether it is one of Intel's, which ocloc compiles for."""
    return not target.startswith(("sm_", "gfx"))


def require(target: str) -> None:
    """Ask for all that a target needs: ``sm_90``, ``gfx1100``, or a device that ocloc knows, such as ``dg2``.

    Raises:
        MissingError: something is not there.
    """
    if is_intel(target):
        ocloc()
        return
    clang()
    if target.startswith("sm_"):
        ptxas()


def compiled(source: str, options: Sequence[str], kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    """Compile one program.

    Args:
        source: OpenCL C.
        options: of the build.
        kernels: whose code is looked at.
        target: ``sm_90``, ``gfx1100``, ``dg2`` or the like.
        folder: for intermediate files.

    Raises:
        CompileError: with the compiler's first error.
    """
    if is_intel(target):
        return _intel(source, options, kernels, target, folder)
    triple, processor, builtins = SIGNATURE["sm" if target.startswith("sm_") else "gfx"]
    text, assembly = folder / "k.cl", folder / "k.s"
    text.write_text((SQUARE_ROOT if target.startswith("sm_") else "") + source, encoding="utf-8")
    more = ["-finclude-default-header", "-mlink-builtin-bitcode", str(BUILTINS / builtins)]
    told = _run(
        [
            clang(), "-x", "cl", triple, f"{processor}{target}", "-nogpulib", "-O3", *options, "-w",
            *(part for option in more for part in ("-Xclang", option)),
            "-Wno-linker-warnings", "-Rpass-analysis=kernel-resource-usage", "-S", str(text), "-o", str(assembly),
        ]
    )  # fmt: skip
    if target.startswith("sm_"):
        return _nvidia(assembly, kernels, target, folder)
    return {kernel: _amd(told, kernel) for kernel in kernels}


def _nvidia(assembly: Path, kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    binary = folder / "k.cubin"
    told = _run([ptxas(), f"-arch={target}", "-v", str(assembly), "-o", str(binary)])
    found: dict[str, Compiled] = {}
    for kernel in kernels:
        part = told.split(f"entry function '{kernel}'", 1)[-1].split("Compile time", 1)[0]

        def number(pattern: str, part: str = part) -> int:
            match = re.search(pattern, part)
            return int(match[1]) if match else 0

        found[kernel] = Compiled(
            registers=number(r"Used (\d+) registers"),
            stack=number(r"(\d+) bytes stack frame"),
            spilled=number(r"(\d+) bytes spill stores"),
            local=number(r"(\d+) bytes smem"),
        )
    return found


def _amd(told: str, kernel: str) -> Compiled:
    part = told.split(f"Function Name: {kernel} ", 1)[-1].split("Function Name:", 1)[0]

    def number(name: str) -> int:
        match = re.search(rf"{name}: (\d+)", part)
        return int(match[1]) if match else 0

    return Compiled(
        registers=number("VGPRs"),
        stack=number(r"ScratchSize \[bytes/lane\]"),
        spilled=number("VGPRs Spill"),
        local=number(r"LDS Size \[bytes/block\]"),
    )


def _intel(source: str, options: Sequence[str], kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    text, listings = folder / "k.cl", folder / "listings"
    text.write_text(source, encoding="utf-8")
    told = " ".join([*options, *MAKERS_OPTIONS["intel"].split()])
    shutil.rmtree(listings, ignore_errors=True)
    listings.mkdir()
    _run(
        [ocloc(), "compile", "-file", str(text), "-device", target, "-out_dir", str(folder), "-options", told],
        {"IGC_ShaderDumpEnable": "1", "IGC_DumpToCustomDir": f"{listings}/"},
    )
    found = intel.listings(listings)
    if missing := [kernel for kernel in kernels if kernel not in found]:
        raise CompileError(f"ocloc: no listing of {', '.join(missing)}")
    return {kernel: Compiled(**intel.figures(*found[kernel])) for kernel in kernels}


def _run(command: list[str], more: Mapping[str, str] | None = None) -> str:
    environment = {**os.environ, **(more or {})}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False, env=environment)
    except subprocess.TimeoutExpired:
        raise CompileError(f"{Path(command[0]).name}: no end after {LIMIT} s") from None
    told = done.stdout + done.stderr
    if done.returncode:
        wrong = [line for line in told.splitlines() if "error" in line] or [f"status {done.returncode}"]
        raise CompileError(f"{Path(command[0]).name}: {wrong[0]}")
    return told
