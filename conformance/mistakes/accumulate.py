# SPDX-License-Identifier: MIT
"""Mistakes in stage accumulate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from conformance.mistakes.image import READS
from conformance.protocol.reference_copy import Copy, Mistake, change_arguments, fault, put, returns, wrap
from stss_ref.accumulate import box
from stss_ref.constants import EARLIER_SHARE
from stss_ref.resample import upsample_centres
from stss_ref.sample import lerp
from stss_ref.warp import warp

Change = Callable[..., Any]
Step = tuple[int, ...]
LUMA = np.array([0.25, 0.5, 0.25])
NINE = [*product((-1, 0, 1), repeat=2)]
_accumulate = partial(fault, "accumulate")


def _takes(name: str, what: str, **changes: Change) -> Mistake:
    """The stage is given others."""
    return _accumulate(name, what, change_arguments("accumulate.accumulate", **changes))


def _moves(name: str, what: str, change: Change) -> Mistake:
    """Display pixels get motion by another ``change`` of the low-resolution motion to twice the size."""
    return _accumulate(name, what, change_arguments("accumulate.warp", motion=lambda moved: change(moved[::2, ::2])))


def _box(name: str, what: str, change: Change) -> Mistake:
    return _accumulate(name, what, put("accumulate.box", change))


def _mean(name: str, what: str, mean: Callable[[Any, Any], Any], **marks: Any) -> Mistake:
    """The mean of the image and the clamped one; only where motion leads into the frame."""
    return _accumulate(name, what, put("accumulate.lerp", lambda image, history, _: mean(image, history)), **marks)


def _over(steps: Sequence[Step], tile: int = 1 << 30) -> Change:
    """A box over pixels so many rows and columns away, as far as they lie in the frame and in the own tile."""

    def extremes(image: Any) -> Any:
        places = np.indices(image.shape[:2])
        around: list[Any] = []
        for step in steps:
            y, x = (np.clip(p + s, 0, n - 1) for p, s, n in zip(places, step, image.shape[:2], strict=True))
            same = (y // tile == places[0] // tile) & (x // tile == places[1] // tile)
            around.append(np.where(same[..., None], image[y, x], image))
        return np.minimum.reduce(around), np.maximum.reduce(around)

    return extremes


def _of_low_pixel(image: Any) -> Any:
    height, width, channels = image.shape
    blocks = image.reshape(height // 2, 2, width // 2, 2, channels)
    return tuple(extreme(blocks, axis=(1, 3)).repeat(2, axis=0).repeat(2, axis=1) for extreme in (np.min, np.max))


def _black_outside(image: Any) -> Any:
    low, high = box(np.pad(image, ((1, 1), (1, 1), (0, 0))))
    return low[1:-1, 1:-1], high[1:-1, 1:-1]


def _one_for_all(image: Any) -> Any:
    low, high = box(image)
    return tuple(np.broadcast_to(a, image.shape) for a in (low.min(axis=-1, keepdims=True), high.max(axis=-1, keepdims=True)))


def _deviations(image: Any) -> Any:
    """Mean and standard deviation, as in Salvi, An Excursion in Temporal Supersampling, GDC 2016."""
    height, width, _ = image.shape
    padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge")
    around = np.stack([padded[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y, x in NINE])
    mean, spread = around.mean(axis=0), around.std(axis=0)
    return mean - spread, mean + spread


def _by_luma(right: Change, image: Any, before: Any, motion: Any) -> Any:
    """The colours are the image's own, and their luma is the mean's."""
    own, other = (np.broadcast_to((a * LUMA.astype(a.dtype)).sum(axis=-1, keepdims=True), a.shape) for a in (image, before))
    return image + (right(own, other, motion) - own)


def _box_of_before(copy: Copy) -> None:
    earlier: list[Any] = []

    def whole(right: Change, image: Any, before: Any, motion: Any) -> Any:
        earlier[:] = [before]
        return right(image, before, motion)

    wrap("accumulate.accumulate", whole)(copy)
    wrap("accumulate.box", lambda right, _: right(earlier[0]))(copy)


def _image_clamped(image: Any, before: Any, motion: Any) -> Any:
    history, inside = warp(before, (2 * motion).repeat(2, axis=0).repeat(2, axis=1))
    return np.where(inside[..., None], lerp(np.clip(image, *box(history)), history, EARLIER_SHARE), image)


def _halves(moved: Any) -> Any:
    """Of each display pixel p, that of pixel (p + 1) / 2."""
    rows, columns = (np.minimum((np.arange(2 * n) + 1) // 2, n - 1) for n in moved.shape[:2])
    return moved[rows][:, columns]


ACCUMULATE = (
    _takes("undoubled", "low-resolution motion for display pixels", motion=lambda motion: motion / 2),
    _takes("backwards", "follows the motion backwards", motion=np.negative),
    _takes("lost_at_its_place", "non-finite motion counts as 0", motion=lambda motion: np.where(np.isfinite(motion), motion, 0)),
    _takes("images_swapped", "the two images swapped", image=lambda _, before: before, before=lambda _, image: image),
    _moves("motion_between", "reads the motion bilinearly", upsample_centres),
    _moves("motion_of_next", "every odd pixel has the motion of the next one", _halves),
    _moves("motion_repeated", "repeats the motion as a whole, not each pixel's", lambda moved: np.tile(moved, (2, 2, 1))),
    _box("unclamped", "no box", lambda image: (image - np.inf, image + np.inf)),
    _box("box_of_5", "a box of 5 x 5", _over([*product(range(-2, 3), repeat=2)])),
    _box("box_of_1", "a box of the pixel alone: nothing is mixed", _over([(0, 0)])),
    _box("cross", "a box of the pixel and the four beside it", _over([(0, 0), (0, 1), (1, 0), (0, -1), (-1, 0)])),
    _box("ring", "a box without the pixel itself", _over([step for step in NINE if step != (0, 0)])),
    _box("box_of_low_pixel", "a box of the low-resolution pixel", _of_low_pixel),
    _box("black_outside", "0 outside the frame belongs to the box", _black_outside),
    _box("box_of_all_channels", "one box for all channels", _one_for_all),
    _box("deviations", "a box of one standard deviation", _deviations),
    _box("tile_halo", "boxes end at tiles of 16 x 16", _over(NINE, 16)),
    _accumulate("half", "one half of each", put("accumulate.EARLIER_SHARE", 0.5)),
    _accumulate("shares_swapped", "5/8 of the earlier image", put("accumulate.EARLIER_SHARE", 0.625)),
    _accumulate("not_mixed", "the image as it is", put("accumulate.EARLIER_SHARE", 0.0)),
    _accumulate(
        "edge_of_the_frame", "off screen the nearest pixel of the frame",
        returns("accumulate.warp", lambda result: (result[0], np.ones_like(result[1]))),
    ),
    _accumulate("luma_alone", "mixes and clamps the luma alone", wrap("accumulate.accumulate", _by_luma)),
    _accumulate("box_of_before", "the box of the earlier image", _box_of_before),
    _accumulate("image_clamped", "clamps the image, not the earlier one", put("accumulate.accumulate", _image_clamped)),
    _accumulate("up_to_1", "colours end at 0 and 1", returns("accumulate.accumulate", lambda shown: shown.clip(0, 1))),
    _accumulate("bgr", "colours of the earlier image in reverse", change_arguments("accumulate.warp", color=lambda c: c[..., ::-1])),
    _mean("products", "5/8 a + 3/8 b: what rests does not stay", lambda a, b: a * 0.625 + b * 0.375, bits=True),
    *(_accumulate(name, what, change_arguments("accumulate.warp", color=change), large=True) for name, what, change in READS),
)  # fmt: skip
