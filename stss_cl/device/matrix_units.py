# SPDX-License-Identifier: MIT
"""Whether a device has matrix units, how they want their operands, and whether they compute what our kernels assume (kernels/mma.clh)."""

from __future__ import annotations

import re
from collections.abc import Generator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from stss_cl.device.buffers import FLAGS, constant
from stss_cl.device.discovery import Device, Properties
from stss_cl.device.program import build
from stss_ground.errors import DeviceError


@dataclass(frozen=True)
class Form:
    """One form of matrix units: a product of pixels x 16 channels by 16 channels x outputs.

    Attributes:
        name, value: the option of ``kernels/mma.clh`` and its value.
        lanes: work-items that multiply together.
        unit: pixels.
        parts, held: outputs are ``parts`` x ``held``: of one part a work-item has the sums.
        rows: most rows of pixels for each work-item; with more, its sums do not fit into the registers.
        flags: of the compiler.
    """

    name: str
    value: int | bool
    lanes: int
    unit: int
    parts: int
    held: int
    rows: int = 2
    flags: str = ""

    @property
    def waves(self) -> int:
        """Groups of ``lanes`` work-items in a work-group."""
        return 64 // self.unit

    def arrange(self, weight: NDArray[Any]) -> NDArray[Any]:
        """Weights in the order in which work-items read them.

        Args:
            weight: (..., 16 channels, parts, held).

        Returns:
            (..., 16 * parts * held).
        """
        before = weight.shape[:-3]
        axes = tuple(range(len(before)))
        if self is NVIDIA:  # channel c is 8 i + 2 q + j; work-items by output and q, each with all i and j
            weight = weight.reshape(*before, 2, 4, 2, self.parts, self.held)
            order = (3, 4, 1, 0, 2)
        else:  # rows are outputs, the parts' turn about
            order = (2, 1, 0)
        return weight.transpose(*axes, *(len(axes) + i for i in order)).reshape(*before, -1)


NVIDIA = Form("NVIDIA", True, lanes=32, unit=16, parts=4, held=2)
RDNA3 = Form("RDNA3", True, lanes=32, unit=16, parts=2, held=8)
ARC = Form("ARC", 8, lanes=8, unit=8, parts=1, held=8, rows=1, flags="-cl-intel-256-GRF-per-thread")
ARC_16 = Form("ARC", 16, lanes=16, unit=16, parts=1, held=8, rows=1, flags="-cl-intel-256-GRF-per-thread")
FORMS = (NVIDIA, RDNA3, ARC, ARC_16)

_proved: WeakKeyDictionary[cl.Context, dict[Form, bool]] = WeakKeyDictionary()


_trial: ContextVar[tuple[Form, ...] | None] = ContextVar("_trial", default=None)


@contextmanager
def trial(forms: tuple[Form, ...]) -> Generator[None]:
    """Within the block, and in this thread, every device has matrix units of these forms."""
    token = _trial.set(forms)
    try:
        yield
    finally:
        _trial.reset(token)


def forms(device: Properties) -> tuple[Form, ...]:
    """The forms that a device may have, by what it says; which one it takes shows only when it is tried. Processors emulate NVIDIA's."""
    tried = _trial.get()
    if tried is not None:
        return tried
    if device.maker == "amd":
        return (RDNA3,) if re.search(r"\bgfx11\d\d", device.name) else ()
    if device.maker == "intel":
        return (ARC, ARC_16) if "cl_intel_subgroup_matrix_multiply_accumulate" in device.handle.extensions.split() else ()
    return () if device.is_gpu and not device.maker else (NVIDIA,)


def are_emulated(device: Device) -> bool:
    """Whether matrix units are emulated: on processors, where tests run the same code slowly."""
    return not device.maker


def build_options(device: Device, form: Form) -> dict[str, object]:
    """The options of ``kernels/mma.clh``."""
    return {form.name: form.value, "EMULATE": are_emulated(device)}


def build_flags(device: Device, form: Form) -> str:
    """The compiler's flags, which only the form's maker knows."""
    return "" if are_emulated(device) else form.flags


def proved(device: Device) -> Form | None:
    """The form with which one product came out right to the last bit, tested once for each context; None: there is none."""
    known = _proved.setdefault(device.context, {})
    for form in forms(device):
        if form not in known:
            known[form] = False
            with suppress(DeviceError, cl.Error):  # the compiler may not know the instruction
                known[form] = _product_is_right(device, form)
        if known[form]:
            return form
    return None


def _product_is_right(device: Device, form: Form) -> bool:
    random = np.random.default_rng(0)
    pixels, weight = (random.integers(-8, 9, size).astype(np.float16) for size in ((form.unit, 16), (16, form.parts, form.held)))
    want = 1 + pixels.astype(np.float32) @ weight.astype(np.float32).reshape(16, -1)
    got = np.empty((form.waves, *want.shape), np.float32)
    made = cl.Buffer(device.context, FLAGS.WRITE_ONLY, got.nbytes)
    inputs = constant(device, np.ascontiguousarray(pixels.reshape(form.unit, 2, 8).swapaxes(0, 1)))
    program = build(device, "matrix.cl", {"HALF": True, **build_options(device, form)}, build_flags(device, form))
    size = form.lanes, form.waves
    cl.Kernel(program, "matrix")(device.queue, size, size, inputs, constant(device, form.arrange(weight)), made)
    cl.enqueue_copy(device.queue, got, made)
    return bool((got == want).all())
