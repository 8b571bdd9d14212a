# SPDX-License-Identifier: MIT
"""The choices that the backend leaves to its caller; importing them opens no OpenCL library."""

from __future__ import annotations

from typing import Literal, get_args

Precision = Literal["float32", "float32-direct", "half", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
"""``float32``: Winograd where it is faster. ``float32-direct``: none. ``half``: activations stored as half,
computed in float32. ``bfloat16``: activations and weights of 3 x 3 as bfloat16, sums in float32; on a processor's matrix units, or
without them slowly, with the same bits."""

Skip = Literal["off", "exact"]
SKIPS: tuple[Skip, ...] = get_args(Skip)
"""``off``: compute every frame whole. ``exact``: reuse what did not change, with the bits of ``off``."""
