# SPDX-License-Identifier: MIT
"""A renderer's files as display frames: names, channels, conventions."""

from stss.sequence.reader import Sequence, open_sequence

__all__ = ["Sequence", "open_sequence"]
