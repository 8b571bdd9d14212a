# SPDX-License-Identifier: MIT
"""Display frames that flicker less: each is mixed with the one shown before it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from stss.frames.display_frame import DisplayFrame
from stss_cl.cost import Cost
from stss_ref.arrays import Image, Mask

if TYPE_CHECKING:
    from stss.frames.backends import Backend

Accumulate = Callable[[Image, Image, Image], Image]
"""Stage ``accumulate``: from image, the image shown before, and motion to the image to show."""


class Accumulation:
    """A backend (``stss.frames.backends.Backend``) that puts stage ``accumulate`` behind another one.

    A frame continues the one before it in its window, which must have been computed last of its sequence; otherwise, as at a cut, it is
    shown as it is.
    """

    accumulates = True

    def __init__(self, backend: Backend, accumulate: Accumulate):
        self.name, self.method = f"{backend.name}, accumulate", backend.method
        self._backend, self._accumulate = backend, accumulate
        self._images: dict[int, Image] = {}
        """The id of the last frame of each sequence under way -> its image; gone with the frame."""

    @property
    def cost(self) -> Cost | None:
        """See ``Backend``: the network's."""
        return self._backend.cost

    def expect(self, size: tuple[int, int]) -> None:
        """See ``Backend``."""
        self._backend.expect(size)
        height, width = size
        image = np.zeros((2 * height, 2 * width, 3), np.float32)
        self._accumulate(image, image, np.zeros((height, width, 2), np.float32))  # a kernel is compiled when it is launched first

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[Image, Mask]:
        """See ``Backend``."""
        image, valid = self._backend.compute(window, steps)
        before = self._images.pop(id(window[-2]), None) if len(window) > 1 else None
        if before is not None:
            image = self._accumulate(image, before, window[-1].motion)
        self._images[id(window[-1])] = image
        weakref.finalize(window[-1], self._images.pop, id(window[-1]), None)
        return image, valid
