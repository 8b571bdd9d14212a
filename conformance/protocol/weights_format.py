# SPDX-License-Identifier: MIT
"""The metadata of a weights file: its version, and the choices of its training besides the tensors (spec 10)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from stss_ref.constants import HOLE_FILLS, HOLE_TESTS
from stss_ref.weights import SECOND_COLORS, Weights, WeightsError

VERSION_KEY = "stss_weights_version"
CHOICES: dict[str, tuple[str, ...]] = {"second_color": SECOND_COLORS, "hole_test": HOLE_TESTS, "hole_fill": HOLE_FILLS}
"""Fields of ``Weights`` besides the tensors, with their values; the first is that of a file without such an entry."""
VERSIONS: Mapping[int, Mapping[str, tuple[str, ...]]] = {
    1: {},
    3: {"second_color": SECOND_COLORS[:1], "hole_test": HOLE_TESTS},
    4: {"second_color": SECOND_COLORS, "hole_test": HOLE_TESTS},
    5: CHOICES,
}
"""Versions of a file, with their entries: a program that knows only earlier versions refuses it. Version 2 had a second colour that no
longer exists (decision 37)."""
ONE_OF_VERSIONS = " or ".join(", ".join(map(str, VERSIONS)).rsplit(", ", 1))
"""For messages."""


@dataclass(frozen=True, eq=False)
class FileWeights(Weights):
    """Weights whose file has a certain version, one of `versions_of`."""

    version: int = min(VERSIONS)


def versions_of(weights: Weights) -> list[int]:
    """The versions of a file that have the choices of these weights, the earliest first."""
    return [version for version in VERSIONS if restrict(weights, version) is weights]


def format_metadata(weights: Weights) -> dict[str, str]:
    """The entries that the metadata of a weights file must have (spec 10), of the earliest version that has its choices, or its own."""
    version = weights.version if isinstance(weights, FileWeights) else versions_of(weights)[0]
    return {VERSION_KEY: str(version), **{name: getattr(weights, name) for name in VERSIONS[version]}}


def restrict(weights: Weights, version: int) -> Weights:
    """The same weights with the first value of each choice that files of this version cannot have."""
    known = {name: VERSIONS[version].get(name, values[:1]) for name, values in CHOICES.items()}
    lost: dict[str, Any] = {name: values[0] for name, values in known.items() if getattr(weights, name) not in values}
    return replace(weights, **lost) if lost else weights


def take_format(metadata: dict[str, str]) -> Weights:
    """Take these entries out of a file's metadata.

    Returns:
        Weights without tensors, with the choices of the entries.

    Raises:
        WeightsError: the entries are not those of a known version.
    """
    text = metadata.pop(VERSION_KEY, None)
    version = next((version for version in VERSIONS if text == str(version)), None)
    if version is None:
        got = "no such entry" if text is None else repr(str(text)[:20])
        raise WeightsError(f"expected {VERSION_KEY} {ONE_OF_VERSIONS} in the metadata, found {got}")
    for name in CHOICES:
        if name in metadata and name not in VERSIONS[version]:
            raise WeightsError(f"{name}: expected no such entry in the metadata of {VERSION_KEY} {version}")
    choices: dict[str, Any] = {name: _take_choice(metadata, name, values) for name, values in VERSIONS[version].items()}
    return Weights({}, **choices)


def _take_choice(metadata: dict[str, str], name: str, values: tuple[str, ...]) -> str:
    value = metadata.pop(name, "")
    if value not in values:
        raise WeightsError(f"{name}: expected one of {', '.join(values)} in the metadata, found {str(value)[:20]!r}")
    return value
