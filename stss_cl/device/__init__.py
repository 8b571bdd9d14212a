# SPDX-License-Identifier: MIT
"""The device: choose it, build programs for it, its buffers and its tuning."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stss_cl.device.discovery import Device, open_device

__all__ = ["Device", "open_device"]


def __getattr__(name: str) -> Any:
    """Import modules that open the OpenCL library when they are asked for: ``stss_cl.device.caches`` alone must not."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from stss_cl.device import discovery

    return getattr(discovery, name)
