"""Fuzz ``stss compare`` with damaged PNG files, most of them with corrected checksums."""

import struct
import zlib
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from stss.images.read_write import write_rgb
from tests.fuzz.harness import fuzz, judge, mutated

WORDS = [
    *(struct.pack(">I", n) for n in (0, 1, 2**14, 2**24, 2**31 - 1, 2**32 - 1)),
    b"IHDR", b"PLTE", b"IDAT", b"IEND", b"tRNS", b"iCCP", b"zTXt", b"iTXt", b"eXIf", b"acTL", b"\x1b[2J\0", b"\x10", b"\x03\x00",
]  # fmt: skip
HEAD = 8
"""Bytes of the signature."""


@lru_cache(1)
def picture():
    """A whole picture of 16 x 12 with a text."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "a.png")
        write_rgb(path, np.linspace(0, 1, 12 * 16 * 3).reshape(12, 16, 3), metadata={"stss:kind": "SF"})
        return path.read_bytes()


def make(random):
    """Damage mostly the content of one chunk, with length and checksum corrected; else any bytes."""
    data = picture()
    if random.random() < 0.3:
        return mutated(random, data, WORDS)
    chunks = list(_chunks(data))
    i = random.randrange(len(chunks))
    chunks[i] = mutated(random, chunks[i], WORDS)
    return data[:HEAD] + b"".join(
        struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks if len(c) >= 4
    )


def _chunks(data):
    at = HEAD
    while at < len(data):
        length = struct.unpack(">I", data[at : at + 4])[0]
        yield data[at + 4 : at + 8 + length]
        at += 12 + length


def check(folder, data):
    """As output, against a whole truth."""
    for name, content in (("out", data), ("truth", picture())):
        (folder / name).mkdir(exist_ok=True)
        (folder / name / "frame.0001.png").write_bytes(content)
    judge(
        ["compare", folder / "out", folder / "truth"], {0, 2}, allowed="libpng error: "
    )  # printed by libpng itself, beside our line


def run(seed: int, seconds: float) -> int:
    """Run the fuzzer; returns the number of cases, or raises AssertionError with seed and case if one is wrong."""
    return fuzz(seed, seconds, make, check)
