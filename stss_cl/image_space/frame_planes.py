# SPDX-License-Identifier: MIT
"""The inputs of a frame as buffers on the device, one for each display frame and plane."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyopencl as cl

from stss_cl.device.buffers import incoming, part
from stss_cl.device.discovery import Device
from stss_ref.arrays import Array, ArrayError, require_dtype, require_shape

Source = Array | cl.Buffer
"""A C-contiguous float32 array, or a buffer on the device that holds one."""
MOST_STEPS = 5
"""Largest distance of a colour frame, in display frames back (spec 1)."""


@dataclass(frozen=True)
class Sources:
    """The planes that stage ``frame`` reads, float32, of one size (H, W); the last ones may be left out if no kernel reads them.

    Attributes:
        steps: the distances of the three colour frames, in display frames back, newest first.
        colors: (H, W, 3) of each of them.
        motions: (H, W, 2) of the frame itself and of those before it, newest first: as many as the largest step.
        gbuffer: (H, W, 9).
        nov: (H, W).
        stencils: (H, W) of the frame itself and of the three colour frames.
        normals: likewise (H, W, 3); two pixels are ``normal_stride`` floats apart.
        positions: likewise (H, W, 3).
        normal_stride: 3, or 9 if the normals are read from G-buffers.
    """

    steps: tuple[int, int, int]
    colors: tuple[cl.Buffer, ...]
    motions: tuple[cl.Buffer, ...]
    gbuffer: cl.Buffer
    nov: cl.Buffer
    stencils: tuple[cl.Buffer, ...]
    normals: tuple[cl.Buffer, ...]
    positions: tuple[cl.Buffer, ...]
    normal_stride: int = 3


def check_steps(steps: Sequence[int]) -> tuple[int, int, int]:
    """Check the three steps, and return them as numbers.

    Raises:
        ArrayError: they are not three numbers in order.
    """
    try:
        numbers = tuple(int(step) for step in steps)
    except (TypeError, ValueError) as error:
        raise ArrayError(f"steps: expected three numbers from 0 to {MOST_STEPS}, got {type(steps).__name__}") from error
    if len(numbers) != 3 or list(numbers) != sorted(numbers) or not 0 <= numbers[0] <= numbers[2] <= MOST_STEPS:
        raise ArrayError(f"steps: expected three numbers from 0 to {MOST_STEPS}, newest (smallest) first, got {numbers}")
    return numbers


def upload(device: Device, name: str, source: Source, shape: tuple[int, ...]) -> cl.Buffer:
    """``source`` on the device: itself, the array in place, or a copy.

    Raises:
        ArrayError: shape, dtype or size differ.
    """
    if isinstance(source, cl.Buffer):
        expected = int(np.prod(shape)) * 4
        if source.size < expected:
            raise ArrayError(f"{name}: expected at least {expected} bytes, got {source.size}")
        return source
    require_shape(name, source, shape)
    require_dtype(name, source, np.dtype(np.float32))
    return incoming(device, source)


def planes(
    device: Device, name: str, source: Source, count: int, shape: tuple[int, ...], *, stack: int | None
) -> tuple[cl.Buffer, ...]:
    """The first ``count`` planes of a stack, each a buffer; the others are not uploaded.

    Args:
        device: to run on.
        name: for errors.
        source: the stack, (stack, ...).
        count: number of planes to take.
        shape: shape of a plane.
        stack: number of planes that the stack holds; None: any number from ``count`` on.

    Raises:
        ArrayError: shape, dtype or size differ.
    """
    size = int(np.prod(shape)) * 4
    if isinstance(source, cl.Buffer):
        upload(device, name, source, (stack or count, *shape))
        return tuple(part(device, source, i * size, size) for i in range(count))
    require_shape(name, source, (stack, *shape))
    if len(source) < count:
        raise ArrayError(f"{name}: expected at least {count}, got {len(source)}")
    return tuple(upload(device, name, source[i], shape) for i in range(count))
