# SPDX-License-Identifier: MIT
"""Choose an OpenCL device, and query its properties."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import sys
from collections import Counter
from functools import cache, cached_property
from typing import Literal, get_args

import pyopencl as cl
from pyopencl.tools import ImmediateAllocator, MemoryPool

from stss_cl.device.caches import pocl_cache
from stss_cl.device.generated_code import generate_once
from stss_cl.device.kernel_files import mend
from stss_cl.device.linker import provide
from stss_cl.device.pocl_processor import given_name, name_processor, substitute
from stss_ground.errors import DeviceError
from stss_ground.machine import container_memory

__all__ = [
    "CLASSES",
    "Device",
    "Properties",
    "find_devices",
    "full_name",
    "is_gpu",
    "matching",
    "name_devices",
    "no_device",
    "open_device",
    "open_handle",
]


CHOICES = "OCL_ICD_VENDORS", "OCL_ICD_FILENAMES", "OPENCL_VENDOR_PATH", "POCL_DEVICES", "POCL_CACHE_DIR"
"""Variables by which loaders and PoCL are told which runtimes and devices there are, and where PoCL may write; a wrong one hides all."""


def no_device() -> str:
    """The message if there is no device: how to install one on this platform."""
    if chosen := [f"{name}={os.environ[name]}" for name in CHOICES if os.environ.get(name)]:
        cure = f"{' and '.join(chosen)} may hide it: run without"
    elif sys.platform == "linux" and platform.machine() == "x86_64":
        cure = "pip install 'pyopencl[pocl]' gives one that runs on any processor"
    elif sys.platform == "win32":
        cure = "a graphics driver, Intel's OpenCL runtime or conda-forge's pocl (conda env create -f environment.yml) gives one"
    else:
        cure = "conda-forge's pocl gives one that runs on any processor (conda env create -f environment.yml)"
    return f"no OpenCL device: {cure}; --backend ref needs none and takes about 10 s for a million pixels"


generate_once()
_first_process = cache(os.getpid)
"""The process that first used OpenCL; a driver's threads do not survive a fork."""

DeviceClass = Literal["cpu", "gpu"]
CLASSES: tuple[DeviceClass, ...] = get_args(DeviceClass)
"""``cpu``: work-items of a group run one after the other, and memory is the host's. ``gpu``: neither holds."""

MAKERS = {"nvidia": ("nvidia",), "amd": ("advanced micro devices", "amd"), "intel": ("intel",)}
"""Maker -> parts of the vendor's name in the device's properties."""
MAKERS_OPTIONS = {"intel": "-D static= -D inline="}
"""Options for a maker's GPUs; "" for other devices. Where a function is static, Intel's compiler of 2022 unrolls no loop as it is told,
and keeps arrays in memory."""


class Properties:
    """A device's properties, queried without opening it.

    Args:
        handle: pyopencl's device.
        device_class: of ``CLASSES``, to treat the device as that class; None: ``$STSS_DEVICE_CLASS``, or the device's own class.

    Attributes:
        handle: pyopencl's device.
        device_class: decides host code, work-groups and the tuning row. Any device gives right results as either class.

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
        """Whether it is treated as a CPU, see ``device_class``."""
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
        """``nvidia``, ``amd`` or ``intel``, which chooses tile sizes; "" if it is not a GPU, or not treated as one."""
        if self.is_cpu or not self.is_gpu:
            return ""
        vendor = str(self.handle.vendor).lower()
        return next((name for name, marks in MAKERS.items() if any(part in vendor for part in marks)), "")

    @property
    def compiler_options(self) -> str:
        """Options for all programs that are built for it."""
        return MAKERS_OPTIONS.get(self.maker, "")

    @property
    def has_fp16(self) -> bool:
        """Whether kernels may compute in ``half``; all devices can load and store it."""
        return "cl_khr_fp16" in self.handle.extensions.split()

    @property
    def takes_prefetch(self) -> bool:
        """Whether its compiler accepts ``__builtin_prefetch``: not NVIDIA's; those of rusticl 22.3 and Oclgrind 21.10 crash."""
        return self.kind == "CPU" and not self.name.startswith(("rusticl:", "Oclgrind:"))

    @property
    def is_pocl_processor(self) -> bool:
        """Whether its compiler is Clang for this very processor, which takes ``__builtin_nontemporal_store`` and assembler of vectors."""
        return self.is_cpu and self.name.startswith("Portable Computing Language:")

    @property
    def correctly_rounded_divide(self) -> bool:
        """Whether it accepts ``-cl-fp32-correctly-rounded-divide-sqrt``; without it a quotient may be wrong by 2.5 ulp."""
        return bool(self.handle.single_fp_config & cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT)

    @property
    def local_memory(self) -> int:
        """Bytes of ``local`` memory that a work-group may use; check it before a launch, since PoCL ends the process at more."""
        return int(self.handle.local_mem_size)

    @property
    def max_work_group(self) -> int:
        """Most work-items in a work-group; a kernel may allow fewer."""
        return int(self.handle.max_work_group_size)

    @property
    def compute_units(self) -> int:
        """Least number of work-groups that it computes at the same time."""
        return int(self.handle.max_compute_units)

    @property
    def memory(self) -> int:
        """Bytes of global memory; for a CPU the machine's memory, or the part of it that the process's container may take."""
        memory, limit = int(self.handle.global_mem_size), None if self.is_gpu else container_memory()
        return memory if limit is None else min(memory, limit)

    @property
    def driver(self) -> str:
        """The driver's version."""
        return _one_line(self.handle.driver_version)

    @property
    def target(self) -> str:
        """LLVM's name of the processor that kernels are compiled for, from the end of PoCL's device version; "" if unknown."""
        match = re.search(r"-(?:gnu|musl|darwin[\d.]*|msvc)-(\S+)$", _one_line(self.handle.version))
        return given_name(self.handle) or (match[1] if match else "")

    @property
    def platform_version(self) -> str:
        """The platform's version; PoCL's also names its LLVM."""
        return _one_line(self.handle.platform.version)


class Device(Properties):
    """An OpenCL device with its context and one in-order queue; usable only in the process that opened it."""

    def __init__(self, handle: cl.Device, context: cl.Context, queue: cl.CommandQueue, device_class: str | None = None):
        super().__init__(handle, device_class)
        self._context = context
        self._queue = queue
        self._process = os.getpid()

    @property
    def context(self) -> cl.Context:
        """A context of this device alone."""
        self.require_same_process()
        return self._context

    @property
    def queue(self) -> cl.CommandQueue:
        """An in-order command queue."""
        self.require_same_process()
        return self._queue

    def require_same_process(self) -> None:
        """Raise DeviceError in a fork of the process that opened the device."""
        _require_same_process(self._process)

    @cached_property
    def pool(self) -> MemoryPool:
        """Memory for arrays that go to the caller: a dropped array's memory is used again, which saves page faults."""
        return MemoryPool(ImmediateAllocator(self.queue))


def full_name(handle: cl.Device) -> str:
    """``platform: device`` with inner runs of blanks removed."""
    return _one_line(f"{handle.platform.name}: {handle.name}")


def is_gpu(handle: cl.Device) -> bool:
    """Whether it is a graphics processor; Oclgrind claims all types at once and does not count."""
    return bool(handle.type & cl.device_type.GPU) and not handle.type & cl.device_type.CPU


def _class_of(handle: cl.Device, choice: str | None) -> DeviceClass:
    what, word = ("device_class", choice) if choice is not None else ("STSS_DEVICE_CLASS", os.environ.get("STSS_DEVICE_CLASS"))
    if word is None:
        return "cpu" if handle.type & cl.device_type.CPU else "gpu"
    for each in CLASSES:
        if word == each:
            return each
    raise DeviceError(f"{what}: expected one of {', '.join(CLASSES)}, got {word!r}")


def find_devices() -> list[cl.Device]:
    """Every device of every platform, sorted by name: the loader's order is not stable.

    Raises:
        DeviceError: the process is a fork of one that used OpenCL, the kernel cache is not safe, or ``$STSS_LINKER`` has an unknown value.
    """
    _require_same_process(_first_process())
    provide()
    with pocl_cache("unknown"):  # since a version of PoCL may look for its devices this early
        try:
            platforms = cl.get_platforms()
        except cl.Error:
            return []
    handles: list[cl.Device] = []
    for runtime in platforms:
        with pocl_cache(hashlib.sha256((runtime.version + substitute()).encode()).hexdigest()[:16]) as folder:
            mend(folder)
            try:
                handles += runtime.get_devices()
            except cl.Error:
                continue  # a platform without devices raises an error
    for handle in handles:
        name_processor(handle)
    return sorted(handles, key=full_name)


def name_devices() -> dict[str, cl.Device]:
    """Every device of ``find_devices()`` by a unique name: of equal names the second gets the suffix `` #2``, and so on."""
    counts: Counter[str] = Counter()
    devices: dict[str, cl.Device] = {}
    for handle in find_devices():
        counts[name := full_name(handle)] += 1
        devices[name if counts[name] == 1 else f"{name} #{counts[name]}"] = handle
    return devices


def matching(name: str | None) -> dict[str, cl.Device]:
    """The devices whose name contains ``name``, or else whose platform's version does, ignoring case; None: all devices.

    A full name selects only that device. The version is searched because ``pocl`` is not in the name of PoCL's platform, Portable
    Computing Language.

    Raises:
        DeviceError: no device fits.
    """
    devices = name_devices()
    if not devices:
        raise DeviceError(no_device())
    part = "" if name is None else _one_line(name).lower()
    for fitting in (
        {n: h for n, h in devices.items() if n.lower() == part},
        {n: h for n, h in devices.items() if part in n.lower()},
        {n: h for n, h in devices.items() if part in h.platform.version.lower()},
    ):
        if fitting:
            return fitting
    raise DeviceError(f"device {name!r}: expected part of one of {', '.join(devices)}")


def open_device(name: str | None = None, device_class: str | None = None, *, timed: bool = False) -> Device:
    """Open the device whose ``platform: device`` contains ``name``, ignoring case.

    Args:
        name: part of the name; None: ``$STSS_DEVICE``, or else the first GPU, or else the first device.
        device_class: see ``Properties``.
        timed: its events tell when commands began and ended.

    Raises:
        DeviceError: there is none, or it cannot be opened.
    """
    fitting = list(matching(os.environ.get("STSS_DEVICE") if name is None else name).values())
    return open_handle(next(filter(is_gpu, fitting), fitting[0]), device_class, timed=timed)


def open_handle(handle: cl.Device, device_class: str | None = None, *, timed: bool = False) -> Device:
    """Open a device of ``find_devices()``; arguments as of ``open_device``.

    Raises:
        DeviceError: the driver refuses.
    """
    try:
        context = cl.Context([handle])
        properties = cl.command_queue_properties.PROFILING_ENABLE
        queue = cl.CommandQueue(context, properties=properties) if timed else cl.CommandQueue(context)
        return Device(handle, context, queue, device_class)
    except cl.Error as error:
        raise DeviceError(f"device {full_name(handle)}: cannot be opened: {_one_line(str(error))}") from None


def _require_same_process(process: int) -> None:
    if process != (now := os.getpid()):
        raise DeviceError(
            f"OpenCL was opened in process {process}, this is {now}: it does not survive a fork; use multiprocessing's spawn"
        )


def _one_line(text: str) -> str:
    return " ".join(text.split())
