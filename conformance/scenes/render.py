# SPDX-License-Identifier: MIT
"""Frames of a scene with an exact G-buffer, and their supersampled truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from conformance.scenes.scene import Scene, View
from conformance.scenes.shapes import dot
from conformance.scenes.trace import SKY, Hits, Indices, Moment
from stss_ref.arrays import Array

_RAYS_AT_ONCE = 8192  # a row of temporaries then stays in a processor's cache


@dataclass(frozen=True)
class Rendered:
    """A frame in the conventions of spec section 0, float64; or N single places, with (N,) for (H, W).

    Attributes:
        color: (H, W, 3) scene-linear.
        motion: (H, W, 2) pixels of this image, current -> previous, x right, y down; exact also where it leaves the
            frame. The sky moves as points at infinity do. NaN where the point lay behind the previous camera.
        normal: (H, W, 3) world space, unit, towards the camera; 0 where nothing was hit.
        depth: (H, W) cm along the camera's axis; infinite where nothing was hit.
        position: (H, W, 3) world position, cm; 0 where nothing was hit.
        stencil: (H, W) 0 = static or nothing, each moving object its own number.
        nov: (H, W) dot of normal and direction to the camera; 0 where nothing was hit.
        base_color: (H, W, 3) in [0, 1]; 0 where nothing was hit, and so are roughness and metallic.
        roughness: (H, W) in [0, 1].
        metallic: (H, W) in [0, 1].
    """

    color: Array
    motion: Array
    normal: Array
    depth: Array
    position: Array
    stencil: Array
    nov: Array
    base_color: Array
    roughness: Array
    metallic: Array


def render(scene: Scene, frame: int, height: int, width: int, *, samples: int = 1) -> Rendered:
    """Render one frame.

    Every buffer is that of the ray through the pixel's centre; the colour is the mean of ``samples`` rays spread over
    the pixel's box. An image of twice the size sees the same: its pixels ``(2y+i, 2x+j)`` tile the box of pixel
    ``(y, x)``.

    Args:
        scene: the scene.
        frame: the frame's number; motion leads to ``frame - 1``.
        height: H.
        width: W.
        samples: rays for each pixel's colour, a square number; 1 is the centre.

    Raises:
        ValueError: ``samples`` is not a square number.
    """
    dx, dy = sample_offsets(samples)
    out: dict[str, Array] = {}
    for rows, columns, y, x in _tiles(height, width, 1):
        part = look(scene, frame, x, y, (height, width))
        for field in fields(Rendered):
            plane: Array = getattr(part, field.name)
            whole = out.setdefault(field.name, np.empty((height, width, *plane.shape[1:])))
            whole[rows, columns] = plane.reshape(rows.stop - rows.start, -1, *plane.shape[1:])
    if samples > 1:
        moment, view = Moment.of(scene, frame), scene.camera.view(frame, (height, width))
        for rows, columns, y, x in _tiles(height, width, samples):
            rays = view.rays((x[:, None] + dx).ravel(), (y[:, None] + dy).ravel())
            light = moment.radiance(_first_hits(moment, view, rays), rays)
            mean = light.reshape(3, -1, samples).mean(axis=2)
            out["color"][rows, columns] = mean.T.reshape(rows.stop - rows.start, -1, 3)
    return Rendered(**out)


def look(scene: Scene, frame: float, x: Array, y: Array, size: tuple[int, int]) -> Rendered:
    """The colours that single rays through the pixel coordinates ``x``, ``y``, (N,) each, of an image of ``size`` (H, W) see."""
    moment, view = Moment.of(scene, frame), scene.camera.view(frame, size)
    rays = view.rays(x, y)
    hits = _first_hits(moment, view, rays)
    numbers = np.append(scene.numbers, 0.0)  # SKY is -1: the last
    return Rendered(
        color=np.ascontiguousarray(moment.radiance(hits, rays).T),
        motion=_motion(scene, frame, hits, rays, view),
        normal=np.ascontiguousarray(hits.normal.T),
        depth=np.where(hits.which == SKY, np.inf, dot(hits.point - view.position, view.forward)),
        position=np.ascontiguousarray(hits.point.T),
        stencil=numbers[hits.which],
        nov=-dot(hits.normal, rays),
        base_color=np.ascontiguousarray(hits.surface.base_color.T),
        roughness=hits.surface.roughness,
        metallic=hits.surface.metallic,
    )


def place_of(scene: Scene, frame: float, index: Indices, local: Array) -> Array:
    """(3, N) world place at ``frame`` of points fixed to objects: ``index`` (N,), ``local`` (3, N); 0 for the sky."""
    moment, world = Moment.of(scene, frame), np.zeros_like(local)
    for i in np.unique(index[index != SKY]):
        here = index == i
        world[:, here] = moment.transforms[i].to_world(local[:, here])
    return world


def _motion(scene: Scene, frame: float, hits: Hits, rays: Array, view: View) -> Array:
    previous = scene.camera.view(frame - 1, view.size)
    # Both ends come from the object's own space by the same steps: what stands still moves by exactly 0.
    before, now = (place_of(scene, f, hits.which, hits.local) for f in (frame - 1, frame))
    motion = previous.project(before) - view.project(now)
    turned = previous.project_direction(rays) - view.project_direction(rays)
    return np.where((hits.which == SKY)[:, None], turned, motion)


def sample_offsets(samples: int) -> tuple[Array, Array]:
    """(samples,) x and y in (-0.5, 0.5): one in each cell of a square grid, and no two share an x or a y.

    Raises:
        ValueError: ``samples`` is not a square number.
    """
    side = math.isqrt(samples)
    if samples < 1 or side * side != samples:
        raise ValueError(f"samples: expected a square number, got {samples}")
    i, j = (a.ravel() for a in np.mgrid[:side, :side])
    x, y = (i + (j + 0.5) / side) / side, (j + (side - i - 0.5) / side) / side
    return x - 0.5, y - 0.5


def _first_hits(moment: Moment, view: View, rays: Array) -> Hits:
    return moment.hit(view.position, rays, moment.in_beam(view.position, rays))


def _tiles(height: int, width: int, samples: int) -> Iterator[tuple[slice, slice, Array, Array]]:
    """Squares of pixels that cover the image: their rows and columns, and the coordinates y, x of their pixels."""
    side = max(1, math.isqrt(_RAYS_AT_ONCE // samples))
    for top in range(0, height, side):
        for left in range(0, width, side):
            rows, columns = slice(top, min(top + side, height)), slice(left, min(left + side, width))
            y, x = np.mgrid[rows, columns].astype(np.float64).reshape(2, -1)
            yield rows, columns, y, x
