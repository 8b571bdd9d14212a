# SPDX-License-Identifier: MIT
"""A page that shows frames in several versions: by a slider, flickering, as a difference, side by side."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from html import escape
from pathlib import Path
from string import Template
from urllib.parse import quote

import cv2
import numpy as np

from stss.images.encode import encode_png
from stss_ground.output.folder import OutputFolder
from stss_ground.output.write_whole import write_named
from stss_ground.pages.page import asset, page
from stss_ground.terminal import printable
from stss_ref.arrays import Array, Image

WITHIN = 64 << 20
"""Most bytes of PNG that a page holds itself; further pictures lie in a folder beside it."""
THUMBNAIL = 96
"""Width of a frame's picture in the strip, pixels."""


@dataclass(frozen=True)
class Pane:
    """A version in which frames are shown: its name, and a sentence that explains it."""

    name: str
    meaning: str


@dataclass(frozen=True)
class ShownFrame:
    """One frame.

    Attributes:
        number: of the frame.
        kind: "SF", "EF", or "" where that is not known.
        caption: its scores in a line.
        pictures: view to (H, W, 3) display-referred, clipped to 0..1; a view may be missing. The last one is in the strip.
    """

    number: int
    kind: str
    caption: str
    pictures: Mapping[str, Image]


@dataclass(frozen=True)
class Viewer:
    """The contents of the page besides the frames.

    Attributes:
        title: the page's title.
        notes: lines below the title.
        views: the versions, in the order in which they are offered.
        pair: the two that are shown first, left and right.
        plots: figures, markup of `stss_ground.pages.plot`.
        tables: markup of `stss_ground.pages.page`.
    """

    title: str
    notes: Sequence[str]
    views: Sequence[Pane]
    pair: tuple[str, str]
    plots: Sequence[str]
    tables: Sequence[str]


def page_folder(path: Path) -> OutputFolder:
    """The folder for the pictures of a page that is written to ``path``."""
    return OutputFolder(path.with_name(f"{path.stem}_files"), ("",), r"-?\d+-\d+\.png")


def write_viewer(
    path: Path,
    viewer: Viewer,
    frames: Iterable[ShownFrame],
    *,
    within: int = WITHIN,
    save: Callable[[Path, str], None] = write_named,
) -> None:
    """Write the page, and the folder ``NAME_files`` beside it where pictures take more than ``within`` bytes.

    Args:
        path: the file.
        viewer: its contents.
        frames: at least one; made one after the other.
        within: see `WITHIN`.
        save: writes the file; the user named it, unless it says otherwise.

    Raises:
        InputError: it can't be written.
    """
    with ExitStack() as stack:
        store = _Store(path, within, lambda folder: stack.enter_context(folder.open(refusal=None)))
        places = [store.keep(frame) for frame in frames]
        data = {
            "views": [view.name for view in viewer.views],
            "left": viewer.pair[0],
            "right": viewer.pair[1],
            "frames": places,
            "pictures": store.places,
        }
        body = Template(asset("stss.pages", "viewer.html")).substitute(
            title=escape(printable(viewer.title)),
            notes="".join(f"<p>{escape(printable(note))}</p>" for note in viewer.notes),
            views="".join(f"<option>{escape(view.name)}</option>" for view in viewer.views),
            meanings="".join(f"<dt>{escape(v.name)}</dt><dd>{escape(v.meaning)}</dd>" for v in viewer.views),
            strip="".join(store.strip),
            plots="".join(viewer.plots),
            tables="".join(viewer.tables),
        )
        store.finish()
        scripts = [asset("stss.pages", name) for name in ("vendor/image-compare.min.js", "viewer.js")]
        save(path, page(viewer.title, body, styles=[asset("stss.pages", "viewer.css")], scripts=scripts, data=data))


class _Store:
    """Stores pictures where the page loads them from: inside it, or in files beside it. Equal pictures are stored once."""

    def __init__(self, path: Path, within: int, open_folder: Callable[[OutputFolder], None]):
        self.places: list[str] = []
        self.strip: list[str] = []
        self._path, self._room, self._open = path, within, open_folder
        self._numbers: dict[bytes, int] = {}
        self._folder: OutputFolder | None = None

    def keep(self, frame: ShownFrame) -> dict[str, object]:
        """Store a frame's pictures; returns the frame as the script reads it."""
        name = f"frame {frame.number}" + (f", {frame.kind}" if frame.kind else "")
        pictures = {view: self._picture(f"{frame.number:04d}-{i}.png", p) for i, (view, p) in enumerate(frame.pictures.items())}
        last = list(frame.pictures.values())[-1]
        small = _data(_png(_thumbnail(last)))
        label = f"{frame.number} {frame.kind}".strip()
        self.strip.append(
            f'<a href="#frame-{frame.number}" class="{escape(frame.kind)}"><img src="{small}" alt="" width="{THUMBNAIL}" '
            f'height="{round(THUMBNAIL * last.shape[0] / last.shape[1])}">{escape(label)}</a>'
        )
        height, width, _ = max((p.shape for p in frame.pictures.values()), key=lambda shape: shape[1])
        caption = f"{name}: {frame.caption}" if frame.caption else name
        return {"number": frame.number, "name": name, "caption": caption, "size": [width, height], "pictures": pictures}

    def finish(self) -> None:
        """Remove pictures of an earlier page from the folder beside this one."""
        if self._folder is None and page_folder(self._path).present():
            self._enter()
        if self._folder is not None:
            self._folder.finish(remove_others=True)

    def _picture(self, name: str, image: Image) -> int:
        data = _png(image)
        digest = hashlib.sha256(data).digest()
        if digest not in self._numbers:
            self._numbers[digest] = len(self.places)
            self._room -= len(data)
            self.places.append(_data(data) if self._room >= 0 else self._write(name, data))
        return self._numbers[digest]

    def _write(self, name: str, data: bytes) -> str:
        folder = self._folder or self._enter()
        folder.write(name, data)
        return f"{quote(folder.path.name)}/{name}"

    def _enter(self) -> OutputFolder:
        self._folder = page_folder(self._path)
        self._open(self._folder)
        return self._folder


def _png(image: Image) -> bytes:
    pixels = np.rint(np.clip(np.nan_to_num(image.astype(np.float64)), 0, 1) * 255).astype(np.uint8)
    return encode_png(Path("picture.png"), np.ascontiguousarray(pixels), {})


def _data(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"


def _thumbnail(image: Image) -> Array:
    size = THUMBNAIL, max(1, round(THUMBNAIL * image.shape[0] / image.shape[1]))
    return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
