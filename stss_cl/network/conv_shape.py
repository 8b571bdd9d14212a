# SPDX-License-Identifier: MIT
"""How a convolution's kernel is built and launched for one layer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stss_cl.network.tiles import Tiling


@dataclass(frozen=True)
class Shape:
    """The parts in which convolution kernels differ; their arguments are the same.

    Attributes:
        file: the kernel's file; the kernel has the same name.
        options: build options, besides those of the layer.
        weight, gate: the tensors as the kernel reads them; gate None: there is none, or it is part of ``weight``.
        tiling: the tiles of the output.
        bias: in place of the layer's own; None: that.
        size, group: global size and work-group of the launch.
    """

    file: str
    options: Mapping[str, object]
    weight: NDArray[Any]
    gate: NDArray[Any] | None
    tiling: Tiling
    size: tuple[int, ...]
    group: tuple[int, ...]
    bias: NDArray[np.float32] | None = None
