# SPDX-License-Identifier: MIT
"""Mistakes in stage accumulate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from conformance.mistakes.image import READS
from conformance.protocol.reference_copy import Copy, Mistake, change_arguments, fault, half, put, returns, wrap
from stss_ref.accumulate import box, slowness
from stss_ref.constants import EARLIER_SHARES, SLOW
from stss_ref.resample import upsample_centres
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


def _by_luma(right: Change, image: Any, earlier: Any, motions: Any) -> Any:
    """The colours are the image's own, and their luma is the mean's."""
    own, others = (np.broadcast_to((a * LUMA.astype(a.dtype)).sum(axis=-1, keepdims=True), a.shape) for a in (image, earlier))
    return image + (right(own, others, motions) - own)


def _box_of_before(copy: Copy) -> None:
    newest: list[Any] = []

    def whole(right: Change, image: Any, earlier: Any, motions: Any) -> Any:
        newest[:] = earlier[:1]
        return right(image, earlier, motions)

    wrap("accumulate.accumulate", whole)(copy)
    wrap("accumulate.box", lambda right, _: right(newest[0]))(copy)


def _moved(image: Any, earlier: Any, motions: Any) -> list[tuple[Any, Any]]:
    """Each earlier image, moved, the image itself where motion leads out of the frame; and how much of its share it has."""
    pairs = [warp(a, _to_display(2 * m)) for a, m in zip(earlier, motions, strict=True)]
    slow = [_to_display(slowness(motion)) for motion in motions]
    return [
        (np.where(inside[..., None], moved, image), np.where(inside[..., None], w, 0))
        for (moved, inside), w in zip(pairs, slow, strict=True)
    ]


def _to_display(plane: Any) -> Any:
    return plane.repeat(2, axis=0).repeat(2, axis=1)


def _image_clamped(image: Any, earlier: Any, motions: Any) -> Any:
    moved = zip(_moved(image, earlier, motions), EARLIER_SHARES, strict=False)
    return image + sum((a - np.clip(image, *box(a))) * weight * share for (a, weight), share in moved)


def _mean_clamped(image: Any, earlier: Any, motions: Any) -> Any:
    parts = [(a, w * share) for (a, w), share in zip(_moved(image, earlier, motions), EARLIER_SHARES, strict=False)]
    total = sum(share for _, share in parts)
    mean = image + sum((a - image) * share for a, share in parts) / np.maximum(total, np.finfo(image.dtype).tiny)
    return image + (np.clip(mean, *box(image)) - image) * total


def _both_or_none(right: Change, image: Any, earlier: Any, motions: Any) -> Any:
    inside = np.logical_and.reduce([weight > 0 for _, weight in _moved(image, earlier, motions)])
    return np.where(inside, right(image, earlier, motions), image)


def _other_instead(right: Change, image: Any, earlier: Any, motions: Any) -> Any:
    """Where one motion leads out of the frame, or there is one image, it has the shares of both."""
    there = [weight > 0 for _, weight in _moved(image, earlier, motions)]
    shares = sum(inside * share for inside, share in zip(there, EARLIER_SHARES, strict=False))
    more = np.where(shares > 0, sum(EARLIER_SHARES) / np.maximum(shares, EARLIER_SHARES[-1]), 1)
    return image + (right(image, earlier, motions) - image) * more.astype(image.dtype)


def _by_newer_slowness(image: Any, earlier: Any, motions: Any) -> Any:
    moved = _moved(image, earlier, motions)
    slow = _to_display(slowness(motions[0]))
    low, high = box(image)
    parts = zip(moved, EARLIER_SHARES, strict=False)
    return image + sum(np.where(weight > 0, np.clip(a, low, high) - image, 0) * slow * share for (a, weight), share in parts)


def _products(image: Any, earlier: Any, motions: Any) -> Any:
    """The sum of products, in place of a sum of differences."""
    parts = [(a, w * share) for (a, w), share in zip(_moved(image, earlier, motions), EARLIER_SHARES, strict=False)]
    low, high = box(image)
    return image * (1 - sum(share for _, share in parts)) + sum(np.clip(a, low, high) * share for a, share in parts)


def _one_by_one(right: Change, image: Any, earlier: Any, motions: Any) -> Any:
    """Mixes the older image into the newer one, and the result into the image."""
    for a, m in zip(earlier[::-1], motions[::-1], strict=True):
        image = right(image, a[None], m[None])
    return image


def _halves(moved: Any) -> Any:
    """Of each display pixel p, that of pixel (p + 1) / 2."""
    rows, columns = (np.minimum((np.arange(2 * n) + 1) // 2, n - 1) for n in moved.shape[:2])
    return moved[rows][:, columns]


ACCUMULATE = (
    _accumulate("half_output", "shown in half precision", returns("accumulate.accumulate", half)),
    _takes("undoubled", "low-resolution motion for display pixels", motions=lambda motions: motions / 2),
    _takes("backwards", "follows the motion backwards", motions=np.negative),
    _takes("lost_at_its_place", "non-finite motion counts as 0", motions=lambda motions: np.where(np.isfinite(motions), motions, 0)),
    _takes(
        "images_swapped", "the image swapped with the newest of the earlier ones",
        image=lambda _, earlier: earlier[0], earlier=lambda earlier, image: np.stack([image, *earlier[1:]]),
    ),
    _takes("oldest_first", "the two earlier images in the other order", earlier=lambda earlier: earlier[::-1]),
    _takes("motion_of_newest", "both earlier images by the newer one's motion", motions=lambda motions: motions[[0] * len(motions)]),
    _takes("unchained", "the older image by that frame's own motion", motions=lambda m: np.stack([m[0], *(m[1:] - m[:1])])),
    _takes("newest_alone", "the older image is left out", earlier=lambda earlier: earlier[:1], motions=lambda motions: motions[:1]),
    _takes("oldest_alone", "the older image alone", earlier=lambda earlier: earlier[-1:], motions=lambda motions: motions[-1:]),
    _takes("newest_twice", "the newer image twice", earlier=lambda earlier: earlier[[0, 0]], motions=lambda motions: motions[[0, 0]]),
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
    *(
        _accumulate(name, what, put("accumulate.EARLIER_SHARES", shares))
        for name, what, shares in (
            ("shares_swapped", "1/8 of the newer image, 1/4 of the older", (0.125, 0.25)),
            ("equal_shares", "3/16 of each earlier image", (0.1875, 0.1875)),
            ("newer_alone", "3/8 of the newer image alone", (0.375, 0.0)),
            ("eighth_of_the_rest", "of the older image 1/8 of the rest", (0.25, 0.09375)),
            ("not_mixed", "the image as it is", (0.0, 0.0)),
        )
    ),
    *(
        _accumulate(f"slowness_{name}", what, put("accumulate.slowness", change))
        for name, what, change in (
            ("left_out", "a share whatever the motion", lambda motion: np.ones_like(motion[..., :1])),
            ("by_length", "a share by the length of the motion, not by its square", lambda motion: np.sqrt(slowness(motion))),
            ("on_the_display", "a share by twice the motion", lambda motion: slowness(2 * motion)),
            ("from_0_on", "16 / (16 + length^2)", lambda motion: SLOW**2 / (SLOW**2 + np.square(motion).sum(-1, keepdims=True))),
            ("across", "a share by the motion across", lambda motion: slowness(motion[..., :1])),
            ("down", "a share by the motion down", lambda motion: slowness(motion[..., 1:])),
            ("by_sum", "a share by |dx| + |dy|", lambda motion: slowness(np.abs(motion).sum(-1, keepdims=True))),
            ("nothing_beyond", "no share of surfaces that move by more than 4 pixels", lambda motion: slowness(motion) >= 1),
        )
    ),
    _accumulate("slowness_of_newest", "both shares by the newer motion", put("accumulate.accumulate", _by_newer_slowness)),
    _accumulate(
        "edge_of_the_frame", "off screen the nearest pixel of the frame",
        returns("accumulate.warp", lambda result: (result[0], np.ones_like(result[1]))),
    ),
    _accumulate("luma_alone", "mixes and clamps the luma alone", wrap("accumulate.accumulate", _by_luma)),
    _accumulate("box_of_before", "the box of the earlier image", _box_of_before),
    _accumulate("image_clamped", "clamps the image, not the earlier ones", put("accumulate.accumulate", _image_clamped)),
    _accumulate("mean_clamped", "clamps the mean of the earlier images", put("accumulate.accumulate", _mean_clamped)),
    _accumulate("one_by_one", "mixes one image after the other", wrap("accumulate.accumulate", _one_by_one)),
    _accumulate("both_or_none", "the image alone where either motion leads out", wrap("accumulate.accumulate", _both_or_none)),
    _accumulate("other_instead", "the other image twice where one motion leads out", wrap("accumulate.accumulate", _other_instead)),
    _accumulate("up_to_1", "colours end at 0 and 1", returns("accumulate.accumulate", lambda shown: shown.clip(0, 1))),
    _accumulate("bgr", "colours of the earlier image in reverse", change_arguments("accumulate.warp", color=lambda c: c[..., ::-1])),
    _accumulate("products", "a sum of products: what rests does not stay", put("accumulate.accumulate", _products), bits=True),
    *(_accumulate(name, what, change_arguments("accumulate.warp", color=change), large=True) for name, what, change in READS),
)  # fmt: skip
