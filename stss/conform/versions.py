# SPDX-License-Identifier: MIT
"""What the cases of a run depend on besides its options."""

from __future__ import annotations

import platform

import stss_ref
from stss.machine import versions
from stss.version import VERSION


def versions_of_cases() -> dict[str, str | int]:
    """Of stss, the specification, Python, and the packages that draw: with others, the same seed gives other cases."""
    return {
        "stss": VERSION, "specification": stss_ref.SPEC_VERSION, "python": platform.python_version(), **versions(("numpy", "hypothesis")),
    }  # fmt: skip
