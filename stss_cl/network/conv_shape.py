# SPDX-License-Identifier: MIT
"""How a convolution's kernel is built and launched for one layer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from stss_cl.network.tiles import Tiling


@dataclass(frozen=True)
class Shape:
    """What differs from one kernel to the other; arguments are the same.

    Attributes:
        file: of the kernel, which has its name.
        options: it is built with, besides those of the layer.
        weight, gate: as it reads them; None: no gate, or within ``weight``.
        tiling: of the output.
        size, group: of the launch.
    """

    file: str
    options: Mapping[str, object]
    weight: NDArray[Any]
    gate: NDArray[Any] | None
    tiling: Tiling
    size: tuple[int, ...]
    group: tuple[int, ...]
