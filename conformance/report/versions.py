# SPDX-License-Identifier: MIT
"""Versions that the cases of a run depend on, besides its options."""

from __future__ import annotations

import platform

import stss_ref
from stss_ground.machine import versions
from stss_ground.version import VERSION


def versions_of_cases() -> dict[str, str | int]:
    """Versions of stss, the specification, Python, and the packages that draw cases: with others, the same seed gives other cases."""
    return {
        "stss": VERSION, "specification": stss_ref.SPEC_VERSION, "python": platform.python_version(), **versions(("numpy", "hypothesis")),
    }  # fmt: skip
