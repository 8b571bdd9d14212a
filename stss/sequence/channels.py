# SPDX-License-Identifier: MIT
"""Which channel of which file holds each buffer."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from stss.images.headers import Header
from stss.sequence.profiles import Channels, Profile
from stss_ground.errors import InputError

LAYERS = ("ViewLayer", "View Layer", "RenderLayer")
"""Blender's names for the only layer of a new scene; they differ between its versions."""


@dataclass(frozen=True)
class Source:
    """Where a buffer is: a file, and the full names of the buffer's channels in it."""

    path: Path
    names: Channels


def find_buffers(header: Header, profile: Profile, buffers: Collection[str]) -> dict[str, Source]:
    """Find the buffers that a file has; of a buffer's alternatives, the first whose channels are all in the file wins.

    Args:
        header: the file's.
        profile: has the channels' names.
        buffers: the buffers that may be in this file.

    Raises:
        InputError: several layers have the same buffers, so that ``{layer}`` could mean any of them.
    """
    layers = {name.rsplit(".", 2)[0] for name in header.channels if name.count(".") >= 2}
    by_layer = {layer: _in_layer(header, profile, buffers, layer) for layer in sorted(layers)}
    if not by_layer:
        return _in_layer(header, profile, buffers, None)
    most = max(len(names) for names in by_layer.values())
    best = [layer for layer, names in by_layer.items() if len(names) == most]
    if len({tuple(by_layer[layer].values()) for layer in best}) > 1:
        best = [layer for layer in LAYERS if layer in best] or best
        if best[0] not in LAYERS:
            raise InputError(
                f"{header.path}: layers {', '.join(best)} all fit profile {profile.name}; "
                "write the layer's name in place of {layer} in a copy of the profile"
            )
    return by_layer[best[0]]


def _in_layer(header: Header, profile: Profile, buffers: Collection[str], layer: str | None) -> dict[str, Source]:
    there = set(header.channels)
    sources: dict[str, Source] = {}
    for buffer in buffers:
        for names in profile.channels[buffer]:
            full = tuple(name.replace("{layer}.", "" if layer is None else f"{layer}.") for name in names)
            if there.issuperset(full):
                sources[buffer] = Source(header.path, full)
                break
    return sources


def missing_buffers(profile: Profile, buffers: Collection[str], where: object, there: Collection[str]) -> InputError:
    """The error for buffers that no file has: of each the names expected and what to do; the channels found (``there``)."""
    parts: list[str] = []
    for buffer in buffers:
        names_wanted = " or ".join(", ".join(names) for names in profile.channels[buffer]) or "a constant"
        ending = profile.file_of(buffer)
        file = f" in a file NAME{ending}.NNNN.exr" if ending else ""
        hint = f" ({profile.hints[buffer]})" if buffer in profile.hints else ""
        parts.append(f"no {buffer}: profile {profile.name} expects {names_wanted}{file}{hint}")
    return InputError(f"{where}: {'; '.join(parts)}; found {', '.join(there) or 'nothing'}")
