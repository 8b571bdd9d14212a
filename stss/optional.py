# SPDX-License-Identifier: MIT
"""Packages that only some commands need: imported when they are, and missed in one line."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from stss.errors import InputError
from stss.version import DISTRIBUTION


def installed(name: str) -> bool:
    """Whether the package ``name`` can be imported."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # colour-science leaves an empty stand-in for a missing Matplotlib among the modules
        return False


def require(name: str, extra: str = "bench") -> Any:
    """The module ``name``; without types, since these packages have none or need not be there.

    Args:
        name: of the module.
        extra: which of the distribution's extras has its package.

    Raises:
        InputError: its package is not installed.
    """
    package = name.partition(".")[0]
    # colour-science leaves an empty stand-in for a missing Matplotlib among the modules: what has no file is not there.
    if package in sys.modules and getattr(sys.modules[package], "__file__", None) is None:
        raise InputError(f"{package} is not installed: pip install '{DISTRIBUTION}[{extra}]'")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"{package} is not installed: pip install '{DISTRIBUTION}[{extra}]'") from error


def require_own_conformance() -> None:
    """Make sure that ``import conformance`` finds ours: other distributions may have a package of that name.

    Raises:
        InputError: it finds another one, or none.
    """
    site = Path(__file__).resolve().parents[1]
    ours = site / "stss_judge" if (site / "stss_judge").is_dir() else site
    spec = importlib.util.find_spec("conformance")
    places = [*(spec.submodule_search_locations or ()), spec.origin] if spec is not None else [None]
    found = places[0]
    if found is None or Path(found).resolve() != ours / "conformance":
        raise InputError(
            f"conformance: expected the package in {ours}, found {found or 'none'}: put {ours} first in PYTHONPATH, "
            "or install stss into an environment of its own"
        )
