# SPDX-License-Identifier: MIT
"""tPSNR and recPSNR as Arm's Neural Graphics Model Gym defines them, of images as a screen shows them.

Source: arm/neural-graphics-model-gym, ``src/ng_model_gym/core/evaluator/metrics.py``, commit 028eaa7, ``calculate_tpsnr`` and
``calculate_recpsnr``. Formulas: docs/metrics.md.
"""

from __future__ import annotations

import numpy as np

from stss_ref.arrays import Array, Image

Shown = tuple[Image, Image]
"""Output and truth, (H, W, 3) display-referred, in [0, 1], not cut to 8 bits."""


def temporal_psnr(frame: Shown, before: Shown) -> float:
    """PSNR of the change since the frame before, pixel by pixel and without motion; dB, infinite where the changes agree."""
    image, truth = (now.astype(np.float64) - earlier for now, earlier in zip(frame, before, strict=True))
    return _psnr(image, truth)


def recurrent_psnr(last: Shown) -> float:
    """PSNR of a sequence's last frame, in which a recurrent method has gathered all its errors; dB."""
    return _psnr(*(image.astype(np.float64) for image in last))


def _psnr(image: Array, truth: Array) -> float:
    """``10 log10(1 / mean (image - truth)^2)``; infinite where the two agree."""
    error = float(((image - truth) ** 2).mean())
    return float(-10 * np.log10(error)) if error else float("inf")
