"""docs/promises.md: no promise without a test that is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in (ROOT / "docs" / "promises.md").read_text().splitlines()
    if line.startswith("|") and not line.startswith(("| promise", "|---"))
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0][:60])
def test_every_promise_has_its_test(row):
    promise, held_by = row
    named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", held_by)
    assert promise
    assert named, f"{promise}: no test"
    for file, name in named:
        assert re.search(rf"^def {name}\(", (ROOT / file).read_text(), re.MULTILINE), f"{file}::{name} is not there"
