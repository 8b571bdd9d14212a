# SPDX-License-Identifier: MIT
"""Transfers: from the renderer's colours to the display-referred values of the network, and back (spec section 9).

The sRGB curve is that of IEC 61966-2-1. It is evaluated in float64, so that rounding to float32 is the only loss, in blocks
that fit the processor's cache, and on all cores: on one, a frame of 1920 x 1080 would take longer than its network. It is ours,
though colour-science has it, and gives the same bits: that library and SciPy, which it needs, are 40 MB, and a second at each
start of ``stss run``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stss.images.headers import Value
from stss_ground.arguments import require_choice
from stss_ground.cores import for_blocks
from stss_ref.arrays import Array, require_finite, require_shape

TRANSFERS = ("none", "srgb")
"""The names that ``transfer`` takes."""

LARGEST = 65504.0
"""Largest number of half-precision EXR; larger scene-linear values are clipped to it."""

REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""Chromaticities x, y of red, green, blue and white: of Rec. 709 and sRGB, and of a file that names none."""
SAME_PRIMARIES = 1e-3
"""Chromaticities that differ by less are equal but for rounding."""

BLOCK = 1 << 15
"""Pixels converted at a time: few enough for the cache, so many that threads seldom wait for Python's lock. No row is longer."""

Float32 = NDArray[np.float32]
Pixels = NDArray[np.float64]
"""(N, 3) RGB."""
Curve = Callable[[Pixels], Pixels]


@dataclass(frozen=True)
class Transfer:
    """One transfer; get it from ``transfer(name)``.

    Attributes:
        name: one of ``TRANSFERS``.
        clips: scene-linear colour above 1 does not reach the network; it is carried past it (`stss.frames.carried_planes`).
    """

    name: str
    clips: bool
    _encode: Curve = field(repr=False)
    _decode: Curve = field(repr=False)
    _display: Curve = field(repr=False)

    def encode(self, color: Array) -> Float32:
        """From the renderer's domain to the network's.

        ``none``: clip to [0, 1]. ``srgb``: clip to [0, 1], then the sRGB curve.

        Source: spec 9.

        Args:
            color: (H, W, 3) as the renderer gave it: display-referred for ``none``, else scene-linear. NaN counts as 0.

        Returns:
            (H, W, 3) float32, display-referred, finite, in [0, 1].

        Raises:
            ArrayError: ``color`` is not (H, W, 3).
        """
        return _by_blocks("color", self._encode, color)

    def decode(self, image: Array) -> Float32:
        """From the network's domain back to the renderer's; the inverse of ``encode``.

        The network may leave [0, 1] a little: its image is clipped to it first.

        Args:
            image: (H, W, 3) display-referred, as the network gave it.

        Returns:
            (H, W, 3) float32, in [0, 1].

        Raises:
            ArrayError: ``image`` is not (H, W, 3), or holds NaN or Inf: a fault of the network that must not be hidden.
        """
        require_finite("image", image)
        return _by_blocks("image", self._decode, image)

    def display(self, color: Array) -> Float32:
        """Convert a frame in the renderer's domain to a screen's, for PNG and metrics.

        ``none``: clip to [0, 1]. ``srgb``: clip to [0, 1], then the sRGB curve: HDR is not tone mapped.

        Args:
            color: (H, W, 3) as for ``encode``.

        Returns:
            (H, W, 3) float32, in [0, 1].

        Raises:
            ArrayError: ``color`` is not (H, W, 3).
        """
        return _by_blocks("color", self._display, color)


def chromaticities(attributes: Mapping[str, Value]) -> tuple[float, ...]:
    """The chromaticities in a file's metadata, or `REC709`."""
    value = attributes.get("chromaticities")
    return tuple(map(float, value)) if isinstance(value, tuple) and len(value) == len(REC709) else REC709


def same_primaries(a: Iterable[float], b: Iterable[float] = REC709) -> bool:
    """Whether two sets of chromaticities are the same but for rounding."""
    return all(abs(x - y) < SAME_PRIMARIES for x, y in zip(a, b, strict=True))


def transfer(name: str) -> Transfer:
    """Return the transfer of this name; raises InputError for a name that is not in ``TRANSFERS``."""
    require_choice("transfer", name, TRANSFERS)
    return _TRANSFERS[name]


def _by_blocks(what: str, curve: Curve, image: Array) -> Float32:
    require_shape(what, image, (None, None, 3))
    pixels = image.reshape(-1, 3)
    result = np.empty(pixels.shape, np.float32)

    def convert(block: slice) -> None:
        result[block] = curve(pixels[block].astype(np.float64))

    for_blocks(len(pixels), BLOCK, convert)
    return result.reshape(image.shape)


def _clip(c: Pixels) -> Pixels:
    return np.minimum(np.where(c >= 0, c, 0.0), 1.0)  # NaN compares as False


def _encode_srgb(c: Pixels) -> Pixels:
    c = _clip(c)
    return np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


def _decode_srgb(e: Pixels) -> Pixels:
    e = _clip(e)
    return np.where(e <= 12.92 * 0.0031308, e / 12.92, ((e + 0.055) / 1.055) ** 2.4)


_TRANSFERS = {
    "none": Transfer("none", False, _clip, _clip, _clip),
    "srgb": Transfer("srgb", True, _encode_srgb, _decode_srgb, _encode_srgb),
}
