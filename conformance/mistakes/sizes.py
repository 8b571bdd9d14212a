# SPDX-License-Identifier: MIT
"""Planted faults that no small frame shows: limits of an index, of a tile, of a motion."""

from typing import Any

from conformance.mistakes.variants import Mistake, fault

_SAMPLE = "sample.py"
_FOLLOW = "moved = np.where(finite[..., None], motion, 0)"
_CLAMP = "x0, y0 = np.clip(at.x, 0, width - 1), np.clip(at.y, 0, height - 1)"
_BETWEEN = "return between([image[j, i]"
_READ = "motion[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]"
_WEIGHT = "weight = np.maximum((key[there] * query).sum(axis=-1, keepdims=True), 0)"
_TAP = "tap = padded[u : u + height : stride, v : v + width : stride]"


def _large(stage: str, name: str, what: str, *change: str, **marks: Any) -> Mistake:
    return fault(stage, name, what, *change, large=True, **marks)


SIZES = (
    _large(
        "warp", "motion_32", "motion is clamped to 32 pixels", _SAMPLE, _FOLLOW, f"{_FOLLOW}.clip(-32, 32)",
        also=("motion_chain", "holes", "occlusion_warp"),
    ),
    _large(
        "warp", "column_255", "reads nothing behind column 255", _SAMPLE, _CLAMP, f"{_CLAMP}\n    x0 = np.minimum(x0, 255)",
        also=("holes", "occlusion_warp"),
    ),
    _large(
        "warp", "row_511", "reads nothing below row 511", _SAMPLE, _CLAMP, f"{_CLAMP}\n    y0 = np.minimum(y0, 511)",
        also=("holes", "occlusion_warp"),
    ),
    _large(
        "motion_chain", "row_511", "reads no motion below row 511", "motion_chain.py", _READ,
        _READ.replace("height - 1", "min(height - 1, 511)"),
    ),
    _large(
        "warp", "pixel_65535", "an index of 16 bits where pixels are read", _SAMPLE, _BETWEEN,
        f"""i = (at.y0 * image.shape[1] + at.x0) % 65536
    at = at._replace(y0=i // image.shape[1], x0=i % image.shape[1])
    {_BETWEEN}""",
        also=("holes", "occlusion_warp"),
    ),
    _large(
        "motion_chain", "pixel_65535", "an index of 16 bits where motions are read", "motion_chain.py", _READ,
        "motion.reshape(-1, 2)[(np.clip(y, 0, height - 1) * width + np.clip(x, 0, width - 1)) % 65536]",
    ),
    _large(
        "occlusion_warp", "raster_65535", "a raster index of 16 bits in the splat", "occlusion_warp.py",
        "motion.reshape(-1, 2)[source[lands]]", "motion.reshape(-1, 2)[source[lands] % 65536]",
    ),
    _large(
        "encoder", "tile_64", "tiles of 64 columns do not see the column before", "conv.py", _TAP,
        f"{_TAP}\n            if v < r:\n                tap = tap.copy()\n                tap[:, 64::64] = 0",
        also=("history", "decoder"),
    ),
    _large(
        "erm", "window_64", "windows do not see across every 64th column", "erm.py",
        _WEIGHT,
        f"{_WEIGHT} * (np.arange(width) % 64 >= r - u)[:, None]",
    ),
)  # fmt: skip
