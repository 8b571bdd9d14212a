"""A second of each fuzzer with a fixed seed; ``make fuzz`` runs them for minutes."""

import importlib

import pytest

from tests.fuzz.__main__ import NAMES


@pytest.mark.parametrize("name", NAMES)
def test_no_damaged_file_does_harm(name):
    assert importlib.import_module(f"tests.fuzz.{name}").run(seed=1, seconds=1) >= 1
