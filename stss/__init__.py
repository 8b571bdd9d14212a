# SPDX-License-Identifier: MIT
"""Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from stss_ground.optional import add_own_conformance

if TYPE_CHECKING:
    from stss.check_sequence.frames import check_frames
    from stss.frames import Buffers, Supersampler, open_backend, supersample
    from stss.frames import check_buffers as check
    from stss.sequence import convert, load_profile, open_sequence
    from stss.weights import load as load_weights

__all__ = [
    "Buffers",
    "Supersampler",
    "check",
    "check_frames",
    "convert",
    "load_profile",
    "load_weights",
    "open_backend",
    "open_sequence",
    "supersample",
]

add_own_conformance()

_HOMES = {
    "Buffers": ("stss.frames", "Buffers"),
    "Supersampler": ("stss.frames", "Supersampler"),
    "check": ("stss.frames", "check_buffers"),
    "check_frames": ("stss.check_sequence.frames", "check_frames"),
    "convert": ("stss.sequence", "convert"),
    "load_profile": ("stss.sequence", "load_profile"),
    "load_weights": ("stss.weights", "load"),
    "open_backend": ("stss.frames", "open_backend"),
    "open_sequence": ("stss.sequence", "open_sequence"),
    "supersample": ("stss.frames", "supersample"),
}


def __getattr__(name: str) -> Any:
    """Import a name when it is asked for: a command that needs no OpenCL must not open its library."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    room, there = _HOMES[name]
    return getattr(import_module(room), there)


def __dir__() -> list[str]:
    """List them too, so that a shell completes them."""
    return sorted({*globals(), *__all__})
