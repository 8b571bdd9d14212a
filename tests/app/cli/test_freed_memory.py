# SPDX-License-Identifier: MIT
"""Commands that compute with large arrays keep freed memory: the kernel clears each page once."""

import platform
import subprocess
import sys

import pytest

ROUNDS = 10
PAGES = 3 * 2**20 // 4096
"""Of an array that is too small for huge pages."""
PROGRAM = f"""
import resource, sys
sys.path[:0] = {sys.path!r}
import numpy as np
from stss_ground.freed_memory import keep_freed_memory

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

if sys.argv[1] == "keep":
    keep_freed_memory()
before = faults()
for _ in range({ROUNDS}):
    arrays = [np.full(3 * 2**17, 1.0) for _ in range(4)]
    del arrays
print(faults() - before)
"""


def faults(words: str) -> int:
    """Page faults of a process that makes four arrays, and frees them, a few times."""
    return int(subprocess.run([sys.executable, "-c", PROGRAM, words], capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries do as they do")
def test_pages_of_freed_arrays_are_used_again():
    assert faults("keep") < 2 * 4 * PAGES < ROUNDS * 4 * PAGES / 2 < faults("by itself")


@pytest.mark.parametrize("command", ["conform", "port"])
def test_the_judge_and_its_port_keep_freed_memory(command: str):
    lines = f"import sys; sys.argv = ['stss', '{command}', '--help']; import stss_ground.freed_memory as f; "
    lines += "f.keep_freed_memory = lambda: print('kept'); from stss.__main__ import main; main()"
    assert subprocess.run([sys.executable, "-c", lines], check=True, capture_output=True, text=True).stdout.startswith("kept\n")
