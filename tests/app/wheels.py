"""Wheels, built as `pip` builds them and unpacked as `pip` installs them."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def build_wheel(project, folder):
    """The wheel of a project, a path below the root, built into a folder; the test is skipped where it cannot be."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: make test installs it")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT / project, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def unpack_wheel(wheel, folder):
    """A folder in which the wheel is installed."""
    zipfile.ZipFile(wheel).extractall(folder)
    return folder
