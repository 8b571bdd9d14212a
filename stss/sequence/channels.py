# SPDX-License-Identifier: MIT
"""The file and channels of each buffer."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from stss.images.headers import Header, read_header
from stss.sequence.profiles import BUFFERS, Channels, Profile
from stss_ground.arguments import listing, suggest
from stss_ground.errors import InputError

LAYERS = ("ViewLayer", "View Layer", "RenderLayer")
"""Blender's names for the only layer of a new scene; they differ between its versions."""

MOST_EXPLAINED = 3
"""Most missing buffers that one line explains."""


@dataclass(frozen=True)
class Source:
    """The place of a buffer: a file, and the full names of the buffer's channels in it."""

    path: Path
    names: Channels


def find_sources(headers: Mapping[str, Header], profile: Profile) -> dict[str, Source]:
    """Find the buffers of a frame, in the order of `BUFFERS`.

    Args:
        headers: ending of a file's name, see `Profile.files`, -> the file's header.
        profile: has the channels' names.

    Raises:
        InputError: as `find_buffers`.
    """
    ends = {buffer: next((ending for ending in profile.files_of(buffer) if ending in headers), None) for buffer in BUFFERS}
    sources: dict[str, Source] = {}
    for ending, header in headers.items():
        sources |= find_buffers(header, profile, [buffer for buffer in BUFFERS if ends[buffer] == ending])
    return {buffer: sources[buffer] for buffer in BUFFERS if buffer in sources}


def find_buffers(header: Header, profile: Profile, buffers: Collection[str]) -> dict[str, Source]:
    """Find the buffers that a file has; of a buffer's alternatives, the first whose channels are all in the file wins.

    Args:
        header: the file's.
        profile: has the channels' names.
        buffers: the buffers that may be in this file.

    Raises:
        InputError: several layers have the same buffers, so that ``{layer}`` could mean any of them; or the file lacks the view.
    """
    names = _Names(_names(header, profile))
    by_layer = {layer: _in_layer(header.path, names, profile, buffers, layer) for layer in names.layers}
    if not by_layer:
        return _in_layer(header.path, names, profile, buffers, None)
    most = max(len(sources) for sources in by_layer.values())
    best = [layer for layer, sources in by_layer.items() if len(sources) == most]
    if len({tuple(by_layer[layer].values()) for layer in best}) > 1:
        best = [layer for layer in LAYERS if layer in best] or best
        if best[0] not in LAYERS:
            raise InputError(
                f"{header.path}: layers {', '.join(best)} all fit profile {profile.name}; "
                "write the layer's name in place of {layer} in a copy of the profile"
            )
    return by_layer[best[0]]


def layers_of(header: Header, profile: Profile, color: Source) -> list[str]:
    """The layers of a file that have all channels of a colour, the layer of ``color`` first; "" for a colour without a layer."""
    names = _Names(_names(header, profile))
    by_layer = {layer: _in_layer(header.path, names, profile, ["color"], layer).get("color") for layer in names.layers}
    return sorted((layer for layer, source in by_layer.items() if source), key=lambda layer: by_layer[layer] != color) or [""]


class _Names:
    """Names as a profile may have them, and the full name of each."""

    def __init__(self, full: Mapping[str, str]):
        self.layers = sorted({name.rsplit(".", 2)[0] for name in full if name.count(".") >= 2})
        self._full = full
        folded = Counter(name.lower() for name in full)
        self._folded = {name.lower(): whole for name, whole in full.items() if folded[name.lower()] == 1}

    def find(self, name: str) -> str | None:
        """The full name of a name, or else of the only one that differs from it by upper and lower case: programs write ``r`` for ``R``."""
        return self._full.get(name) or self._folded.get(name.lower())


def view_of(name: str, views: Collection[str]) -> str | None:
    """The view among the parts of a channel's full name, such as left in ``layer.pass.left.R``; None: no view."""
    return next((part for part in name.split(".")[:-1] if part in views), None)


def _names(header: Header, profile: Profile) -> dict[str, str]:
    """A channel's name as the profile may have it -> the full name, of the profile's view.

    Without its view; and with its part, where the profile has a name of this kind: ``R`` of the part ``basecolor`` is no picture, also in
    a frame that has no picture.

    Raises:
        InputError: the file has views, and not this one.
    """
    views, view = header.views, profile.view
    if view and views and view not in views:
        raise InputError(f"{header.path}: no view {view}; expected one of {', '.join(views)}")
    eye = view if view and views else next(iter(views), None)
    names: dict[str, str] = {}
    for name in header.channels:
        if (own := view_of(name, views)) is None and eye == next(iter(views), None):  # the first view's need not have it
            names[name] = name
        elif own is not None and own == eye:
            parts = name.split(".")
            parts.remove(own)
            names[".".join(parts)] = name
    profile_names = {name.lower() for buffer in profile.channels.values() for alternative in buffer for name in alternative}
    for name in [name for name in names if "." not in name]:
        if (whole := f"{header.parts[names[name]]}.{name}").lower() in profile_names:
            names[whole] = names.pop(name)
    return names


def _in_layer(path: Path, there: _Names, profile: Profile, buffers: Collection[str], layer: str | None) -> dict[str, Source]:
    sources: dict[str, Source] = {}
    for buffer in buffers:
        for names in profile.channels[buffer]:
            full = [there.find(name.replace("{layer}.", "" if layer is None else f"{layer}.")) for name in names]
            if None not in full:
                sources[buffer] = Source(path, tuple(name for name in full if name))
                break
    return sources


def note_on_layers(profile: Profile, color: Source) -> str:
    """A note if the file of ``color`` has other layers with a colour, too; "" if not."""
    first, *others = layers_of(read_header(color.path), profile, color)
    if not others:
        return ""
    return (
        f"layers: {color.path.name} has the colour of {', '.join([first, *others])}; only {first} is read: "
        "a profile with a base and the names of channels written out reads another"
    )


def note_on_views(files: Iterable[Path], profile: Profile, color: Source) -> str:
    """A note if a frame's files have several views, and the profile names none; "" if not."""
    views = tuple(dict.fromkeys(view for path in files for view in read_header(path).views))
    if len(views) < 2 or profile.view:
        return ""
    view = view_of(color.names[0], views) or views[0]
    others = " or ".join(f'view = "{other}"' for other in views if other != view)
    return f"views: the files have {', '.join(views)}; only {view} is read: a profile with a base and {others} reads another"


class MissingBuffersError(InputError):
    """Buffers that a profile does not find.

    Attributes:
        each: for each buffer its names, advice, and a channel of a like name.
        channels: those of the files.
    """

    def __init__(
        self, where: object, profile: Profile, buffers: Sequence[str], files: Iterable[Path], sources: Mapping[str, Source]
    ):
        there = sorted({name for file in files for name in read_header(file).channels})
        free = {*there} - {name for source in sources.values() for name in source.names}
        self.each = tuple(_missing_buffer(profile, buffer, free) for buffer in buffers)
        more = (
            f"; no {', '.join(buffers[MOST_EXPLAINED:])} either: stss check explains each"
            if len(buffers) > MOST_EXPLAINED
            else ""
        )
        self.channels = listing(there) or "nothing"
        super().__init__(f"{where}: {'; '.join(self.each[:MOST_EXPLAINED])}{more}; found {self.channels}")


def _missing_buffer(profile: Profile, buffer: str, free: Collection[str]) -> str:
    """A profile's names for a buffer, and the channel of a like name among those that no other buffer takes."""
    alternatives = profile.channels[buffer]
    expected_names = " or ".join(_together(names) for names in alternatives) or "a constant"
    endings = " or ".join(f"NAME{ending}.NNNN.exr" for ending in profile.files_of(buffer) if ending)
    file = f" in a file {endings}" if endings else ""
    hint = f" ({profile.hints[buffer]})" if buffer in profile.hints else ""
    own = {name.removeprefix("{layer}.") for names in alternatives for name in names}
    ends = {".".join(name.split(".")[-2:]) for name in free} - own  # of X and Y, one may be there
    near = suggest(alternatives[0][0].removeprefix("{layer}."), ends) if alternatives else ""
    return f"no {buffer}: profile {profile.name} expects {expected_names}{file}{hint}{near}"


def _together(names: Channels) -> str:
    """``motion.X, .Y`` for the channels of one layer."""
    layer = names[0].rpartition(".")[0]
    same = bool(layer) and all(name.rpartition(".")[0] == layer for name in names)
    return ", ".join([names[0], *(name.removeprefix(layer) if same else name for name in names[1:])])
