# SPDX-License-Identifier: MIT
"""The OpenCL devices of this machine, and which of them computes."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass

import pyopencl as cl
from rich.console import Console
from rich.table import Table

from stss.devices.verdicts import Tell, Verdict, verdict
from stss.weights.file import REALTIME
from stss_cl.device import amx
from stss_cl.device.discovery import Device, Properties, is_gpu, matching, name_devices, no_device, open_handle
from stss_ground.errors import DeviceError
from stss_ground.machine import cpu_flags

AVX2 = frozenset({"haswell", "broadwell", "skylake", "alderlake", "raptorlake", "znver1", "znver2", "znver3", "x86-64-v3"})
"""LLVM's names of processors with AVX2 and no AVX-512; for unknown ones see ``stss_cl.device.pocl_processor``."""


@dataclass(frozen=True)
class Row:
    """One device as ``stss devices`` shows it.

    ``memory`` in bytes; ``bfloat16``: AMX, or emulated; ``target``: the processor that kernels are compiled for, empty if unknown;
    ``remark``: a line of advice, or empty.
    """

    name: str
    kind: str
    driver: str
    platform: str
    memory: int
    fp16: bool
    bfloat16: str
    target: str
    remark: str
    verdict: Verdict


def choose(name: str | None = None, tell: Tell = lambda line: None, *, trial: str = REALTIME) -> Device:
    """Open the fastest device that passed its self-test, GPUs before all others.

    Args:
        name: part of the device's name; None: ``$STSS_DEVICE``, or any device without it.
        trial: the weights of the self-test, of `stss.devices.trial.TRIALS`.
        tell: called with a line for every self-test that runs now, and for every GPU that did not pass.

    Raises:
        DeviceError: there is no such device, or none that passed; ``STSS_TRUST_DEVICE=1`` skips self-tests.
    """
    devices = matching(os.environ.get("STSS_DEVICE") if name is None else name)
    gpus = {n: h for n, h in devices.items() if is_gpu(h)}
    others = {n: h for n, h in devices.items() if n not in gpus}
    if os.environ.get("STSS_TRUST_DEVICE") == "1":
        return open_handle(next(iter((gpus or others).values())))

    refusals: list[str] = []
    verdicts: dict[str, Verdict] = {}
    for group in (gpus, others):
        verdicts |= {n: verdict(n, h, trial=trial, tell=tell) for n, h in group.items()}
        passed = [n for n in group if verdicts[n].passed]
        refusals += [f"{n} {verdicts[n]}" for n in group if n not in passed]
        if passed:
            for line in refusals:
                tell(f"not used: {line}")
            return open_handle(devices[max(passed, key=lambda n: verdicts[n].gflops)])
    anew = "stss devices --again" if all(verdicts[n].lasting for n in verdicts) else "the next start"
    raise DeviceError(f"self-test: {'; '.join(refusals)}: {anew} tests again, STSS_TRUST_DEVICE=1 uses a device without a test")


def rows(*, again: bool = False, tell: Tell = lambda line: None) -> list[Row]:
    """Every device with its verdict, in the order in which ``choose`` tries them.

    Args:
        again: test even where a verdict is stored.
        tell: called with a line for every self-test that is run now.

    Raises:
        DeviceError: there is no device.
    """
    entries = [_row(n, h, verdict(n, h, again=again, tell=tell)) for n, h in name_devices().items()]
    if not entries:
        raise DeviceError(no_device())
    return sorted(entries, key=lambda row: (row.kind != "GPU", not row.verdict.passed, -row.verdict.gflops))


def to_json(entries: list[Row]) -> str:
    """A list of objects, one for each device."""
    return json.dumps([asdict(row) for row in entries], indent=2)


def print_rows(entries: list[Row], console: Console) -> None:
    """Print a table, and the remarks; names are never cut off, since ``--device`` takes them."""
    table = Table(box=None, pad_edge=False)
    table.add_column("device", overflow="fold")
    for title in ("kind", "driver", "compiled for", "memory", "fp16", "bfloat16", "self-test"):
        table.add_column(title, overflow="fold", justify="right" if title == "memory" else "left")
    for row in entries:
        speed = f" ({row.verdict.gflops:.0f} GFLOP/s)" if row.verdict.passed else ""
        memory = f"{row.memory / 2**30:.1f} GiB"
        fp16 = "yes" if row.fp16 else "no"
        table.add_row(row.name, row.kind, row.driver, row.target or "-", memory, fp16, row.bfloat16, f"{row.verdict}{speed}")
    console.print(table, markup=False, highlight=False)
    for row in entries:
        if row.remark:
            console.print(row.remark, soft_wrap=True, markup=False, highlight=False)


def _row(name: str, handle: cl.Device, outcome: Verdict) -> Row:
    device = Properties(handle)
    return Row(
        name=name,
        kind=device.kind,
        driver=device.driver,
        platform=device.platform_version,
        memory=device.memory,
        fp16=device.has_fp16,
        bfloat16="emulated" if amx.missing(device) else "AMX",
        target=device.target,
        remark=(
            f"{name}: kernels are compiled for {device.target} and do not use this processor's AVX-512; another runtime may know it: pip "
            "install intel-opencl-rt intel-cmplr-lib-rt, OCL_ICD_VENDORS=<full path of libintelocl.so>, --device intel (docs/devices.md)"
            if device.kind == "CPU" and device.target in AVX2 and "avx512f" in cpu_flags()
            else ""
        ),
        verdict=outcome,
    )
