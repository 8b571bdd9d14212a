"""Fuzz ``stss check`` with damaged EXR files in a sequence: it may refuse any of them, and none may do harm."""

import shutil
import struct
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

from stss.images.read_write import write_channels
from tests.app.conftest import frame_channels
from tests.fuzz.harness import fuzz, judge, mutated

SIZE = (4, 6)
WORDS = [
    *(struct.pack("<I", n) for n in (0, 1, 2, 9, 255, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 2, 2**32 - 1)),
    *(struct.pack("<Q", n) for n in (0, 2**32, 2**63, 2**64 - 1)),
    *(struct.pack("<f", x) for x in (0.0, -1.0, 1e38, float("inf"), float("nan"))),
    b"\x00\x00\xa0\x7f", b"\x00\x7d", b"\0", b"R\0", b"channels\0", b"chlist\0", b"dataWindow\0", b"box2i\0",
    b"compression\0", b"lineOrder\0", b"tiles\0", b"tiledesc\0", b"string\0", b"m44f\0", b"worldToCamera\0", b"preview\0",
    b"\x1b[2J", b"\x07\r\n", b"\xff\xfe", b"\xe2\x80\xae", b"name\0", b"type\0", b"deepscanline", b"version\0", b"multiView\0",
]  # fmt: skip


@lru_cache(1)
def frames():
    """Three whole frames as bytes; the fuzzer damages the middle one."""
    with TemporaryDirectory() as folder:
        for number in (1, 2, 3):
            write_channels(
                Path(folder, f"{number}.exr"), frame_channels(number, SIZE), half=("R",), metadata={"comment": "x" * 40}
            )
        return [Path(folder, f"{number}.exr").read_bytes() for number in (1, 2, 3)]


def make(random):
    """Damage a frame; half of the faults are in the header, which decides most."""
    whole = frames()[1]
    head = whole.index(b"screenWindowWidth") + 30
    if random.random() < 0.5:
        return mutated(random, whole[:head], WORDS) + whole[head:]
    return mutated(random, whole, WORDS)


def check(folder, data):
    """The damaged frame between two whole ones."""
    first, _, last = frames()
    sequence = folder / "in"
    shutil.rmtree(sequence, ignore_errors=True)
    sequence.mkdir()
    for number, content in ((1, first), (2, data), (3, last)):
        (sequence / f"seq.{number:04d}.exr").write_bytes(content)
    judge(["check", sequence], {0, 1, 2})


def run(seed: int, seconds: float) -> int:
    """Run the fuzzer; returns the number of cases, or raises AssertionError with seed and case if one is wrong."""
    return fuzz(seed, seconds, make, check)
