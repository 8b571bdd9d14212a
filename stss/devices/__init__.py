# SPDX-License-Identifier: MIT
"""Choose and test the device that computes: ``stss devices``, the self-test, ``stss tune``."""

from stss.devices.selection import choose, rows

__all__ = ["choose", "rows"]
