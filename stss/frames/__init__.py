# SPDX-License-Identifier: MIT
"""Display frames as arrays, the input of a backend, and the backends."""

from stss.frames.backends import open_backend
from stss.frames.buffers import Buffers
from stss.frames.supersample import Output, supersample

__all__ = ["Buffers", "Output", "open_backend", "supersample"]
