# SPDX-License-Identifier: MIT
"""Import packages that only some commands need, and report a missing one in one line."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from stss_ground.errors import InputError


def installed(name: str) -> bool:
    """Whether the package ``name`` can be imported."""
    try:
        return importlib.util.find_spec(name) is not None
    except ValueError:  # colour-science leaves an empty stand-in for a missing Matplotlib among the modules
        return False


def require(name: str, extra: str = "bench") -> Any:
    """Import the module ``name``; untyped, since these packages have no types or need not be installed.

    Args:
        name: the module's dotted name.
        extra: the distribution's extra that has its package.

    Raises:
        InputError: its package is not installed.
    """
    package = name.partition(".")[0]
    # colour-science leaves an empty stand-in for a missing Matplotlib among the modules: a module without a file is missing.
    if package in sys.modules and getattr(sys.modules[package], "__file__", None) is None:
        raise InputError(f"{package} is not installed: in a checkout of stss, pip install '.[{extra}]'")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"{package} is not installed: in a checkout of stss, pip install '.[{extra}]'") from error


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
