# SPDX-License-Identifier: MIT
"""The authors' checkpoint: read as PyTorch reads it, and never executed."""

import os
import pickle
import random as stdlib_random
import re
import struct
import zipfile
from collections import OrderedDict
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stss.weights import checkpoint
from stss.weights.checkpoint import read_checkpoint
from stss_ref.weights import TENSORS, Weights, WeightsError, random

# A small assembler of pickles: what PyTorch writes, and what it never would.


def text(string: str) -> bytes:
    return b"X" + struct.pack("<I", len(string.encode())) + string.encode()


def integer(number: int) -> bytes:
    if -(2**31) <= number < 2**31:
        return b"J" + struct.pack("<i", number)
    data = number.to_bytes(number.bit_length() // 8 + 1, "little", signed=True)
    return b"\x8a" + bytes([len(data)]) + data


def named(module: str, name: str) -> bytes:
    return f"c{module}\n{name}\n".encode()


def tupled(*items: bytes) -> bytes:
    return b"(" + b"".join(items) + b"t"


ORDERED_DICT = named("collections", "OrderedDict")
EMPTY = ORDERED_DICT + b")R"
REBUILD = named("torch._utils", "_rebuild_tensor_v2")


def storage(key: str, length: int, kind: str = "FloatStorage") -> bytes:
    return tupled(text("storage"), named("torch", kind), text(key), text("cuda:0"), integer(length)) + b"Q"


def tensor(where: bytes, shape: tuple[int, ...], strides: tuple[int, ...], offset: int = 0) -> bytes:
    sizes, steps = (tupled(*map(integer, numbers)) for numbers in (shape, strides))
    return REBUILD + tupled(where, integer(offset), sizes, steps, b"\x89", EMPTY) + b"R"


def program(items: Mapping[str, bytes], metadata: bytes = b"") -> bytes:
    entries = b"".join(text(name) + value for name, value in items.items())
    return b"\x80\x02" + EMPTY + b"(" + entries + b"u" + metadata + b"."


def contiguous(shape: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(int(np.prod(shape[axis + 1 :])) for axis in range(len(shape)))


TOUCH = text("touch executed")


class Attack:
    """An object whose pickle runs a command."""

    def __reduce__(self) -> Any:
        return os.system, ("touch executed",)


class Craft:
    """A checkpoint of random weights, to be spoilt."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.files: dict[str, bytes] = {}
        self.items: dict[str, bytes] = {}
        for key, (name, values) in enumerate(random(1).items()):
            self.items[name] = tensor(storage(str(key), values.size), values.shape, contiguous(values.shape))
            self.files[f"archive/data/{key}"] = values.astype("<f4").tobytes()

    def key(self, name: str) -> str:
        return str(list(TENSORS).index(name))

    def write(self, pickled: bytes | None = None, compression: int = zipfile.ZIP_STORED) -> Path:
        with zipfile.ZipFile(self.path, "w", compression) as file:
            file.writestr("archive/data.pkl", program(self.items) if pickled is None else pickled)
            for name, data in self.files.items():
                file.writestr(name, data)
        return self.path

    def refused(self, pickled: bytes | None = None) -> str:
        """Message of the refusal, less the file's name."""
        return refusal(self.write(pickled))


def refusal(path: Path) -> str:
    with pytest.raises(WeightsError) as caught:
        read_checkpoint(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message.removeprefix(f"{path}: ")


def same(one: Weights, other: Weights) -> bool:
    return all(np.array_equal(one[name], other[name]) for name in TENSORS)


@pytest.fixture
def craft(tmp_path: Path) -> Craft:
    return Craft(tmp_path / "some.pkl")


def test_the_authors_checkpoints_are_read_as_pytorch_reads_them(reference_data: Path):
    torch = pytest.importorskip("torch")
    for scene in ("arena", "lewis"):
        path = reference_data / "checkpoints" / f"{scene}.pkl"
        expected = torch.load(path, weights_only=True, map_location="cpu")
        weights = read_checkpoint(path)
        assert set(weights) == set(expected)
        assert same(weights, {name: value.numpy() for name, value in expected.items()})


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_what_pytorch_saves_today_is_read(tmp_path: Path, protocol: int):
    torch = pytest.importorskip("torch")
    state = OrderedDict((name, torch.from_numpy(value.copy())) for name, value in random(1).items())
    state._metadata = OrderedDict({"": {"version": 1}})  # type: ignore[attr-defined]
    flat = torch.arange(2 * 24 * 12 + 5, dtype=torch.float32)
    state["outc.weight"] = flat[5:].view(24, 12, 2)[:, :, 1].t().reshape(12, 24).t().t().view(12, 24, 1, 1)
    state["outc.bias"] = flat[3::7][:12]
    state["up3.conv.double_conv.2.bias"] = flat[7].expand(24)
    path = tmp_path / "some.pth"
    torch.save(state, path, pickle_protocol=protocol)
    assert same(read_checkpoint(path), {name: value.numpy() for name, value in state.items()})
    torch.save(state, path, _use_new_zipfile_serialization=False)
    assert "the format of PyTorch before 1.6" in refusal(path)


def test_the_handmade_checkpoint_is_read(craft: Craft):
    assert same(read_checkpoint(craft.write()), random(1))
    # Python's machine in C would make an array of as many places as the number says.
    assert same(read_checkpoint(craft.write(program(craft.items, b"r\xff\xff\xff\xff"))), random(1))
    metadata = b"}" + text("_metadata") + EMPTY + b"sb"
    assert same(read_checkpoint(craft.write(program(craft.items, metadata))), random(1))


def test_big_endian_numbers_are_read(craft: Craft):
    craft.files = {name: np.frombuffer(data, "<f4").astype(">f4").tobytes() for name, data in craft.files.items()}
    craft.files["archive/byteorder"] = b"big"
    weights = read_checkpoint(craft.write())
    assert same(weights, random(1))
    assert all(value.dtype == np.float32 for value in weights.values())
    craft.files["archive/byteorder"] = b"middle"
    assert craft.refused() == "byteorder: expected little or big, got b'middle'"


def test_names_that_are_not_the_network_s(craft: Craft):
    nested = {"epoch": integer(3), "state_dict": program(craft.items)[2:-1], "optimizer": b"}" + integer(0) + b"]s"}
    assert craft.refused(program(nested)) == "no tensor of this network in it; its keys: epoch, state_dict, optimizer"
    assert craft.refused(program({})) == "no tensor of this network in it; its keys: none"
    assert craft.refused(program({"b\nc\x00": b"N"})) == r"no tensor of this network in it; its keys: b\nc\x00"
    craft.items["a\n\x1b[31m\u202e" + "x" * 10_000] = b"N"
    assert len(craft.refused()) < 200


TWELVE = tensor(storage("91", 12), (12,), (1,))
SENSELESS = [
    # A number of the storage, repeated a million million times, would not fit into any memory.
    (tensor(storage("91", 12), (10**6, 10**6), (0, 0)), "expected shape (12,), got (1000000, 1000000)"),
    (tensor(storage("91", 12), (2**80,), (1,)), "expected shape (12,)"),
    (tensor(storage("91", 12), (-12,), (1,)), "expected shape (12,)"),
    (tensor(storage("91", 12, "DoubleStorage"), (12,), (1,)), "expected torch.FloatStorage, got torch.DoubleStorage"),
    *((tensor(storage("91", 12), (12,), steps), "offset or strides") for steps in ((2,), (2**62,), (2**80,), (-1,), (), (1, 1))),
    *((tensor(storage("91", 12), (12,), (1,), offset), "offset or strides") for offset in (1, -1, 2**80)),
    *((tensor(storage("91", n), (12,), (1,)), "expected data/91 of") for n in (11, 13, -12, 2**80)),
    (tensor(storage("4711", 12), (12,), (1,)), "expected data/4711 of 12 numbers"),
    (tensor(storage("../data.pkl", 12), (12,), (1,)), "expected data/../data.pkl of 12 numbers"),
    *((value, "expected a tensor") for value in (text("x"), b"N", b"}", b")", b"]", integer(3), REBUILD, storage("91", 12))),
    *((value, "expected a tensor") for value in (REBUILD + b")R", tensor(text("no storage"), (12,), (1,)))),
    (REBUILD + tupled(storage("91", 12), integer(0), text("12"), tupled(integer(1))) + b"R", "expected a tensor"),
    (tupled(b")q\x00", b"h\x00h\x00\x86q\x00" * 10_000), "expected a tensor"),  # twice as long each time
]


@pytest.mark.parametrize(("value", "message"), SENSELESS, ids=range(len(SENSELESS)))
def test_a_tensor_that_is_none_is_named(craft: Craft, value: bytes, message: str):
    craft.items["outc.bias"] = value
    assert craft.refused().startswith(f"outc.bias: {message}")


ATTACKS = [
    (named("os", "system") + TOUCH + b"\x85R", "os.system"),
    (named("builtins", "eval") + TOUCH + b"\x85R", "builtins.eval"),
    (text("os") + text("system") + b"\x93" + TOUCH + b"\x85R", "os.system"),
    (named("collections", "OrderedDict.__init__"), "collections.OrderedDict.__init__"),
    (named("torch", "load"), "torch.load"),
    (named("torch", "os.Storage"), "torch.os.Storage"),
    (ORDERED_DICT + tupled(b"]") + b"R", "collections.OrderedDict with arguments"),
    (named("torch", "FloatStorage") + tupled(integer(2**40)) + b"R", "torch.FloatStorage with arguments"),
    (tensor(text("no storage") + b"Q", (12,), (1,)), "a storage that PyTorch never writes"),
    (tupled(text("storage"), text("FloatStorage"), text("91"), text("cpu"), integer(12)) + b"Q", "a storage that"),
    # instructions that no checkpoint has: INST, OBJ, NEWOBJ, NEWOBJ_EX, EXT1, PERSID, EMPTY_SET, DUP
    *((b"(" + TOUCH + b"ios\nsystem\n", "KeyError"), (b"(" + ORDERED_DICT + b"o", "KeyError")),
    *((ORDERED_DICT + code, "KeyError") for code in (b")\x81", b")}\x92", b"\x82\x01", b"Pname\n", b"\x8f", b"2")),
    (text("x") + b")R", "TypeError"),
    (ORDERED_DICT + b"}" + text("__init__") + REBUILD + b"sb", "AttributeError"),
    (REBUILD + b"N}" + text("__code__") + text("x") + b"s\x86b", "AttributeError"),
    *((pickle.dumps(Attack(), protocol)[2 if protocol else 0 : -1], "KeyError|posix.system|nt.system") for protocol in (0, 2)),
]


@pytest.mark.parametrize(("attack", "message"), ATTACKS, ids=range(len(ATTACKS)))
@pytest.mark.parametrize("nested", [False, True])
def test_nothing_is_imported_called_or_changed(
    craft: Craft, monkeypatch: pytest.MonkeyPatch, attack: bytes, message: str, nested: bool
):
    monkeypatch.chdir(craft.path.parent)
    refused = craft.refused(program({**craft.items, "outc.bias": attack}) if nested else b"\x80\x02" + attack + b".")
    assert re.match(rf"data\.pkl(: damaged pickle \(| asks for )({message})", refused)
    assert os.listdir() == ["some.pkl"]  # noqa: PTH208


DAMAGED = [
    b"", b".", b"\xff\xff", *(b"\x80\x02" + code for code in (
        b".", b"}", b"s.", b"Ns.", b"t.", b"NNNs.", b"NNe.", b"}(Nu.", b"]N(Na.", b"R.", b"Q.", b"b.", b"q\x00.", b"h\x07.",
        b"j\xff\xff\xff\xff.", b"}r\xff\xff\xff\xff0.", b"X\xff\xff\xff\x7fabc.", b"X\x02\x00\x00\x00\xff\xfe.",
        b"B\xff\xff\xff\x7fabc.", b"\x8b\xff\xff\xff\x7f.", b"cos", b"I" + b"9" * 10_000 + b"\n.", b"N.", b"].",
        b"}" + tupled(text("a")) + b"Ns.", b")" + b"\x85" * 200_000 + b".", b"})" + b"\x85" * 200_000 + b"Ns.",
        b"(" * 200_000 + b".", b"]q\x00" + b"h\x00" * 50_000 + b".", b"]q\x00h\x00a.", b"}q\x00" + text("a") + b"h\x00s.",
    )),
    b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.", b"N" * (checkpoint.MAX_PICKLE_BYTES + 1),
]  # fmt: skip


def test_a_damaged_pickle_is_an_error(craft: Craft):
    craft.files = {}
    for pickled in DAMAGED:
        assert craft.refused(pickled)


def test_any_byte_may_be_wrong(craft: Craft):
    """A changed byte gives weights or a WeightsError; no other exception, and no warning."""
    good = program(craft.items)
    generator = stdlib_random.Random(1)
    for _ in range(50):
        spoilt = bytearray(good)
        for _ in range(generator.choice((1, 1, 3))):
            spoilt[generator.randrange(len(spoilt))] = generator.randrange(256)
        with suppress(WeightsError):
            read_checkpoint(craft.write(bytes(spoilt)))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a PyTorch checkpoint: expected a zip archive"),
        (pickle.dumps({"a": 1}, 2), "not a PyTorch checkpoint: expected a zip archive"),
        (pickle.dumps(0x1950A86A20F9469CFC6C, 2) + b"\x80\x02M\xe9\x03.", "the format of PyTorch before 1.6"),
        (b"PK\x03\x04" + b"PK\x01\x02" * 1001, "more than 1000 entries"),
        (bytes(checkpoint.MAX_BYTES + 1), "expected at most 64 MiB, found more"),
    ],
    ids=["empty", "pickle", "old", "entries", "huge"],
)
def test_another_format_is_refused(tmp_path: Path, data: bytes, message: str):
    path = tmp_path / "some.pkl"
    path.write_bytes(data)
    assert refusal(path).startswith(message)
    assert refusal(tmp_path) == "expected a regular file, found a folder"


@pytest.mark.parametrize("share", [0.0001, 0.3, 0.9, 0.999, 0.99999])
def test_a_truncated_archive_is_refused(craft: Craft, share: float):
    data = craft.write().read_bytes()
    craft.path.write_bytes(data[: int(len(data) * share)])
    assert "damaged or truncated zip archive" in refusal(craft.path)


def test_a_damaged_archive_is_refused(craft: Craft):
    good = craft.write().read_bytes()
    entry, header = good.index(b"PK\x01\x02"), good.index(b"PK\x03\x04")

    def changed(*places: tuple[int, bytes]) -> str:
        data = bytearray(good)
        for at, new in places:
            data[at : at + len(new)] = new
        craft.path.write_bytes(data)
        return refusal(craft.path)

    numbers = good.index(random(1)["outc.weight"].astype("<f4").tobytes())
    assert "archive (Bad CRC-32 for file 'archive/data/90')" in changed((numbers + 5, bytes([good[numbers + 5] ^ 1])))
    claim = struct.pack("<I", 2**31)
    assert "compressed" in changed((entry + 24, claim))
    assert "claim more than 64 MiB" in changed((entry + 24, claim), (entry + 20, claim))
    assert "damaged" in changed((header + 6, b"\1"), (entry + 8, b"\1"))
    craft.write(compression=zipfile.ZIP_DEFLATED)
    assert "compressed, which PyTorch never does" in refusal(craft.path)


def test_one_pickle_and_no_two_entries_of_one_name(craft: Craft):
    craft.write()
    with zipfile.ZipFile(craft.path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr("archive/data/0", b"")
    assert "no two of one name" in refusal(craft.path)
    craft.files["other/data.pkl"] = b"N."
    assert "expected one entry data.pkl" in craft.refused()
    with zipfile.ZipFile(craft.path, "w") as file:
        file.writestr("readme.txt", b"hello")
    assert "expected one entry data.pkl" in refusal(craft.path)
