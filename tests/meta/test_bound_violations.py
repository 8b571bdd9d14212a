# SPDX-License-Identifier: MIT
"""``make misses``: the same table, whoever measures the films."""

import subprocess
import sys
from pathlib import Path

import pytest

FEW = ("--sequences", "3", "--frames", "6", "--size", "64x40", "--levels", "2,4", "--weights", "realtime")


def table(*words):
    command = [sys.executable, "-m", "tests.meta.bound_violations", *FEW, *words]
    return subprocess.run(command, cwd=Path(__file__).parents[2], check=False, capture_output=True, text=True)


def test_two_workers_measure_what_one_process_does(device):
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    del device
    alone, many = table(), table("--cluster", "local:2")
    assert alone.returncode == 0, alone.stderr
    assert many.returncode == 0, many.stderr
    assert many.stdout == alone.stdout
    rows = [row.split(" | ") for row in alone.stdout.splitlines()[2:]]
    assert len(rows) == 2
    assert all(int(row[1]) and int(row[2]) for row in rows), "no frame was left out in part: nothing is compared"


def test_an_address_that_is_none_is_one_line():
    pytest.importorskip("distributed", reason="the extra cluster is not installed")
    done = table("--cluster", "local:0")
    assert done.returncode == 2
    assert "--cluster: expected local:N" in done.stderr.splitlines()[-1]
