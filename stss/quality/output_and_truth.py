# SPDX-License-Identifier: MIT
"""Pair the frames of an output and a truth, and read the metadata of the output's files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from stss.images.color import TRANSFERS, Transfer, chromaticities, same_primaries, transfer
from stss.images.headers import Header, Value, read_header
from stss.images.read_write import read_rgb
from stss.images.windows import union
from stss.sequence.find_files import numbered_files, split_pattern
from stss.sequence.raw_frame import NonFinite
from stss_ground.errors import InputError
from stss_ref.arrays import Image

KINDS = ("SF", "EF")
SUFFIXES = (".png", ".exr")
MADE_WITH = ("method", "weights", "backend", "transfer")
FALLBACK = "srgb"
"""The transfer for files that name none."""
_USUAL_SPACES = {
    ".exr": ("linear Rec. 709", re.compile(r"scene_linear|lin(ear)?([ _](rec\.?709|srgb).*)?", re.IGNORECASE)),
    ".png": ("sRGB", re.compile(r"(gimp built-in )?srgb(?!_p3).*", re.IGNORECASE)),
}
"""Suffix -> the colours of files without a tag, and its names in tags."""
DIFFERENCES = {"chromaticities": "not converted", "colours": "not converted", "data windows": "black outside of them"}
"""Property that may differ between output and truth -> how they are compared all the same."""


@dataclass(frozen=True)
class Pair:
    """An output, its truth, and the metadata of the output's file.

    Attributes:
        output: the file to score.
        truth: the file to compare it with.
        kind: "SF" or "EF"; None where the file does not say.
        transfer: the transfer by which its colours are shown; None where the file does not say.
        holes: the file of its warping holes; None without one.
        static_holes: the share of its static surfaces that are holes, where the file says it.
        made_with: method, weights, backend and transfer, as far as the file names them.
        differences: name of `DIFFERENCES` -> the output's words and the truth's, where they differ.
        non_finite: values that are not finite: "refuse" them, or "mask": 0.
    """

    output: Path
    truth: Path
    kind: str | None
    transfer: str | None
    holes: Path | None
    static_holes: float | None
    made_with: Mapping[str, str]
    differences: Mapping[str, tuple[str, str]] = field(default_factory=dict[str, tuple[str, str]])
    non_finite: NonFinite = "refuse"

    def load(self) -> tuple[Image, Image]:
        """Output and truth as a screen shows them: (H, W, 3) float32, in [0, 1].

        Raises:
            InputError: sizes differ, or a value is not finite and is not to be masked.
        """
        curve = transfer(self.transfer or FALLBACK)
        image, truth = (read_shown(path, curve, self.non_finite) for path in (self.output, self.truth))
        require_size(self.truth, truth, self.output, image.shape[:2])
        return image, truth


def read_shown(path: Path, curve: Transfer, non_finite: NonFinite = "refuse") -> Image:
    """An EXR's or PNG's colours as a screen shows them: (H, W, 3) float32, in [0, 1]. A PNG has such colours.

    Raises:
        InputError: as `stss.images.read_write.read_rgb`; or a value is not finite and is not to be masked.
    """
    image = read_rgb(path)
    if path.suffix.lower() != ".exr":
        return image
    bad = ~np.isfinite(image)
    if bad.any() and non_finite == "refuse":
        y, x, channel = np.argwhere(bad)[0]
        problem = f"{int(bad.sum())} non-finite values, first in {'RGB'[channel]} at (y={y}, x={x})"
        raise InputError(f"{path}: {problem}; --non-finite mask takes them as 0")
    return curve.display(np.where(bad, np.float32(0), image))


def find_pairs(
    out: Path,
    truth: Path,
    frames: tuple[int, int] | None = None,
    non_finite: NonFinite = "refuse",
    holes: Path | None = None,
) -> tuple[dict[int, Pair], list[int], list[int]]:
    """Find the frames that two folders have in common, by number, and those that only the first or only the second has.

    Args:
        out: written by `stss run`, or by anything that numbers its files.
        truth: likewise.
        frames: first and last to include; None: all.
        non_finite: see `Pair`.
        holes: the folder of a run. Its masks of warping holes replace those of ``out``, and its kinds and transfer those that the files of
            ``out`` do not name. None: those of ``out``.

    Raises:
        InputError: a folder is not there, the two have no frame in common, or a file cannot be read.
    """
    outputs, truths = find_images(out, frames), find_images(truth, frames)
    pairs = {n: _pair(outputs[n], truths[n], non_finite) for n in sorted(outputs.keys() & truths.keys())}
    if holes is not None:
        run = {n: _kind_and_transfer(path, read_header(path).attributes) for n, path in find_images(holes, frames).items()}
        is_rendered = run and all(kind == "SF" for kind, _ in run.values())  # every frame: then none has holes
        masks = {} if is_rendered else find_images(holes / "holes", frames)
        pairs = {n: _as_in_run(pair, *run.get(n, (None, None)), masks.get(n)) for n, pair in pairs.items()}
    for folder, images in ((out, outputs), (truth, truths)):
        if not images and frames is None:
            kinds = sorted({path.suffix for path in folder.iterdir()} - {"", *SUFFIXES})[:5]
            others = f"; found {', '.join(kinds)}" if kinds else ""
            raise InputError(f"{folder}: no frames; expected files named like NAME.0001.exr or NAME.0001.png{others}")
    if not pairs:
        there = f"found {list_numbers(truths)}" + (f" within {frames[0]} to {frames[1]}" if frames else "")
        raise InputError(f"{truth}: expected a frame that {out} has, one of {list_numbers(outputs)}; {there}")
    return pairs, sorted(outputs.keys() - truths.keys()), sorted(truths.keys() - outputs.keys())


def require_size(path: Path, image: Image, other: Path, size: tuple[int, ...]) -> None:
    """Raise InputError unless the image of ``path`` has ``size`` (H, W, ...), the size that goes with ``other``."""
    if image.shape[:2] != size:
        want, got = (f"{width} x {height}" for height, width in (size, image.shape[:2]))
        raise InputError(f"{path}: expected {want} pixels to go with {other}, found {got}")


def list_numbers(numbers: Iterable[int]) -> str:
    """Numbers in words: "frames 1 to 5, 7", "frame 7", "no frames"."""
    runs: list[list[int]] = []
    for n in sorted(numbers):
        if runs and n == runs[-1][1] + 1:
            runs[-1][1] = n
        else:
            runs.append([n, n])
    if not runs:
        return "no frames"
    several = len(runs) > 1 or runs[0][0] < runs[0][1]
    return ("frames " if several else "frame ") + ", ".join(f"{a} to {b}" if a < b else str(a) for a, b in runs)


def find_images(folder: Path, frames: tuple[int, int] | None = None) -> dict[int, Path]:
    """EXR and PNG files by frame number: the last digits of the name without its suffix, or the ``####`` of a pattern.

    Raises:
        InputError: there is no such folder, no file of the pattern, or a number appears twice.
    """
    place, pattern = split_pattern(folder, SUFFIXES)
    if not place.is_dir():
        raise InputError(f"{folder}: " + ("expected a folder, found a file" if folder.exists() else "no such folder"))
    files: dict[int, Path] = {}
    suffixes = SUFFIXES if pattern is None or folder.suffix.lower() not in SUFFIXES else (folder.suffix.lower(),)
    images = [p for p in place.iterdir() if p.suffix.lower() in suffixes and not p.name.startswith(".")]
    in_order = sorted(images, key=lambda p: (p.suffix.lower() != ".png", p.name))
    for path, before, number, _, after in numbered_files(in_order, "" if pattern is None else pattern.end):
        if pattern is not None and (before, after) != pattern:
            continue
        if number in files and files[number].stem != path.stem:
            names = f"{files[number].name}, {path.name}"
            raise InputError(f"{folder}: frame {number} appears twice: {names}; give one as a pattern, like NAME.####.exr")
        if frames is None or frames[0] <= number <= frames[1]:
            files[number] = path  # an EXR comes after a PNG of its name and replaces it
    if pattern is not None and not files and frames is None:
        raise InputError(f"{folder}: no frames")
    return files


def _pair(output: Path, truth: Path, non_finite: NonFinite) -> Pair:
    headers = read_header(output), read_header(truth)
    attributes = headers[0].attributes
    made_with = {name: str(attributes[f"stss:{name}"]) for name in MADE_WITH if f"stss:{name}" in attributes}
    kind, domain = _kind_and_transfer(output, attributes)
    holes = output.parent / "holes" / f"{output.stem}.png"
    share = _share(output, attributes.get("stss:static-holes"))
    return Pair(output, truth, kind, domain, holes if holes.exists() else None, share, made_with, _differ(*headers), non_finite)


def _as_in_run(pair: Pair, kind: str | None, domain: str | None, holes: Path | None) -> Pair:
    """The pair with a run's holes, and with its kind and transfer if the output's own file names none."""
    return replace(pair, kind=pair.kind or kind, transfer=pair.transfer or domain, holes=holes)


def _kind_and_transfer(path: Path, attributes: Mapping[str, Value]) -> tuple[str | None, str | None]:
    """The kind of frame, and the transfer, as far as a file's metadata say them."""
    kind, domain = (attributes.get(f"stss:{name}") for name in ("kind", "transfer"))
    if kind not in (*KINDS, None):
        raise InputError(f"{path}: stss:kind: expected {' or '.join(KINDS)}, found {kind!r}")
    if domain not in (*TRANSFERS, None):
        raise InputError(f"{path}: stss:transfer: expected one of {', '.join(TRANSFERS)}, found {domain!r}")
    return None if kind is None else str(kind), None if domain is None else str(domain)


def _differ(output: Header, truth: Header) -> dict[str, tuple[str, str]]:
    """The words of both files where they differ, by the names of `DIFFERENCES`."""
    words: dict[str, tuple[str, str]] = {}
    ours, theirs = chromaticities(output.attributes), chromaticities(truth.attributes)
    spaces = _space(output), _space(truth)
    if not same_primaries(ours, theirs):
        words["chromaticities"] = _listing(ours), _listing(theirs)
    elif spaces[0] != spaces[1] and {*spaces} != {usual for usual, _ in _USUAL_SPACES.values()}:
        words["colours"] = spaces
    windows = union(output.windows.values()), union(truth.windows.values())
    if windows[0].within(output.display) != windows[1].within(truth.display):
        words["data windows"] = str(windows[0]), str(windows[1])
    return words


def _space(header: Header) -> str:
    """The colours that a file is tagged with, by one name where they are its format's usual ones.

    ``oiio:ColorSpace`` is OpenImageIO's name for an EXR's ``colorInteropID``, and for a PNG's gamma and code points.
    """
    usual, names = _USUAL_SPACES[header.path.suffix.lower()]
    tag = str(header.attributes.get("ICCProfile:profile_description") or header.attributes.get("oiio:ColorSpace") or usual)
    return usual if names.fullmatch(tag) else tag


def _listing(numbers: Iterable[float]) -> str:
    return ", ".join(f"{x:.4g}" for x in numbers)


def _share(path: Path, text: Value | None) -> float | None:
    """A share in a file's metadata, if it is there."""
    try:
        share = None if text is None else float(str(text))
    except ValueError:
        share = -1.0
    if share is not None and not 0 <= share <= 1:
        raise InputError(f"{path}: stss:static-holes: expected a number from 0 to 1, found {text!r}")
    return share
