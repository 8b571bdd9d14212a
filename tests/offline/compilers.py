"""Compilers for GPUs that run anywhere: clang with libclc, behind it ptxas for NVIDIA; Intel's ocloc. Drivers have others."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

from stss_cl.device.discovery import MAKERS_OPTIONS

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


class Compiled(NamedTuple):
    """One kernel for one target: registers of a work-item; bytes of its stack, and spilled; local memory of a group."""

    registers: int
    stack: int
    spilled: int
    local: int


@cache
def clang() -> str:
    """The newest installed clang."""
    names = [os.environ.get("CLANG", ""), *(f"clang-{version}" for version in range(OLDEST + 8, OLDEST - 1, -1))]
    program = next((path for name in names if name and (path := shutil.which(name))), None)
    if program is None:
        raise MissingError(f"clang-{OLDEST} or newer: apt-get install clang-{OLDEST}, or set CLANG")
    if not (BUILTINS / SIGNATURE["gfx"][2]).exists():
        raise MissingError(f"libclc in {BUILTINS}: apt-get install libclc-{OLDEST}, or set LIBCLC")
    return program


@cache
def ptxas() -> str:
    """NVIDIA's assembler, of its wheel or on the path."""
    spec = importlib.util.find_spec("nvidia")
    places = spec.submodule_search_locations or () if spec else ()
    programs = [str(path) for place in places for path in sorted(Path(place).glob("*/bin/ptxas"), reverse=True)]
    if path := next(iter(programs), None) or shutil.which("ptxas"):
        return path
    raise MissingError("ptxas: pip install nvidia-cuda-nvcc")


def ocloc() -> str:
    """Intel's compiler, ``$OCLOC`` or on the path."""
    if path := shutil.which(os.environ.get("OCLOC", "ocloc")):
        return path
    raise MissingError("ocloc: apt-get install intel-opencl-icd, or set OCLOC")


def is_intel(target: str) -> bool:
    """Whether it is one of Intel's, which ocloc compiles for."""
    return not target.startswith(("sm_", "gfx"))


def require(target: str) -> None:
    """Raise `MissingError` if not all that a target needs is there: ``sm_90``, ``gfx1100``, or a device that ocloc knows: ``dg2``."""
    if is_intel(target):
        ocloc()
        return
    clang()
    if target.startswith("sm_"):
        ptxas()


def compiled(source: str, options: Sequence[str], kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    """The ``kernels`` of one program in OpenCL C; ``folder`` is for intermediate files.

    Raises:
        CompileError: with the compiler's first error.
    """
    if is_intel(target):
        return _intel(source, options, kernels, target, folder)
    triple, processor, builtins = SIGNATURE["sm" if target.startswith("sm_") else "gfx"]
    text, assembly = folder / "k.cl", folder / "k.s"
    text.write_text((SQUARE_ROOT if target.startswith("sm_") else "") + source, encoding="utf-8")
    more = ["-finclude-default-header", "-mlink-builtin-bitcode", str(BUILTINS / builtins)]
    output = _run(
        [
            clang(), "-x", "cl", triple, f"{processor}{target}", "-nogpulib", "-O3", *options, "-w",
            *(part for option in more for part in ("-Xclang", option)),
            "-Wno-linker-warnings", "-Rpass-analysis=kernel-resource-usage", "-S", str(text), "-o", str(assembly),
        ]
    )  # fmt: skip
    if target.startswith("sm_"):
        return _nvidia(assembly, kernels, target, folder)
    return {kernel: _amd(output, kernel) for kernel in kernels}


def _nvidia(assembly: Path, kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    output = _run([ptxas(), f"-arch={target}", "-v", str(assembly), "-o", str(folder / "k.cubin")])
    parts = {kernel: output.split(f"entry function '{kernel}'", 1)[-1].split("Compile time", 1)[0] for kernel in kernels}
    words = r"Used (\d+) registers", r"(\d+) bytes stack frame", r"(\d+) bytes spill stores", r"(\d+) bytes smem"
    return {kernel: Compiled(*(_number(pattern, part) for pattern in words)) for kernel, part in parts.items()}


def _amd(output: str, kernel: str) -> Compiled:
    part = output.split(f"Function Name: {kernel} ", 1)[-1].split("Function Name:", 1)[0]
    words = "VGPRs", r"ScratchSize \[bytes/lane\]", "VGPRs Spill", r"LDS Size \[bytes/block\]"
    return Compiled(*(_number(rf"{name}: (\d+)", part) for name in words))


def _intel(source: str, options: Sequence[str], kernels: Sequence[str], target: str, folder: Path) -> dict[str, Compiled]:
    text, listings = folder / "k.cl", folder / "listings"
    text.write_text(source, encoding="utf-8")
    options_text = " ".join([*options, *MAKERS_OPTIONS["intel"].split()])
    shutil.rmtree(listings, ignore_errors=True)
    listings.mkdir()
    _run(
        [ocloc(), "compile", "-file", str(text), "-device", target, "-out_dir", str(folder), "-options", options_text],
        {"IGC_ShaderDumpEnable": "1", "IGC_DumpToCustomDir": f"{listings}/"},
    )
    usage = intel_kernels(listings)
    if missing := [kernel for kernel in kernels if kernel not in usage]:
        raise CompileError(f"ocloc: no listing of {', '.join(missing)}")
    return {kernel: usage[kernel] for kernel in kernels}


def intel_kernels(listings: Path) -> dict[str, Compiled]:
    """What IGC, which ocloc calls, wrote into a folder. Registers have 32 bytes, and are as many as the compiler was told.

    A kernel that spilled may be compiled once more, in another way: only what runs has a description.
    """
    kernels_of: dict[str, Compiled] = {}
    for path in sorted(listings.glob("*.asm")):
        text, description = path.read_text(encoding="utf-8", errors="replace"), path.with_suffix(".cos")
        if (kernel := re.search(r"^//\.kernel (\w+)", text, re.MULTILINE)) and description.exists():
            details = description.read_text(encoding="utf-8", errors="replace")
            kernels_of[kernel[1]] = Compiled(
                registers=_number(r"numGRF=(\d+)", text),
                stack=_number(r"PerThreadPrivateMemorySize\s*= (\d+)", details),
                spilled=_number(r"//\.spill size (\d+)", text),
                local=_number(r"TotalInlineLocalMemorySize\s*= (\d+)", details),
            )
    return kernels_of


def _number(pattern: str, text: str) -> int:
    match = re.search(pattern, text)
    return int(match[1]) if match else 0


def _run(command: list[str], more: Mapping[str, str] | None = None) -> str:
    environment = {**os.environ, **(more or {})}
    try:
        process = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=False, env=environment)
    except subprocess.TimeoutExpired:
        raise CompileError(f"{Path(command[0]).name}: no end after {LIMIT} s") from None
    output = process.stdout + process.stderr
    if process.returncode:
        wrong = [line for line in output.splitlines() if "error" in line] or [f"status {process.returncode}"]
        raise CompileError(f"{Path(command[0]).name}: {wrong[0]}")
    return output
