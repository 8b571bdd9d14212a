"""Fuzz ``stss weights inspect`` and ``stss weights import`` with damaged weights and checkpoints."""

import io
import struct
import zipfile
from functools import lru_cache
from math import prod
from pathlib import Path
from tempfile import TemporaryDirectory

from stss.weights.file import save
from stss_ref.weights import TENSORS, zeros
from tests.fuzz.harness import exchanged, fuzz, judge, mutated

JSON_WORDS = [
    b'"F32"', b'"BF16"', b'"F64"', b"[]", b"[0,0]", b"[-1]", b"1e400", b"18446744073709551615", b"4294967296", b"[" * 300, b"}" * 3,
    b'"__metadata__":', b'"__metadata__":{"a":1}', b"null", b'"\\u001b[2J"', b'"\\ud800"', b"\xff", b'"outc.bias":', b"99999999",
]  # fmt: skip
PICKLE_WORDS = [
    b"cos\nsystem\n", b"R", b"(", b"t", b"}", b"]", b"h\x00", b"\x85", b"\x86", b"\x87", b"Q", b"b", b"u", b"s", b"0", b"2", b"1",
    b"\x8a\x08" + b"\xff" * 8, b"\x8b\xff\xff\xff\x7f", b"J\xff\xff\xff\x7f", b"\x8d" + b"\xff" * 8, b"\x96" + b"\xff" * 8,
    b"X\xff\xff\xff\x7f", b"r\xff\xff\xff\xff", b"(" * 300, b"(l" * 300, b"\x8c\x05\x1b[2Jx", b"c__builtin__\neval\n", b".",
]  # fmt: skip


@lru_cache(1)
def sound():
    """Whole weights as safetensors, head and numbers."""
    with TemporaryDirectory() as folder:
        path = Path(folder, "w.safetensors")
        save(path, zeros(), {"made": "by the fuzzer"})
        data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    return data[8:end], data[end:]


def pickled():
    """The pickle of a checkpoint, as PyTorch writes it: protocol 2, tensors rebuilt from storages."""
    out = b"\x80\x02}("
    for i, (name, shape) in enumerate(TENSORS.items()):
        storage = (
            b"(" + _text("storage") + b"ctorch\nFloatStorage\n" + _text(str(i)) + _text("cpu") + _numbers(prod(shape)) + b"tQ"
        )
        strides = [prod(shape[k + 1 :]) for k in range(len(shape))]
        sizes = b"(" + _numbers(*shape) + b"t(" + _numbers(*strides) + b"t"
        arguments = b"(" + storage + _numbers(0) + sizes + b"\x89ccollections\nOrderedDict\n)Rt"
        out += _text(name) + b"ctorch._utils\n_rebuild_tensor_v2\n" + arguments + b"R"
    return out + b"u."


def _text(word):
    return b"X" + struct.pack("<I", len(word)) + word.encode()


def _numbers(*values):
    return b"".join(b"J" + struct.pack("<i", n) for n in values)


def checkpoint(description):
    """A checkpoint as a zip archive, its numbers all 0."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", description)
        archive.writestr("archive/byteorder", b"little")
        for i, shape in enumerate(TENSORS.values()):
            archive.writestr(f"archive/data/{i}", bytes(4 * prod(shape)))
    return out.getvalue()


def make(random):
    """Half safetensors, half checkpoints; in each, mostly what describes the numbers is damaged."""
    if random.random() < 0.5:
        head, numbers = sound()
        if random.random() < 0.5:
            head = exchanged(random, head, rb'"[^"]*"|\d+|\[[^][]*\]', JSON_WORDS)
        else:
            head = mutated(random, head, JSON_WORDS)
        length = len(head) if random.random() < 0.9 else random.choice((0, 1, 2**31, 2**40, 2**63, 2**64 - 1))
        return length.to_bytes(8, "little") + head + numbers[: random.choice((None, None, None, 1000))]
    if random.random() < 0.7:
        return checkpoint(mutated(random, pickled(), PICKLE_WORDS))
    whole = checkpoint(pickled())
    cut = len(whole) - 12000  # the directory is at the end
    return whole[:cut] + mutated(random, whole[cut:], [b"PK\x01\x02", b"PK\x05\x06", b"PK\x03\x04", b"\xff" * 4])


def check(folder, data):
    """By its first bytes, as one or the other."""
    if data[:2] == b"PK":
        path = folder / "checkpoint.pkl"
        path.write_bytes(data)
        result = judge(["weights", "import", path, "-o", folder / "out.safetensors"], {0, 2})
        assert (folder / "out.safetensors").exists() == (result.returncode == 0)
        (folder / "out.safetensors").unlink(missing_ok=True)
    else:
        path = folder / "w.safetensors"
        path.write_bytes(data)
        judge(["weights", "inspect", path], {0, 2})


def run(seed: int, seconds: float) -> int:
    """Run the fuzzer; returns the number of cases, or raises AssertionError with seed and case if one is wrong."""
    return fuzz(seed, seconds, make, check)
