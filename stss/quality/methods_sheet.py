# SPDX-License-Identifier: MIT
"""A picture of all methods: the same small parts of their frames, one below the other, the truth last."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stss.images.contact_sheet import contact_sheet, magnify
from stss.images.read_write import read_rgb
from stss.quality.methods_table import MethodResult
from stss.quality.metrics import edges, to_8bit, upsample_holes
from stss.quality.output_and_truth import Pair, find_pairs
from stss_ref.arrays import Array, Mask

CROP = (48, 72)
"""H, W of each part shown; pixels of the output."""
ZOOM = 4
BRIGHTENED = 4
"""Factor by which the difference is brightened."""


@dataclass(frozen=True)
class Crop:
    """A part of a frame: ``crop`` is y, x, height, width in pixels of the output."""

    caption: str
    number: int
    crop: tuple[int, int, int, int]


def method_sheet(results: Sequence[MethodResult], truth: Path, frames: tuple[int, int] | None = None) -> Array:
    """Lay out the parts with most edges in the last SF and in the last EF, and the part with most holes of all EF.

    There is a row for each method and one for the truth, and two columns for each part: the frame, and its difference from the truth.

    Args:
        results: from `stss.quality.methods_table.run_methods`.
        truth: the folder of the truth.
        frames: first and last to choose from, both included; None: all.

    Returns:
        (H', W', 3) display-referred; see ``contact_sheet``.
    """
    by_method = [find_pairs(result.folder, truth, frames)[0] for result in results]
    places = _places(by_method[0])
    columns = [heading for place in places for heading in (place.caption, f"difference x{BRIGHTENED}")]
    rows = [(result.method, _cells(pairs, places)) for result, pairs in zip(results, by_method, strict=True)]
    rows.append(("truth", _cells(by_method[0], places, truth=True)))
    return contact_sheet(rows, columns, zoom=ZOOM)


def _places(pairs: dict[int, Pair]) -> list[Crop]:
    places: list[Crop] = []
    for kind in ("SF", "EF"):
        numbers = [n for n, pair in pairs.items() if pair.kind == kind]
        if numbers:
            number = max(numbers)
            _, truth = pairs[number].shown()
            places.append(Crop(f"{kind} {number}, edges", number, _densest(edges(to_8bit(truth)))))
    holes = {n: upsample_holes(read_rgb(pair.holes)[..., 0] > 0.5) for n, pair in pairs.items() if pair.holes is not None}
    most = max(holes, key=lambda n: int(holes[n].sum()), default=None)
    if most is not None and holes[most].any():
        places.append(Crop(f"EF {most}, holes", most, _densest(holes[most])))
    return places


def _densest(mask: Mask) -> tuple[int, int, int, int]:
    """The crop (y, x, height, width) with most pixels that are True; the first in raster order."""
    height, width = min(CROP[0], mask.shape[0]), min(CROP[1], mask.shape[1])
    total = np.pad(mask.astype(np.float64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    within = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    y, x = np.unravel_index(int(within.argmax()), within.shape)
    return int(y), int(x), height, width


def _cells(pairs: dict[int, Pair], places: Sequence[Crop], *, truth: bool = False) -> list[Array]:
    cells: list[Array] = []
    for place in places:
        output, right = (magnify(image, place.crop, 1) for image in pairs[place.number].shown())
        shown = right if truth else output
        cells += [shown, np.clip(BRIGHTENED * np.abs(shown - right), 0, 1)]
    return cells
