# SPDX-License-Identifier: MIT
"""The profile of a sequence: the one that its user named, or the one whose channels its files have."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from stss.images.headers import Header, read_header
from stss.sequence.channels import Source, find_sources
from stss.sequence.find_files import Frames, find_frames
from stss.sequence.profiles import BUFFERS, Profile, load_profile, profile_names
from stss_ground.arguments import listing
from stss_ground.errors import InputError

LEAST = 3
"""Fewest buffers that find a profile: colour alone has the same names everywhere."""


def settle_profile(path: Path, profile: str | Path | Profile | None) -> Profile:
    """The profile that the user named; None: the one that `find_profile` finds."""
    if profile is None:
        return find_profile(path)
    return profile if isinstance(profile, Profile) else load_profile(profile)


def find_profile(path: Path) -> Profile:
    """The built-in profile whose channels the first frame that can be read has most of.

    Raises:
        InputError: there is no sequence, no profile fits three buffers, two profiles fit equally many, or several layers fit
            the best one.
    """
    scores: dict[str, int] = {}
    refusals: list[InputError] = []
    layers: list[InputError] = []
    channels: dict[str, None] = {}
    for name in profile_names():
        table = load_profile(name)
        try:
            headers = _first_headers(find_frames(path, table.endings))
        except InputError as error:
            refusals.append(error)
            continue
        channels |= dict.fromkeys(name for header in headers.values() for name in header.channels)
        try:
            scores[name] = len(find_sources(headers, table))
        except InputError as error:
            layers.append(error)
    if layers and max(scores.values(), default=0) < LEAST:
        raise layers[0]
    if not scores:
        raise refusals[0]
    best = [name for name, score in scores.items() if score == max(scores.values())]
    if len(best) == 1 and scores[best[0]] >= LEAST:
        return load_profile(best[0])
    if {name.upper() for name in channels} <= {*"RGBA"}:
        raise InputError(
            f"{path}: expected {', '.join(BUFFERS)}, found a picture alone: {listing(channels)}; turn on the renderer's passes, or say "
            "--profile FILE.toml if each is a file of its own (docs/profiles.md, [files])"
        )
    raise InputError(
        f"{path}: the channels fit no profile alone: {listing(channels)}; say --profile {' or '.join(best)}, or --profile FILE.toml for "
        "other names (docs/profiles.md, A profile of your own)"
    )


def frames_of(path: Path, profile: Profile) -> Frames:
    """The files of a sequence that have the names of a profile.

    Raises:
        InputError: as `stss.sequence.find_files.find_frames`; and it names the profile that has such files.
    """
    try:
        return find_frames(path, profile.endings)
    except InputError as error:
        if (other := _other_profile(path, profile)) is None:
            raise
        raise InputError(f"{path}: no frames for profile {profile.name}; the files fit profile {other.name}") from error


def require_fit(path: Path, profile: Profile, sources: Mapping[str, Source]) -> None:
    """Raise InputError if a built-in profile finds more buffers than the ``sources`` that ``profile`` finds."""
    other = _other_profile(path, profile)
    if other is None:
        return
    count = len(find_sources(_first_headers(find_frames(path, other.endings)), other))
    if count > len(sources):
        names = ", ".join(sources) or "no buffer"
        raise InputError(
            f"{path}: profile {profile.name} finds {names}; profile {other.name} finds {count} of {len(BUFFERS)} buffers"
        )


def _other_profile(path: Path, profile: Profile) -> Profile | None:
    """The built-in profile that fits, if it is not this one."""
    try:
        fitting = find_profile(path)
    except InputError:
        return None
    return None if fitting.name == profile.name else fitting


def _first_headers(files_by_number: Frames) -> dict[str, Header]:
    """Those of the first frame whose headers can be read; raises the first frame's InputError where there is none."""
    fault = None
    for number in sorted(files_by_number):
        try:
            return {ending: read_header(file) for ending, file in files_by_number[number].items()}
        except InputError as error:
            fault = fault or error
    assert fault is not None
    raise fault
