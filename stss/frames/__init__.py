# SPDX-License-Identifier: MIT
"""Display frames as arrays, the input of a backend, and the backends."""

from stss.frames.backends import open_backend
from stss.frames.buffers import Buffers
from stss.frames.check_buffers import check_buffers
from stss.frames.output import Output
from stss.frames.supersampler import Supersampler, supersample

__all__ = ["Buffers", "Output", "Supersampler", "check_buffers", "open_backend", "supersample"]
