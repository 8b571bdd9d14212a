# SPDX-License-Identifier: MIT
"""The display frames that an output depends on, and a key of their files (docs/decisions/0005)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from collections.abc import Sequence as Numbers
from pathlib import Path

from stss.frames.display_frame import WINDOW, DisplayFrame, make_display_frame
from stss.frames.output import shot_start
from stss.images.color import Transfer
from stss.images.headers import Value
from stss.run.options import RunOptions
from stss.sequence.raw_frame import OF_COLOR
from stss.sequence.sequence import Sequence
from stss_ground.errors import InputError
from stss_ground.output.folder import digest_of


class Window:
    """The display frames that an output depends on, each read once and kept while needed."""

    def __init__(self, sequence: Sequence, rendered: frozenset[int], curve: Transfer, options: RunOptions, size: int = WINDOW):
        self._sequence, self._rendered, self._curve, self._options = sequence, rendered, curve, options
        self._size = size
        self._frames: dict[int, DisplayFrame | InputError] = {}

    def up_to(self, number: int, *, keep_going: bool) -> list[DisplayFrame]:
        """The unbroken run of readable frames that ends in ``number``, oldest first, as many as the backend reads.

        ``number`` grows from call to call.

        Raises:
            InputError: ``number`` cannot be read, or, unless ``keep_going``, one of the frames before it.
        """
        numbers = window_numbers(number, self._sequence.numbers[0], self._options.cuts, self._size)
        self._frames = {n: frame for n, frame in self._frames.items() if n in numbers}
        window: list[DisplayFrame] = []
        for n in numbers:
            loaded = self._load(n)
            if not isinstance(loaded, InputError):
                window.append(loaded)
            elif n == number or not keep_going:
                raise loaded
            else:
                window.clear()
        return window

    def attributes(self, window: Numbers[DisplayFrame]) -> Mapping[str, Value]:
        """The metadata that are copied to the output of ``window``: the frame's own, and of its colour those of the colour's frame."""
        own = self._sequence.frames[window[-1].number].attributes
        colored = next((frame.number for frame in reversed(window) if frame.color is not None), None)
        of_color = {} if colored is None else self._sequence.frames[colored].attributes
        of_frame = {name: value for name, value in own.items() if name not in OF_COLOR}
        return of_frame | {name: value for name, value in of_color.items() if name in OF_COLOR}

    def _load(self, number: int) -> DisplayFrame | InputError:
        if number not in self._frames:
            try:
                options = self._options
                # Nothing reads the motion to a frame that is not in this window, nor in a later one.
                begins = not isinstance(self._frames.get(number - 1), DisplayFrame)
                buffers = self._sequence.load(number, color=number in self._rendered, also=options.also, cut=begins)
                self._frames[number] = make_display_frame(buffers, self._curve, options.depth, copy=False)
            except InputError as error:
                self._frames[number] = error
        return self._frames[number]


def window_numbers(number: int, first: int, cuts: Numbers[int], size: int) -> range:
    """The display frames that the output of ``number`` may depend on: up to ``size``, of its own shot."""
    return range(max(number - size + 1, shot_start(number, first, cuts)), number + 1)


class Keys:
    """A digest of all that an output file depends on, files and settings: equal keys mean equal files."""

    def __init__(
        self, sequence: Sequence, rendered: frozenset[int], cuts: Numbers[int], settings: dict[str, object], size: int = WINDOW
    ):
        self._sequence, self._rendered, self._cuts = sequence, rendered, cuts
        self._size, self._settings = size, json.dumps(settings, sort_keys=True)
        self._digests: dict[Path, str] = {}

    def of(self, number: int) -> str:
        """The key of display frame ``number``: a digest of the settings and of content and role of every file that its window may read."""
        key = hashlib.sha256(f"{self._settings} {number}".encode())
        for n in window_numbers(number, self._sequence.numbers[0], self._cuts, self._size):
            if n in self._sequence.frames:
                digests = [self._digest(path) for path in self._sequence.files(n)]
                key.update(f"{n} {n in self._rendered} {digests}".encode())
        return key.hexdigest()

    def _digest(self, path: Path) -> str:
        if path not in self._digests:
            try:
                self._digests[path] = digest_of(path)
            except OSError:
                self._digests[path] = "unreadable"  # the step that needs its pixels reports it
        return self._digests[path]
