# SPDX-License-Identifier: MIT
"""The specification of space-time supersampling in NumPy: one module for each stage, named as in ``docs/stages.md``."""

SPEC_VERSION = "9"
"""Raised whenever a reference output or a bound changes; reports print it."""
