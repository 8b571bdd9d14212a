# SPDX-License-Identifier: MIT
"""The last image of SF or of EF, which callers may view and which is overwritten once no caller holds it."""

from __future__ import annotations

import weakref
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
from numpy.typing import NDArray

from stss_cl.device.buffers import Outgoing
from stss_cl.device.discovery import Device

Image = NDArray[np.float32]


class LastImage:
    """An image in memory that belongs to the stream and that callers may hold.

    ``lend`` returns an array of that memory. As long as this array or a view of it exists, nothing is written there: the next image
    goes to new memory, and the old memory lives as long as its arrays.

    Args:
        device: to run on.
        shape: shape of the image.
    """

    def __init__(self, device: Device, shape: tuple[int, int, int]):
        self._device, self._shape = device, shape
        self._image: Outgoing | None = None
        self._loan: weakref.ref[Image] | None = None
        self._loan_there: weakref.ref[cla.Array] | None = None

    def lend(self) -> tuple[Image, Outgoing]:
        """The image, read-only; it is complete when the second value, whose download has begun, is finished."""
        assert self._image is not None, "no image was made yet"
        self._image.send()
        lent = self._lent()
        if lent is None:
            # A view's base is the array it was made from, unless that is itself a view of an array; this one is a view of a buffer.
            lent = np.asarray(memoryview(self._image.array).toreadonly())
            self._loan = weakref.ref(lent)
        return lent.view(), self._image

    def lend_there(self) -> cla.Array:
        """The image on the device, not to be written to; the same object as long as the caller holds it."""
        assert self._image is not None, "no image was made yet"
        there = None if self._loan_there is None else self._loan_there()
        if there is None:
            there = cla.Array(self._device.queue, self._shape, np.float32, data=self._image.data)
            self._loan_there = weakref.ref(there)
        return there

    def copy_to(self, array: cla.Array) -> None:
        """Enqueue a copy of the image to an array on the device."""
        assert self._image is not None, "no image was made yet"
        to: Any = array.base_data
        cl.enqueue_copy(self._device.queue, to, self._image.data, byte_count=array.nbytes, dst_offset=array.offset)

    def target(self, *, whole: bool) -> cl.Buffer:
        """The buffer for the next image: the last one, or a new one if a caller holds the last; with the old content unless ``whole``."""
        last = self._image
        if last is None or self._is_lent():
            self._image, self._loan, self._loan_there = Outgoing(self._device, self._shape, on_device=False), None, None
            if last is not None and not whole:
                cl.enqueue_copy(self._device.queue, self._image.data, last.data)
        assert self._image is not None
        self._image.renew()
        return self._image.data

    def _is_lent(self) -> bool:
        return self._lent() is not None or (self._loan_there is not None and self._loan_there() is not None)

    def _lent(self) -> Image | None:
        return None if self._loan is None else self._loan()
