# SPDX-License-Identifier: MIT
"""Stage history: the earlier frames as a feature at 1/8 size."""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, Image, require
from stss_ref.conv import conv_chain, gated
from stss_ref.weights import Tensors


def history_embedding(history: Array, weights: Tensors) -> Image:
    """Encode three earlier frames with the same weights, then fuse them.

    ``feature = G(concat(e(oldest), e(middle), e(newest)))``, ``e = convHis3(convHis2(convHis1(.)))``, each a stride-2 convolution and
    two more.

    Source: spec 7; paper, Fig. 5 (history embedding).

    Args:
        history: (3, H, W, 4) oldest, middle, newest; each warped colour 3 and its mask; H, W multiples of 8.
        weights: the network's tensors.

    Returns:
        feature: (H/8, W/8, 32); no ReLU.

    Raises:
        ArrayError: ``history`` is not (3, H, W, 4).
    """
    require({"history": (history, "3, H, W, 4")})

    embedded: list[Image] = []
    for x in history:
        for name in ("convHis1", "convHis2", "convHis3"):
            x = conv_chain(x, weights, name, (2, 1, 1))  # noqa: PLW2901
        embedded.append(x)
    return gated(np.concatenate(embedded, axis=-1), weights, "lowlevelGated")
