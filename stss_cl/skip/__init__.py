# SPDX-License-Identifier: MIT
"""Skip what need not be computed: compare frames, keep the last frames' data."""

from stss_cl.skip.display_frame import DisplayFrame
from stss_cl.skip.frame_cache import Report
from stss_cl.skip.stream import SKIPS, Skip, Stream

__all__ = ["SKIPS", "DisplayFrame", "Report", "Skip", "Stream"]
