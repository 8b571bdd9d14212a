# SPDX-License-Identifier: MIT
"""A device's own instructions are used if a test of them gives the right result."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from weakref import WeakKeyDictionary

import pyopencl as cl

from stss_cl.device.discovery import Device
from stss_ground.errors import DeviceError

_results: WeakKeyDictionary[cl.Context, dict[str, bool]] = WeakKeyDictionary()


def are_right(device: Device, instructions: str, test: Callable[[], bool]) -> bool:
    """Whether the test of the ``instructions`` of this name passes; run once for each context. A failed build counts as wrong."""
    results = _results.setdefault(device.context, {})
    if instructions not in results:
        results[instructions] = False
        with suppress(DeviceError, cl.Error):  # the compiler, or an older device, may not know them
            results[instructions] = test()
    return results[instructions]
