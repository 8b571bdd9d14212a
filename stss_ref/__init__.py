# SPDX-License-Identifier: MIT
"""Space-time supersampling, the specification in NumPy: one module a stage, in the words of ``docs/stages.md``."""

SPEC_VERSION = "2"
"""Raised whenever a reference output or a bound changes; reports print it."""
