# SPDX-License-Identifier: MIT
"""The OpenCL backend: ``Network``, ``Frame`` and ``Stream``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stss_cl.frame import Frame
    from stss_cl.network import Network
    from stss_cl.stream import Stream

__all__ = ["Frame", "Network", "Stream"]


def __getattr__(name: str) -> Any:
    """Import the classes when they are asked for: ``stss_cl.errors`` alone must not open the OpenCL library."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"stss_cl.{name.lower()}"), name)
