# SPDX-License-Identifier: MIT
"""Space-time supersampling: frames in, twice the resolution and twice the frame rate out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from stss_ground.optional import add_own_conformance

if TYPE_CHECKING:
    from stss.check_sequence.frames import check_frames
    from stss.frames.backends import open_backend
    from stss.frames.buffers import Buffers
    from stss.frames.check_buffers import check_buffers as check
    from stss.frames.supersampler import Supersampler, supersample
    from stss.sequence.conventions import convert
    from stss.sequence.profiles import load_profile
    from stss.sequence.reader import open_sequence
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
    "Buffers": ("stss.frames.buffers", "Buffers"),
    "Supersampler": ("stss.frames.supersampler", "Supersampler"),
    "check": ("stss.frames.check_buffers", "check_buffers"),
    "check_frames": ("stss.check_sequence.frames", "check_frames"),
    "convert": ("stss.sequence.conventions", "convert"),
    "load_profile": ("stss.sequence.profiles", "load_profile"),
    "load_weights": ("stss.weights", "load"),
    "open_backend": ("stss.frames.backends", "open_backend"),
    "open_sequence": ("stss.sequence.reader", "open_sequence"),
    "supersample": ("stss.frames.supersampler", "supersample"),
}


def __getattr__(name: str) -> Any:
    """Import a name when it is asked for: a command that needs no OpenCL must not open its library."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    room, there = _HOMES[name]
    return getattr(import_module(room), there)


def __dir__() -> list[str]:
    """List the public names, so that a shell completes them."""
    return sorted({*globals(), *__all__})
