# SPDX-License-Identifier: MIT
"""Choose an OpenCL device; every question about a device is answered here."""

from __future__ import annotations

import hashlib
import os
import re
from collections import Counter
from functools import cached_property
from typing import Literal, get_args

import pyopencl as cl
from pyopencl.tools import ImmediateAllocator, MemoryPool

from stss_cl.device.caches import pocl_cache
from stss_cl.device.generated_code import generate_once
from stss_cl.errors import DeviceError

__all__ = [
    "CLASSES",
    "NO_DEVICE",
    "Device",
    "DeviceError",
    "Properties",
    "found",
    "full_name",
    "is_gpu",
    "matching",
    "named",
    "open_device",
    "open_handle",
]

NO_DEVICE = "no OpenCL device: pip install 'pyopencl[pocl]' gives one that runs on any CPU"

generate_once()

_process: list[int] = []
"""The process that first used OpenCL, once there is one: what a driver starts then does not survive a fork."""


DeviceClass = Literal["cpu", "gpu"]
CLASSES: tuple[DeviceClass, ...] = get_args(DeviceClass)
"""``cpu``: work-items of a group run one after the other, and memory is the host's. ``gpu``: neither."""


MAKERS = {"nvidia": ("nvidia",), "amd": ("advanced micro devices", "amd"), "intel": ("intel",)}
"""Parts of what devices say of their vendor."""


class Properties:
    """What a device says of itself, without opening it.

    Args:
        handle: pyopencl's device.
        device_class: of ``CLASSES``, as which it is treated whatever it is; None: ``$STSS_DEVICE_CLASS``, or else what it is.

    Attributes:
        handle: pyopencl's device.
        device_class: decides host code, work-groups and the tuning row. Any device gives right results as either.

    Raises:
        DeviceError: there is no such class.
    """

    def __init__(self, handle: cl.Device, device_class: str | None = None):
        self.handle = handle
        self.device_class: DeviceClass = _class_of(handle, device_class)

    @property
    def name(self) -> str:
        """``platform: device``, as ``--device`` takes it."""
        return full_name(self.handle)

    @property
    def is_cpu(self) -> bool:
        """Whether it is treated as a processor, see ``device_class``."""
        return self.device_class == "cpu"

    @property
    def is_gpu(self) -> bool:
        """Whether it is a graphics processor."""
        return is_gpu(self.handle)

    @property
    def kind(self) -> str:
        """``GPU``, ``CPU`` or ``other``."""
        return "GPU" if self.is_gpu else "CPU" if self.handle.type & cl.device_type.CPU else "other"

    @property
    def maker(self) -> str:
        """``nvidia``, ``amd``, ``intel``: whose tile sizes it takes; an empty text where it is no GPU, or not treated as one."""
        if self.is_cpu or not self.is_gpu:
            return ""
        vendor = str(self.handle.vendor).lower()
        return next((name for name, told in MAKERS.items() if any(part in vendor for part in told)), "")

    @property
    def has_fp16(self) -> bool:
        """Whether kernels may compute in ``half``; loading and storing it needs no leave."""
        return "cl_khr_fp16" in self.handle.extensions.split()

    @property
    def has_fp64(self) -> bool:
        """Whether kernels may use ``double``."""
        return "cl_khr_fp64" in self.handle.extensions.split()

    @property
    def takes_prefetch(self) -> bool:
        """Whether its compiler takes ``__builtin_prefetch``: those of rusticl 22.3 and Oclgrind 21.10 end the process."""
        return not self.name.startswith(("rusticl:", "Oclgrind:"))

    @property
    def correctly_rounded_divide(self) -> bool:
        """Whether it takes ``-cl-fp32-correctly-rounded-divide-sqrt``; without, a quotient may err by 2.5 ulp."""
        return bool(self.handle.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)

    @property
    def local_memory(self) -> int:
        """Bytes of ``local`` memory a work-group may use; ask before a launch, PoCL ends the process where it is exceeded."""
        return int(self.handle.local_mem_size)

    @property
    def max_work_group(self) -> int:
        """Most work-items in a work-group; a kernel may allow fewer."""
        return int(self.handle.max_work_group_size)

    @property
    def compute_units(self) -> int:
        """How many work-groups it computes side by side, at least."""
        return int(self.handle.max_compute_units)

    @property
    def memory(self) -> int:
        """Bytes of global memory; of a CPU, what the machine has."""
        return int(self.handle.global_mem_size)

    @property
    def driver(self) -> str:
        """The driver's version."""
        return _one_line(self.handle.driver_version)

    @property
    def target(self) -> str:
        """The processor that kernels are compiled for, in LLVM's words, with which PoCL ends the device's version; empty where untold."""
        found = re.search(r"-(?:gnu|musl|darwin[\d.]*|msvc)-(\S+)$", _one_line(self.handle.version))
        return found[1] if found else ""

    @property
    def platform_version(self) -> str:
        """The platform's version; that of PoCL names the LLVM it compiles with."""
        return _one_line(self.handle.platform.version)


class Device(Properties):
    """An OpenCL device with its context and one in-order queue; of use only in the process that opened it."""

    def __init__(self, handle: cl.Device, context: cl.Context, queue: cl.CommandQueue, device_class: str | None = None):
        super().__init__(handle, device_class)
        self._context = context
        self._queue = queue
        self._process = os.getpid()

    @property
    def context(self) -> cl.Context:
        """A context of this device alone."""
        _require_same_process(self._process)
        return self._context

    @property
    def queue(self) -> cl.CommandQueue:
        """An in-order command queue."""
        _require_same_process(self._process)
        return self._queue

    @cached_property
    def pool(self) -> MemoryPool:
        """Memory for arrays that are handed out: that of one the caller has dropped serves the next, page faults and all."""
        return MemoryPool(ImmediateAllocator(self.queue))


def full_name(handle: cl.Device) -> str:
    """``platform: device`` with inner runs of blanks removed."""
    return _one_line(f"{handle.platform.name}: {handle.name}")


def is_gpu(handle: cl.Device) -> bool:
    """Whether it is a graphics processor; Oclgrind calls itself everything at once and is not one."""
    return bool(handle.type & cl.device_type.GPU) and not handle.type & cl.device_type.CPU


def _class_of(handle: cl.Device, named: str | None) -> DeviceClass:
    what, wanted = ("device_class", named) if named is not None else ("STSS_DEVICE_CLASS", os.environ.get("STSS_DEVICE_CLASS"))
    if wanted is None:
        return "cpu" if handle.type & cl.device_type.CPU else "gpu"
    for known in CLASSES:
        if wanted == known:
            return known
    raise DeviceError(f"{what}: expected one of {', '.join(CLASSES)}, got {wanted!r}")


def found() -> list[cl.Device]:
    """Every device of every platform, sorted by name: the loader's order is not stable.

    Raises:
        DeviceError: the process is a fork of one that used OpenCL, or the kernel cache is not safe.
    """
    if not _process:
        _process.append(os.getpid())
    _require_same_process(_process[0])
    with pocl_cache("unknown"):  # should a version of PoCL look for its devices this early
        try:
            platforms = cl.get_platforms()
        except cl.Error:
            return []
    handles: list[cl.Device] = []
    for platform in platforms:
        with pocl_cache(hashlib.sha256(platform.version.encode()).hexdigest()[:16]):
            try:
                handles += platform.get_devices()
            except cl.Error:
                continue  # a platform without devices says so by an error
    return sorted(handles, key=full_name)


def named() -> dict[str, cl.Device]:
    """Every device of ``found()`` by a name of its own: where names are equal, the second has `` #2`` after it, and so on."""
    seen: Counter[str] = Counter()
    devices: dict[str, cl.Device] = {}
    for handle in found():
        name = full_name(handle)
        seen[name] += 1
        devices[name if seen[name] == 1 else f"{name} #{seen[name]}"] = handle
    return devices


def matching(name: str | None) -> dict[str, cl.Device]:
    """The devices whose name, or else whose platform's version, holds ``name``, case ignored; None: all.

    A name in full means that device alone. The version serves ``pocl``, which calls itself Portable Computing Language.

    Raises:
        DeviceError: there is none.
    """
    devices = named()
    if not devices:
        raise DeviceError(NO_DEVICE)
    wanted = "" if name is None else _one_line(name).lower()
    for fitting in (
        {n: h for n, h in devices.items() if n.lower() == wanted},
        {n: h for n, h in devices.items() if wanted in n.lower()},
        {n: h for n, h in devices.items() if wanted in h.platform.version.lower()},
    ):
        if fitting:
            return fitting
    raise DeviceError(f"device {name!r}: expected part of one of {', '.join(devices)}")


def open_device(name: str | None = None, device_class: str | None = None) -> Device:
    """Open the device whose ``platform: device`` holds ``name``, case ignored.

    Args:
        name: part of the name; None: ``$STSS_DEVICE``, or else the first GPU, or else the first device.
        device_class: see ``Properties``.

    Raises:
        DeviceError: there is none, or it cannot be opened.
    """
    fitting = list(matching(os.environ.get("STSS_DEVICE") if name is None else name).values())
    return open_handle(next(filter(is_gpu, fitting), fitting[0]), device_class)


def open_handle(handle: cl.Device, device_class: str | None = None) -> Device:
    """Open a device of ``found()``; ``device_class``: see ``Properties``.

    Raises:
        DeviceError: the driver refuses.
    """
    try:
        context = cl.Context([handle])
        return Device(handle, context, cl.CommandQueue(context), device_class)
    except cl.Error as error:
        raise DeviceError(f"device {full_name(handle)}: cannot be opened: {_one_line(str(error))}") from None


def _require_same_process(process: int) -> None:
    if process != os.getpid():
        raise DeviceError(
            f"OpenCL was opened in process {process}, this is {os.getpid()}: it does not survive a fork; "
            "use multiprocessing's spawn"
        )


def _one_line(text: str) -> str:
    return " ".join(text.split())
