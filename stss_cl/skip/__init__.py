# SPDX-License-Identifier: MIT
"""Skip work whose result is known: compare frames, keep the last frames' data."""

from stss_cl.cost import Cost
from stss_cl.options import SKIPS, Skip
from stss_cl.skip.display_frame import DisplayFrame
from stss_cl.skip.stream import Stream

__all__ = ["SKIPS", "Cost", "DisplayFrame", "Skip", "Stream"]
