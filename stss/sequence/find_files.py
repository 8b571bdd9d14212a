# SPDX-License-Identifier: MIT
"""Find the files of a sequence by their names and frame numbers: one file for each frame, or one for each buffer of it."""

from __future__ import annotations

import errno
import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from stss.images.headers import read_header
from stss_ground.arguments import listing
from stss_ground.errors import InputError

_SEPARATORS = "._- "
_STEM = re.compile(r"(.*?)(\d+)(\D*)", re.DOTALL)
"""The frame number is the last group of digits of the name without its suffix."""
_PATTERN = re.compile(r"(.*?)#+([^#]*)", re.DOTALL)
_FOREIGN = (r"%0?\d*d|\$F\d?|<F\d?>|<frame>|@+|\*", r"\[\d+-\d+\]|\{\d+\.\.\d+\}|\d+-\d+", r"\d+(?=\D*$)")
"""How other programs write the frame number (Nuke, FFmpeg, Houdini, Arnold, V-Ray, RV, shells), or a range; then one frame's own."""
_DIGIT, _DIGITS = re.compile(r"\d"), re.compile(r"(\d+)")
_PICTURES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".mp4", ".mov", ".mkv"}
_FRACTION = re.compile(r"(.*[^\dvV]|)(\d+)\.", re.DOTALL)
"""The part before the digits of ``NAME.0001.5``; ``v1.0001`` is a version."""

MAX_DIGITS = 9
"""Most digits of a frame number, not counting leading zeros; a longer number is a date or a hash."""

MOST_LISTED = 5
"""Most sequences that an error lists: where another number than the frame's is the last one, each frame looks like a sequence."""
LOOKED_INTO = 20
"""Most folders in the place of a sequence whose images are looked at; some farms leave one for each frame."""

Frames = dict[int, dict[str, Path]]
"""Frame number -> ending of the name before the number ("" for the file that buffers share) -> file."""


class NumberedFile(NamedTuple):
    """A file and the parts of its name.

    Attributes:
        path: the file.
        before: the name before the number, with separators.
        number: the frame.
        digits: the number as it is written, without a sign.
        after: the name behind the number, without the suffix.
    """

    path: Path
    before: str
    number: int
    digits: str
    after: str


def numbered_files(paths: Iterable[Path], end: str = "") -> list[NumberedFile]:
    """Find the frame numbers in the names of files of one folder; a name without a number is left out.

    ``end``: the end of the names without their suffix, behind the number; it may have digits. Names that do not end so are left out.
    Accents may be written in either way (NFC, NFD): both are one name to most file systems.

    A minus sign stands behind a separator (``shot.-006``), or where other files of the name have no separator (``shot-006``,
    ``shot0001``). Elsewhere a dash is a separator: ``shot-0006`` is frame 6.

    Raises:
        InputError: a number has more than `MAX_DIGITS` digits.
    """
    stems = [(path, _compose(path.stem)) for path in paths]
    matches = [
        (path, match[1], match[2], match[3] + end)
        for path, stem in stems
        if stem.endswith(end) and (match := _STEM.fullmatch(stem.removesuffix(end)))
    ]
    unseparated = {before for _, before, _, _ in matches}
    files: list[NumberedFile] = []
    for path, before, digits, after in matches:
        rest = before.removesuffix("-")
        negative = rest != before and (rest.endswith(tuple(_SEPARATORS)) or rest in unseparated | {""})
        number = frame_number(path, digits)
        files.append(NumberedFile(path, rest if negative else before, -number if negative else number, digits, after))
    return files


class Pattern(NamedTuple):
    """The parts before and behind the number in the names of a sequence, the latter without the suffix."""

    before: str
    after: str

    @property
    def end(self) -> str:
        """Argument ``end`` of `numbered_files`: what follows the frame's number, if another number is in it."""
        return self.after if _DIGIT.search(self.after) else ""


def split_pattern(path: Path, suffixes: Collection[str]) -> tuple[Path, Pattern | None]:
    """The folder of a sequence; and its pattern, if ``path`` is one like ``folder/name.####.exr`` and no folder.

    ``suffixes``: those that a pattern may end in.
    """
    stem = path.stem if path.suffix.lower() in suffixes else path.name
    # A folder's name may have a #. Path.is_dir raises where a folder above cannot be entered.
    match = None if os.path.isdir(path) else _PATTERN.fullmatch(_compose(stem))  # noqa: PTH112
    return (path, None) if match is None else (path.parent, Pattern(match[1], match[2]))


def find_frames(path: Path, endings: Collection[str]) -> Frames:
    """Find the EXR files of a sequence.

    Args:
        path: a folder that holds one sequence; or a pattern like ``folder/name.####.exr``, with any number of # and
            with or without an ending.
        endings: of names, before the frame number, one for each kind of file; "" where a kind has no ending.

    Raises:
        InputError: there are no such files, those of several sequences, or two for one frame; a number has too many
            digits; or the folder cannot be read.
    """
    folder, pattern = split_pattern(path, (".exr",))
    images = (f for f in _files(path, folder) if f.suffix.lower() == ".exr" and not f.name.startswith("."))
    files = numbered_files(images, "" if pattern is None else pattern.end)
    parts = [(_name(file.before, file.after, endings), file) for file in files]
    if pattern is not None:
        own_name = (_name(*pattern, endings) or (pattern.before.rstrip(_SEPARATORS) + pattern.after, ""))[0]
        fitting = [(name, file) for name, file in parts if name is not None and name[0] == own_name]
        parts = [(name, file) for name, file in fitting if _gap(file.before) == _gap(pattern.before)] or fitting
    by_prefix: dict[str, Frames] = defaultdict(dict)
    for name, file in parts:
        if name is None:
            continue
        other = by_prefix[name[0]].setdefault(file.number, {}).setdefault(name[1], file.path)
        if other != file.path:
            raise InputError(f"{file.path}: the same frame as {other.name}")
    if not by_prefix:
        kinds = "NAME.0001.exr" if "" in endings else f"NAME{_list_endings(endings)}.0001.exr"
        others = f"; found {min(file.path.name for file in files)}" if pattern is not None and files else ""
        raise InputError(
            f"{path}: no frames; expected files named like {kinds}{others}{_fractions(files)}{_below(folder)}{_pictures(folder)}"
        )
    if len(by_prefix) > 1:
        first = {name[0]: file for name, file in reversed(parts) if name is not None}
        patterns = {_pattern(file): len(by_prefix[name]) for name, file in first.items()}
        by_size = sorted(patterns, key=lambda pattern: (-patterns[pattern], pattern))
        counts = listing([f"{each} ({patterns[each]} frame{'s' * (patterns[each] > 1)})" for each in by_size], MOST_LISTED)
        raise InputError(
            f"{path}: several sequences: {counts}; give one as a pattern, with #### for the number{_other_number(files)}{_fractions(files)}"
        )
    return next(iter(by_prefix.values()))


def _pattern(file: NumberedFile) -> str:
    """The pattern of a file's sequence, for an error."""
    return f"{file.before}####{file.after}{file.path.suffix}"


def _other_number(files: Sequence[NumberedFile]) -> str:
    """A note where all names have the same last number, and one other number differs; else nothing."""
    names = [_DIGITS.split(file.path.name) for file in files]
    differ = [place for place, words in enumerate(zip(*names, strict=False)) if len({*words}) > 1]
    if len({len(name) for name in names}) > 1 or len(differ) != 1 or not differ[0] % 2:
        return ""
    number = differ[0]
    return f"; if {names[0][number]} is a frame's number, it is {''.join([*names[0][:number], '####', *names[0][number + 1 :]])}"


def _fractions(files: Iterable[NumberedFile]) -> str:
    """A note where files seem to be numbered 0001.0, 0001.5, 0002.0; else nothing."""
    whole: dict[str, dict[str, str]] = defaultdict(dict)
    for file in files:
        if match := _FRACTION.fullmatch(file.before):
            whole[match[1]][match[2]] = f"{match[2]}.{file.digits}"
    numbers = next((numbers for numbers in whole.values() if len(numbers) > 1), None)
    if numbers is None:
        return ""
    return (
        f"; {max(numbers.values(), key=len)} looks like a fraction, and fractions are not frame numbers: number the display frames by"
        " whole numbers, half frames too"
    )


def _below(folder: Path) -> str:
    """A note where a folder in this one has the images; else nothing."""
    with suppress(OSError):
        below = (each for each in sorted(folder.iterdir()) if each.is_dir())
        images = (next((file for file in sorted(each.iterdir()) if file.suffix.lower() == ".exr"), None) for each in below)
        some = list(islice((image for image in images if image is not None), LOOKED_INTO))
        if len(some) > 2 and len({image.name for image in some}) == 1 and _DIGIT.search(some[0].stem):
            names = listing([image.parent.name for image in some], MOST_LISTED)
            return (
                f"; its folders {names} have frames of the same names: if each holds a pass, put all into one folder, with the pass in "
                f"the name, {some[0].parent.name}.{some[0].name}, and say --profile FILE.toml (docs/profiles.md, [files])"
            )
        if some:
            name = max(some, key=_count_channels).parent.name
            return f"; its folder {name} has EXR files: give that one, or put all frames of a shot into one folder"
    return ""


def _count_channels(image: Path) -> int:
    """Of a folder of truths and one of inputs, the inputs have more; 0 where it cannot be read."""
    try:
        return len(read_header(image).channels)
    except InputError:
        return 0


def _pictures(folder: Path) -> str:
    """A note where the folder has images of other kinds; else nothing."""
    with suppress(OSError):
        kinds = sorted({file.suffix for file in folder.iterdir()} & _PICTURES)
        if kinds:
            return f"; {', '.join(kinds)} hold colour alone, and stss needs motion, depth and more: write OpenEXR"
    return ""


def _advice(path: Path) -> str:
    """A note where the path is a pattern of another program, one frame, or written as on Windows; else nothing."""
    if os.sep == "/" and "\\" in str(path):
        return "; the path has \\, and folders are separated by / here"
    if path.stem == "*":
        return f"; write {path.parent}"
    if path.suffix.lower() == ".exr":
        for number in _FOREIGN:
            pattern, count = re.subn(number, "####", path.stem, count=1, flags=re.IGNORECASE)
            if count:
                return f"; write {pattern}{path.suffix}"
    return ""


def _files(path: Path, folder: Path) -> list[Path]:
    """The files in the folder, sorted; InputError where it is not a folder or cannot be read."""
    try:
        return sorted(folder.iterdir())
    except FileNotFoundError:
        kind = "nothing"
    except NotADirectoryError:
        kind = "a file"
    except OSError as error:
        if error.errno != errno.EINVAL:  # Windows: a name that no file can have
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error
        kind = "nothing"
    raise InputError(f"{path}: expected a folder, or a pattern like name.####.exr; found {kind}{_advice(path)}")


def frame_number(file: Path, digits: str) -> int:
    """The frame number in a file's name; raises InputError past `MAX_DIGITS`."""
    digits = digits.lstrip("0")
    if len(digits) > MAX_DIGITS:
        raise InputError(f"{file}: expected a frame number of at most {MAX_DIGITS} digits, found {len(digits)}")
    return int(digits or 0)


def _name(before: str, after: str, endings: Collection[str]) -> tuple[str, str] | None:
    """A name without its number, as (sequence, ending); None where no ending fits. The longest ending wins."""
    name = (before.rstrip(_SEPARATORS) + after).rstrip(_SEPARATORS)
    for ending in sorted(endings, key=len, reverse=True):
        if name.endswith(_compose(ending)):
            return name.removesuffix(_compose(ending)).rstrip(_SEPARATORS), ending
    return None


def _compose(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _gap(before: str) -> str:
    """The separators between name and number."""
    return before[len(before.rstrip(_SEPARATORS)) :]


def _list_endings(endings: Collection[str]) -> str:
    return "|".join(sorted(ending for ending in endings if ending))
