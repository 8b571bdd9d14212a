# SPDX-License-Identifier: MIT
"""Contact sheets: images side by side with labels, enlarged so that single pixels can be judged."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from stss_ref.arrays import Array, require_shape

COMPARISON = ("input", "bilinear", "output", "truth", "difference x4")
"""Columns of `comparison`."""

_PAPER, _INK, _FAINT = 0.13, 0.92, 0.62
_MARGIN, _GAP = 20, 8
_HEADER, _CAPTION = 34, 26  # pixels of height: above the columns; above each row
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def contact_sheet(
    rows: Sequence[tuple[str, Sequence[Array]]],
    columns: Sequence[str],
    *,
    crop: tuple[int, int, int, int] | None = None,
    zoom: int = 1,
) -> Array:
    """Lay images out as a labelled grid.

    Args:
        rows: a caption and the images of each row, (H, W, 3), display-referred, clipped to 0..1; all of one size.
        columns: a caption for each column.
        crop: y, x, height, width of the part of every image to show; None shows all.
        zoom: pixels of the sheet in each direction for one pixel of an image.

    Returns:
        (H', W', 3) display-referred, in 0..1, dark grey around the images.

    Raises:
        ArrayError: an image differs in size from the first.
        ValueError: there is no image, a row does not have as many images as ``columns``, or the crop lies outside the images.
    """
    for caption, images in rows:
        if not images or len(images) != len(columns):
            raise ValueError(f"row {caption!r}: expected {len(columns)} images, at least 1, got {len(images)}")
    if not rows:
        raise ValueError("rows: expected at least 1, got none")
    shape = rows[0][1][0].shape
    cells = [[magnify(_checked(image, shape), crop, zoom) for image in images] for _, images in rows]
    height, width, _ = cells[0][0].shape
    tops = [_MARGIN + _HEADER + i * (height + _CAPTION + _GAP) + _CAPTION for i in range(len(rows))]
    lefts = [_MARGIN + i * (width + _GAP) for i in range(len(columns))]

    sheet = np.full((tops[-1] + height + _MARGIN, lefts[-1] + width + _MARGIN, 3), _PAPER)
    for text, left in zip(columns, lefts, strict=True):
        _write(sheet, text, (left, _MARGIN + 18), 0.62, _INK, room=width)
    for (caption, _), top, images in zip(rows, tops, cells, strict=True):
        _write(sheet, caption, (lefts[0], top - 8), 0.46, _FAINT, room=lefts[-1] + width - lefts[0])
        for image, left in zip(images, lefts, strict=True):
            sheet[top : top + height, left : left + width] = image
    return sheet


def magnify(image: Array, crop: tuple[int, int, int, int] | None, zoom: int) -> Array:
    """Repeat each pixel of ``crop`` (y, x, height, width; None = all) of an (H, W, C) image ``zoom`` times each way."""
    y, x, height, width = crop or (0, 0, *image.shape[:2])
    if y < 0 or x < 0 or height < 1 or width < 1 or y + height > image.shape[0] or x + width > image.shape[1]:
        raise ValueError(f"crop: expected to lie within {image.shape[:2]}, got y, x, height, width = {crop}")
    return image[y : y + height, x : x + width].repeat(zoom, axis=0).repeat(zoom, axis=1)


def comparison(low: Array, output: Array, truth: Array) -> list[Array]:
    """The images of one row under the columns `COMPARISON`.

    Args:
        low: (H, W, 3) the rendered frame, display-referred.
        output: (2H, 2W, 3) the output made from it.
        truth: (2H, 2W, 3) the frame that the output should equal.
    """
    height, width, _ = low.shape
    for name, image in (("output", output), ("truth", truth)):
        require_shape(name, image, (2 * height, 2 * width, 3))
    # INTER_LINEAR is bilinear about pixel centres: the grid of spec section 7, corners not aligned.
    bilinear = cv2.resize(low.astype(np.float32), (2 * width, 2 * height), interpolation=cv2.INTER_LINEAR)
    return [magnify(low, None, 2), bilinear.astype(np.float32), output, truth, 4 * np.abs(output - truth)]


def _checked(image: Array, shape: tuple[int, ...]) -> Array:
    require_shape("image", image, (shape[0], shape[1], 3))
    return np.clip(image, 0, 1)


def _write(sheet: Array, text: str, at: tuple[int, int], scale: float, ink: float, *, room: int) -> None:
    """Draw ``text`` with its base line at ``at`` (x, y), smaller where it would be wider than ``room``, and never beyond that."""
    (width, _), _ = cv2.getTextSize(text, _FONT, scale, 1)
    cover = np.zeros(sheet.shape[:2], np.uint8)
    cv2.putText(cover, text, at, _FONT, scale * min(1.0, room / max(width, 1)), (255.0,), 1, cv2.LINE_AA)
    cover[:, at[0] + room :] = 0  # OpenCV 4 measures small letters too narrow
    sheet += (ink - sheet) * (cover[..., None] / 255)
