# SPDX-License-Identifier: MIT
"""The OpenCL backend: ``Network``, ``Frame``, ``Stream`` and ``Accumulate``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stss_cl.frame import Frame
    from stss_cl.image_space.accumulate import Accumulate
    from stss_cl.network.network import Network
    from stss_cl.skip.stream import Stream

__all__ = ["Accumulate", "Frame", "Network", "Stream"]

_HOMES = {
    "Accumulate": "stss_cl.image_space.accumulate",
    "Frame": "stss_cl.frame",
    "Network": "stss_cl.network.network",
    "Stream": "stss_cl.skip.stream",
}


def __getattr__(name: str) -> Any:
    """Import the classes when they are asked for: ``stss_ground.errors`` alone must not open the OpenCL library."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    """List the public names, so that a shell completes them."""
    return sorted({*globals(), *__all__})
