# SPDX-License-Identifier: MIT
"""Find the files of a sequence by their names and frame numbers: one file for each frame, or one for each buffer of it."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

from stss_ground.errors import InputError

_SEPARATORS = "._- "
_STEM = re.compile(r"(.*?)(\d+)(\D*)", re.DOTALL)
"""The frame number is the last group of digits of the name without its suffix."""

MAX_DIGITS = 9
"""Most digits of a frame number, not counting leading zeros; a longer number is a date or a hash."""

Frames = dict[int, dict[str, Path]]
"""Frame number -> ending of the name before the number ("" for the file that buffers share) -> file."""


def find_frames(path: Path, endings: Collection[str]) -> Frames:
    """Find the EXR files of a sequence.

    Args:
        path: a folder that holds one sequence; or a pattern like ``folder/name.####.exr``, with any number of # and
            with or without an ending.
        endings: what names end with before the frame number, one for each kind of file; "" where a kind has no ending.

    Raises:
        InputError: there are no such files, those of several sequences, or two for one frame; a number has too many
            digits; or the folder cannot be read.
    """
    folder, wanted = path, None
    if "#" in path.name:
        folder = path.parent
        before, _, after = Path(path.name).stem.partition("#")
        name = before + after.lstrip("#")
        wanted = (_split(name, endings) or (name.rstrip(_SEPARATORS), ""))[0]
    by_prefix: dict[str, Frames] = {}
    for file in _files(path, folder):
        match = _STEM.fullmatch(file.stem)
        if file.suffix.lower() != ".exr" or file.name.startswith(".") or match is None:
            continue
        name = _split(match[1].rstrip(_SEPARATORS) + match[3], endings)
        if name is None or (wanted is not None and name[0] != wanted):
            continue
        other = by_prefix.setdefault(name[0], {}).setdefault(frame_number(file, match[2]), {}).setdefault(name[1], file)
        if other != file:
            raise InputError(f"{file}: the same frame as {other.name}")
    if not by_prefix:
        kinds = "NAME.0001.exr" if "" in endings else f"NAME{_listed(endings)}.0001.exr"
        raise InputError(f"{path}: no frames; expected files named like {kinds}")
    if len(by_prefix) > 1:
        stems = ", ".join(name or "(no name)" for name in sorted(by_prefix))
        raise InputError(f"{path}: several sequences: {stems}; give one as a pattern, like NAME.####.exr")
    return next(iter(by_prefix.values()))


def _files(path: Path, folder: Path) -> list[Path]:
    """The files in the folder, sorted; InputError where it is not a folder or cannot be read."""
    try:
        return sorted(folder.iterdir())
    except FileNotFoundError:
        found = "nothing"
    except NotADirectoryError:
        found = "a file"
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    raise InputError(f"{path}: expected a folder, or a pattern like name.####.exr; found {found}")


def frame_number(file: Path, digits: str) -> int:
    """The frame number in a file's name; raises InputError past `MAX_DIGITS`."""
    digits = digits.lstrip("0")
    if len(digits) > MAX_DIGITS:
        raise InputError(f"{file}: expected a frame number of at most {MAX_DIGITS} digits, found {len(digits)}")
    return int(digits or 0)


def _split(name: str, endings: Collection[str]) -> tuple[str, str] | None:
    """A name without its number, as (sequence, ending); None where no ending fits. The longest ending wins."""
    for ending in sorted(endings, key=len, reverse=True):
        if name.rstrip(_SEPARATORS).endswith(ending):
            return name.rstrip(_SEPARATORS).removesuffix(ending).rstrip(_SEPARATORS), ending
    return None


def _listed(endings: Collection[str]) -> str:
    return "|".join(sorted(ending for ending in endings if ending))
