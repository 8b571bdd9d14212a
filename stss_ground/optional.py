# SPDX-License-Identifier: MIT
"""Import packages that only some commands need, and report a missing one in one line."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from stss_ground.errors import InputError


def require(name: str, extra: str = "bench", oldest: tuple[int, ...] = ()) -> Any:
    """Import the module ``name``; untyped, since these packages have no types or need not be installed.

    Args:
        name: the module's dotted name.
        extra: the distribution's extra that has its package.
        oldest: the beginning of the oldest version that will do; numbers.

    Raises:
        InputError: its package is not installed, or too old.
    """
    package = name.partition(".")[0]
    advice = f"pip install --upgrade {package}, or in a checkout pip install '.[{extra}]'"
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(f"{package} is not installed: {advice.replace(' --upgrade', '')}") from error
    if oldest and (present := version(package)) and tuple(map(int, present.split(".")[: len(oldest)])) < oldest:
        raise InputError(f"{package}: expected version {'.'.join(map(str, oldest))} or newer, found {present}: {advice}")
    return module


def add_own_conformance() -> None:
    """Search the folder of our ``conformance`` last.

    The wheel's .pth file says the same, but Python reads such files in site folders alone, not in those of PYTHONPATH.
    """
    folder = str(_own_conformance())
    if folder not in sys.path:
        sys.path.append(folder)


def _own_conformance() -> Path:
    """The folder with our ``conformance``: in a wheel its own, in a checkout that of all packages."""
    site = Path(__file__).resolve().parents[1]
    return site / "stss_judge" if (site / "stss_judge").is_dir() else site


def require_own_conformance() -> None:
    """Make sure that ``import conformance`` finds ours: other distributions may have a package of that name.

    Raises:
        InputError: it finds another one, or none.
    """
    ours = _own_conformance()
    spec = importlib.util.find_spec("conformance")
    places = [*(spec.submodule_search_locations or ()), spec.origin] if spec is not None else [None]
    place = places[0]
    if place is None or Path(place).resolve() != ours / "conformance":
        raise InputError(
            f"conformance: expected the package in {ours}, found {place or 'none'}: put {ours} first in PYTHONPATH, "
            "or install stss into an environment of its own"
        )
