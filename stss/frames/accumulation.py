# SPDX-License-Identifier: MIT
"""Display frames that flicker less: each image is mixed with those of the two display frames before it."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stss.frames.compute_options import ComputeOptions
from stss.frames.display_frame import WINDOW, BackendImage, DisplayFrame, schedule_of
from stss.images.color import Transfer
from stss.weights.file import LoadedWeights
from stss_cl.cost import Cost
from stss_ref.accumulate import accumulate
from stss_ref.arrays import Image, Mask
from stss_ref.constants import EARLIER_SHARES
from stss_ref.motion_chain import chain_steps

if TYPE_CHECKING:
    from stss.frames.backends import Backend

EARLIER = len(EARLIER_SHARES)
"""Earlier images that one is mixed with."""
Accumulate = Callable[[BackendImage, Sequence[BackendImage], Sequence[Image]], BackendImage]
"""From an image, the earlier ones, newest first, and the motion of each of these display frames to the one before it, newest
first."""


def accumulates(weights: LoadedWeights, options: ComputeOptions) -> bool:
    """Whether images are mixed: as the options say, else where the weights are made for aliased input."""
    return weights.made_for_aliased if options.accumulate is None else options.accumulate


def accumulate_arrays(image: Image, earlier: Sequence[Image], motions: Sequence[Image]) -> Image:
    """The reference, as `Accumulate`."""
    return accumulate(image, np.stack(earlier), np.stack([*chain_steps(np.stack(motions))]))


@dataclass(frozen=True)
class _Kept:
    """The images of a display frame that are kept.

    Attributes:
        image: as the backend made it.
        again: the image that was shown, if ``image`` is that of two frames before and nothing moved since; else None.
    """

    image: BackendImage
    again: BackendImage | None = None


class Accumulation:
    """A backend (``stss.frames.backends.Backend``) that puts stage ``accumulate`` behind another one.

    Earlier images that it has not just made, as at the first frame of a range, it makes from the window: so an output depends on the
    display frames of the window, and on nothing else.
    """

    window = WINDOW + EARLIER

    def __init__(self, backend: Backend, accumulate: Accumulate):
        self.name, self.method = backend.name, f"{backend.method}, accumulate"
        self._backend, self._accumulate = backend, accumulate
        self._frames: dict[int, _Kept] = {}
        """Id of a frame -> its images, for the last two frames of each sequence under way; an entry goes with its frame."""

    @property
    def cost(self) -> Cost | None:
        """See ``Backend``: the network's."""
        return self._backend.cost

    def expect(self, size: tuple[int, int]) -> None:
        """See ``Backend``."""
        self._backend.expect(size)
        height, width = size
        image = np.zeros((2 * height, 2 * width, 3), np.float32)
        motion = np.zeros((height, width, 2), np.float32)
        self._accumulate(image, [image] * EARLIER, [motion] * EARLIER)  # a kernel is compiled when it is launched first

    def compute(self, window: Sequence[DisplayFrame], steps: tuple[int, int, int]) -> tuple[BackendImage, Mask]:
        """See ``Backend``."""
        # The oldest first: a backend that skips unchanged parts meets the frames in order.
        before = [self._made(window[:-back]) for back in range(EARLIER, 0, -1) if back < len(window)][::-1]
        earlier = before[: before.index(None)] if None in before else before
        image, valid = self._backend.compute(window, steps)
        shown, again = self._mix(image, [each for each in earlier if each is not None], window)
        self._keep(window[-1], _Kept(image, shown if again else None))
        if len(window) > EARLIER:
            self._frames.pop(id(window[-1 - EARLIER]), None)
        return shown, valid

    def deliver(
        self, image: BackendImage, curve: Transfer, planes: Mapping[str, Image], motion: Image | None
    ) -> tuple[Image, dict[str, Image]]:
        """See ``Backend``."""
        return self._backend.deliver(image, curve, planes, motion)

    def _mix(self, image: BackendImage, earlier: Sequence[_Kept], window: Sequence[DisplayFrame]) -> tuple[BackendImage, bool]:
        if not earlier:
            return image, False
        again = len(earlier) == EARLIER and _is_same(image, earlier[1].image) and self._rests()
        if again and earlier[0].again is not None and (shown := earlier[1].again) is not None:
            return shown, True  # its three images are those of two frames before
        motions = [frame.motion for frame in window[: -1 - len(earlier) : -1]]
        return self._accumulate(image, [each.image for each in earlier], motions), again

    def _rests(self) -> bool:
        cost = self.cost
        return cost is not None and cost.network == "none"

    def _made(self, window: Sequence[DisplayFrame]) -> _Kept | None:
        """The images of the last frame of ``window``, computed if need be; None where it has no output."""
        if (kept := self._frames.get(id(window[-1]))) is not None:
            return kept
        if (schedule := schedule_of(window)) is None:
            return None
        made = _Kept(self._backend.compute(window, schedule.steps)[0])
        self._keep(window[-1], made)
        return made

    def _keep(self, frame: DisplayFrame, kept: _Kept) -> None:
        if id(frame) not in self._frames:
            weakref.finalize(frame, self._frames.pop, id(frame), None)
        self._frames[id(frame)] = kept


def _is_same(one: BackendImage, other: BackendImage) -> bool:
    """Whether two images are the same memory: a backend lends one image as often as it is asked."""
    base = getattr(one, "base", None)
    return one is other or (base is not None and base is getattr(other, "base", None))
