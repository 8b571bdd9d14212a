# SPDX-License-Identifier: MIT
"""What need not be computed: changes, flat tiles, the frames kept for it."""

from stss_cl.skip.display_frame import DisplayFrame
from stss_cl.skip.frame_cache import Report
from stss_cl.skip.stream import SKIPS, Skip, Stream

__all__ = ["SKIPS", "DisplayFrame", "Report", "Skip", "Stream"]
