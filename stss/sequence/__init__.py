# SPDX-License-Identifier: MIT
"""A renderer's files as display frames: names, channels, conventions."""

from stss.sequence.conventions import convert
from stss.sequence.profiles import load_profile
from stss.sequence.reader import Sequence, open_sequence

__all__ = ["Sequence", "convert", "load_profile", "open_sequence"]
