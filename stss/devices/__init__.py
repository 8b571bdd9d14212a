# SPDX-License-Identifier: MIT
"""Which device computes: ``stss devices``, its self-test, ``stss tune``."""

from stss.devices.selection import choose, rows

__all__ = ["choose", "rows"]
