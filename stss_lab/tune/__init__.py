# SPDX-License-Identifier: MIT
"""``stss tune``: the fastest tile sizes for a device."""
