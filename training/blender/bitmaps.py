# SPDX-License-Identifier: MIT
"""Pictures for textures, drawn from a seed: writing, windows, leaves, wire mesh. NumPy only."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.float32]
"""(H, W, 4) in 0..1, row 0 at the bottom as Blender has it: red holds the tone between two colours, alpha the cut-out."""

GLYPHS = 40
"""So many different made-up letters; they are what matters in letters: strokes one or two texels wide."""


def picture(kind: str, seed: int) -> Picture:
    """Draw one.

    Args:
        kind: "text", "windows", "leaves", "mesh" or "stripes".
        seed: the same seed draws the same picture.
    """
    rng = np.random.default_rng(seed)
    tone, alpha = {"text": _text, "windows": _windows, "leaves": _leaves, "mesh": _mesh, "stripes": _stripes}[kind](rng)
    return np.stack([tone, tone, tone, alpha], axis=-1).astype(np.float32)


def _opaque(tone: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return tone, np.ones_like(tone)


def _text(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lines of made-up letters on a 5 x 7 grid, of several sizes."""
    page = np.zeros((256, 256))
    font = rng.random((GLYPHS, 7, 5)) < 0.35
    font[:, :, 0] |= rng.random((GLYPHS, 1)) < 0.6
    font[:, 0, :] |= rng.random((GLYPHS, 1)) < 0.4
    font[:, 3, :] |= rng.random((GLYPHS, 1)) < 0.4
    top = 244
    while top > 30:
        size = int(rng.choice([1, 1, 2, 2, 3, 5]))
        at, top = 10, top - 9 * size
        while at + 6 * size < 246 and top > 6:
            if rng.random() > 0.15:
                letter = np.kron(font[rng.integers(GLYPHS)][::-1], np.ones((size, size)))
                page[top : top + 7 * size, at : at + 5 * size] = letter
            at += 6 * size
    return _opaque(page)


def _windows(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A grid of panes, each of its own brightness."""
    rows, columns = (int(n) for n in rng.integers(4, 13, 2))
    panes = np.kron(rng.random((rows, columns)), np.ones((256 // rows + 1, 256 // columns + 1)))[:256, :256]
    y, x = np.mgrid[:256, :256]
    frame = rng.uniform(0.1, 0.3)
    inside = ((y * rows / 256) % 1 > frame) & ((x * columns / 256) % 1 > frame)
    return _opaque(np.where(inside, 0.3 + 0.7 * panes, 0.0))


def _leaves(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Leaves on twigs; everything else is cut out."""
    tone, alpha = np.zeros((256, 256)), np.zeros((256, 256))
    y, x = np.mgrid[:256, :256]
    for _ in range(int(rng.integers(60, 140))):
        angle, long = rng.uniform(0, np.pi), rng.uniform(8, 22)
        wide = long * rng.uniform(0.15, 0.4)
        cy, cx = rng.uniform(16, 240, 2)
        u = (x - cx) * np.cos(angle) + (y - cy) * np.sin(angle)
        v = -(x - cx) * np.sin(angle) + (y - cy) * np.cos(angle)
        leaf = (u / long) ** 2 + (v / wide) ** 2 < 1
        tone[leaf] = rng.uniform(0.2, 1) * np.where(np.abs(v[leaf]) < 0.8, 0.6, 1)
        alpha[leaf] = 1
    for _ in range(6):
        stem = np.abs(x - 128 - (y * rng.uniform(-0.5, 0.5))) < 1.5
        alpha[stem], tone[stem] = 1, 0.1
    return tone, alpha


def _mesh(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A wire fence: thin diagonal wires, the rest cut out."""
    y, x = np.mgrid[:256, :256]
    step, wire = int(rng.choice([16, 32])), rng.uniform(2, 5)
    alpha = (((x + y) % step) < wire) | (((x - y) % step) < wire)
    return np.where((x + y) % step < wire, 1.0, 0.6), alpha.astype(float)


def _stripes(rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """A bar code: stripes of many widths."""
    edges = np.cumsum(rng.choice([2, 3, 4, 6, 10], 128))
    row = np.searchsorted(edges, np.arange(256)) % 2
    return _opaque(np.repeat(row[None].astype(float), 256, axis=0))
