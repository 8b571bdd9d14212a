# SPDX-License-Identifier: MIT
"""The metadata of a weights file: its version, and the choices of its training besides the tensors (spec 10)."""

from __future__ import annotations

from typing import TypeVar

from stss_ref.constants import HOLE_FILLS, HOLE_TESTS, HoleTest
from stss_ref.weights import SECOND_COLORS, SecondColor, Weights, WeightsError

VERSION_KEY, SECOND_COLOR_KEY, HOLE_TEST_KEY, HOLE_FILL_KEY = "stss_weights_version", "second_color", "hole_test", "hole_fill"
NEWEST_ALONE, WITH_HOLE_TEST, WITH_DETAIL, WITH_RESHADE = "1", "3", "4", "5"
"""Versions of a weights file: with the newest frame as the second colour and the footprint's hole test; with the hole test that the
metadata name; with detail as the second colour; and with holes that are reshaded. A program that knows only earlier versions refuses
this file. Version 2 had a second colour that no longer exists (decision 37)."""
VERSIONS = (NEWEST_ALONE, WITH_HOLE_TEST, WITH_DETAIL, WITH_RESHADE)


def format_metadata(weights: Weights) -> dict[str, str]:
    """The entries that the metadata of a weights file must have (spec 10)."""
    settings = {SECOND_COLOR_KEY: weights.second_color, HOLE_TEST_KEY: weights.hole_test}
    if weights.hole_fill == "reshade":
        return {VERSION_KEY: WITH_RESHADE, **settings, HOLE_FILL_KEY: weights.hole_fill}
    if (weights.second_color, weights.hole_test) == ("newest", "footprint"):
        return {VERSION_KEY: NEWEST_ALONE}
    return {VERSION_KEY: WITH_HOLE_TEST if weights.second_color == "newest" else WITH_DETAIL, **settings}


def take_format(metadata: dict[str, str]) -> Weights:
    """Take these entries out of a file's metadata.

    Returns:
        Weights without tensors, with the choices of the entries.

    Raises:
        WeightsError: the entries are not those of a known version.
    """
    version = metadata.pop(VERSION_KEY, None)
    if version not in VERSIONS:
        got = "no such entry" if version is None else repr(str(version)[:20])
        raise WeightsError(f"expected {VERSION_KEY} 1, 3, 4 or 5 in the metadata, found {got}")
    later = {NEWEST_ALONE: (SECOND_COLOR_KEY, HOLE_TEST_KEY, HOLE_FILL_KEY), WITH_RESHADE: ()}.get(version, (HOLE_FILL_KEY,))
    for key in later:
        if key in metadata:
            raise WeightsError(f"{key}: expected no such entry in the metadata of {VERSION_KEY} {version}")
    if version == NEWEST_ALONE:
        return Weights({})
    seconds = SECOND_COLORS[:1] if version == WITH_HOLE_TEST else SECOND_COLORS
    second: SecondColor = _take_name(metadata, SECOND_COLOR_KEY, seconds)
    test: HoleTest = _take_name(metadata, HOLE_TEST_KEY, HOLE_TESTS)
    return Weights(
        {}, second, test, _take_name(metadata, HOLE_FILL_KEY, HOLE_FILLS) if version == WITH_RESHADE else HOLE_FILLS[0]
    )


Name = TypeVar("Name", bound=str)


def _take_name(metadata: dict[str, str], key: str, names: tuple[Name, ...]) -> Name:
    value = metadata.pop(key, "")
    for name in names:
        if value == name:
            return name
    raise WeightsError(f"{key}: expected one of {', '.join(names)} in the metadata, found {str(value)[:20]!r}")
