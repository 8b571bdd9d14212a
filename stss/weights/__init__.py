# SPDX-License-Identifier: MIT
"""Files of weights: read, write, inspect."""

from stss.weights.file import load, save

__all__ = ["load", "save"]
