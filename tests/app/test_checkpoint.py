# SPDX-License-Identifier: MIT
"""The authors' checkpoint: read as PyTorch reads it, and never executed."""

import os
import pickle
import random as stdlib_random
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


# What is read


@pytest.mark.parametrize("scene", ["arena", "lewis"])
def test_the_authors_checkpoints_are_read_as_pytorch_reads_them(reference_data: Path, scene: str):
    torch = pytest.importorskip("torch")
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
    path = tmp_path / "some.pth"
    torch.save(state, path, pickle_protocol=protocol)
    assert same(read_checkpoint(path), random(1))


def test_views_of_a_shared_storage_are_read(tmp_path: Path):
    torch = pytest.importorskip("torch")
    state = {name: torch.from_numpy(value.copy()) for name, value in random(1).items()}
    flat = torch.arange(2 * 24 * 12 + 5, dtype=torch.float32)
    state["outc.weight"] = flat[5:].view(24, 12, 2)[:, :, 1].t().reshape(12, 24).t().t().view(12, 24, 1, 1)
    state["outc.bias"] = flat[3::7][:12]
    state["up3.conv.double_conv.2.bias"] = flat[7].expand(24)
    torch.save(state, tmp_path / "some.pth")
    weights = read_checkpoint(tmp_path / "some.pth")
    assert same(weights, {name: value.numpy() for name, value in state.items()})


def test_the_handmade_checkpoint_is_read(craft: Craft):
    assert same(read_checkpoint(craft.write()), random(1))


def test_the_attributes_of_the_dictionary_are_ignored(craft: Craft):
    metadata = b"}" + text("_metadata") + EMPTY + b"sb"
    assert same(read_checkpoint(craft.write(program(craft.items, metadata))), random(1))


def test_big_endian_numbers_are_read(craft: Craft):
    craft.files = {name: np.frombuffer(data, "<f4").astype(">f4").tobytes() for name, data in craft.files.items()}
    craft.files["archive/byteorder"] = b"big"
    weights = read_checkpoint(craft.write())
    assert same(weights, random(1))
    assert all(value.dtype == np.float32 for value in weights.values())


# Tensors that are not the network's


def test_a_missing_tensor_is_named(craft: Craft):
    del craft.items["outc.bias"]
    assert craft.refused() == "outc.bias: missing, of 92 tensors"


def test_an_extra_tensor_is_named(craft: Craft):
    craft.items["fc.bias"] = craft.items["outc.bias"]
    assert craft.refused() == "'fc.bias': not a tensor of this network"


def test_a_misshapen_tensor_is_named_and_not_made(craft: Craft):
    """Each number of the storage repeated a million million times would not fit into any memory."""
    craft.items["outc.bias"] = tensor(storage("91", 12), (10**6, 10**6), (0, 0))
    assert craft.refused() == "outc.bias: expected shape (12,), got (1000000, 1000000)"


@pytest.mark.parametrize(("kind", "dtype"), [("DoubleStorage", "float64"), ("HalfStorage", "float16")])
def test_another_type_is_named(craft: Craft, kind: str, dtype: str):
    craft.items["outc.bias"] = tensor(storage("91", 12, kind), (12,), (1,))
    assert craft.refused() == f"outc.bias: expected dtype float32, got {dtype}"


def test_a_number_that_is_none_is_named(craft: Craft):
    name = "archive/data/" + craft.key("outc.bias")
    craft.files[name] = craft.files[name][:-4] + np.float32(np.nan).tobytes()
    assert craft.refused() == "outc.bias: 1 non-finite values, first at index (11,)"


@pytest.mark.parametrize("value", [text("x"), b"N", b"}", b")", b"]", integer(3), REBUILD, storage("91", 12)])
def test_a_name_without_a_tensor_is_named(craft: Craft, value: bytes):
    craft.items["outc.bias"] = value
    assert craft.refused().startswith("outc.bias: expected a tensor, got ")


def test_another_dictionary_shows_its_keys(craft: Craft):
    nested = {"epoch": integer(3), "state_dict": program(craft.items)[2:-1], "optimizer": b"}" + integer(0) + b"]s"}
    assert craft.refused(program(nested)) == "no tensor of this network in it; its keys: epoch, state_dict, optimizer"
    assert craft.refused(program({})) == "no tensor of this network in it; its keys: none"


SENSELESS = [
    tensor(storage("91", 12), (12,), (1,), offset=1),
    tensor(storage("91", 12), (12,), (2,)),
    tensor(storage("91", 12), (12,), (2**62,)),
    tensor(storage("91", 12), (12,), (-1,), offset=11),
    tensor(storage("91", 12), (12,), (1,), offset=-1),
    tensor(storage("91", 12), (-12,), (1,)),
    tensor(storage("91", 12), (12,), ()),
    tensor(storage("91", 12), (12,), (1, 1)),
    tensor(storage("91", 12), (2**80,), (1,)),
    tensor(storage("91", 12), (2**62,) * 1000, (0,) * 1000),
    tensor(storage("91", -12), (12,), (1,)),
    tensor(storage("91", 2**80), (12,), (1,)),
    tensor(storage("91", 13), (12,), (1,)),
    tensor(storage("91", 11), (12,), (1,)),
    tensor(storage("4711", 12), (12,), (1,)),
    tensor(storage("../data.pkl", 12), (12,), (1,)),
    tensor(text("no storage") + b"Q", (12,), (1,)),
    tensor(text("no storage"), (12,), (1,)),
    tensor(tupled(text("storage"), text("FloatStorage"), text("91"), text("cpu"), integer(12)) + b"Q", (12,), (1,)),
    tensor(tupled(text("storage"), REBUILD, text("91"), text("cpu"), integer(12)) + b"Q", (12,), (1,)),
    tensor(tupled(text("storage"), named("torch", "FloatStorage")) + b"Q", (12,), (1,)),
    REBUILD + b")R",
    REBUILD + text("no tuple") + b"R",
    REBUILD + tupled(storage("91", 12), text("0"), tupled(integer(12)), tupled(integer(1))) + b"R",
    REBUILD + tupled(storage("91", 12), b"\x89", tupled(integer(12)), tupled(integer(1))) + b"R",
    REBUILD + tupled(storage("91", 12), integer(0), text("12"), tupled(integer(1))) + b"R",
]


@pytest.mark.parametrize("value", SENSELESS, ids=range(len(SENSELESS)))
def test_a_description_that_makes_no_sense_is_named(craft: Craft, value: bytes):
    craft.items["outc.bias"] = value
    assert craft.refused().startswith("outc.bias: ")


# Pickles that ask for more than tensors

SYSTEM = text("touch executed")


@pytest.mark.parametrize(
    ("attack", "asks_for"),
    [
        (named("os", "system") + SYSTEM + b"\x85R", "os.system"),
        (named("posix", "system") + SYSTEM + b"\x85R", "posix.system"),
        (named("builtins", "eval") + SYSTEM + b"\x85R", "builtins.eval"),
        (named("__builtin__", "exec") + SYSTEM + b"\x85R", "__builtin__.exec"),
        (b"(" + SYSTEM + b"ios\nsystem\n", "os.system"),
        (b"(" + b"icollections\nOrderedDict\n", "collections.OrderedDict"),
        (text("os") + text("system") + b"\x93" + SYSTEM + b"\x85R", "os.system"),
        (named("collections", "OrderedDict.__init__"), "collections.OrderedDict.__init__"),
        (named("collections", "abc.sys.modules"), "collections.abc.sys.modules"),
        (named("torch._utils", "_rebuild_parameter"), "torch._utils._rebuild_parameter"),
        (named("torch", "load"), "torch.load"),
        (named("numpy", "load"), "numpy.load"),
        (b"(" + named("os", "system") + SYSTEM + b"o", "os.system"),
        (ORDERED_DICT + b")\x81", "the instruction NEWOBJ"),
        (ORDERED_DICT + b")}\x92", "the instruction NEWOBJ_EX"),
        (b"(" + ORDERED_DICT + b"o", "the instruction OBJ"),
        (b"\x82\x01", "the instruction EXT1"),
        (b"\x83\x01\x00", "the instruction EXT2"),
        (b"\x84\x01\x00\x00\x00", "the instruction EXT4"),
        (b"Pname\n", "the instruction PERSID"),
        (b"\x8f", "the instruction EMPTY_SET"),
        (b"2" * 9, "the instruction DUP"),
        (ORDERED_DICT + tupled(b"]") + b"R", "collections.OrderedDict with arguments"),
        (named("torch", "FloatStorage") + tupled(integer(2**40)) + b"R", "torch.FloatStorage with arguments"),
        (text("x") + b")R", "a call of a str"),
        (ORDERED_DICT + b"}" + text("__init__") + REBUILD + b"sb", "attributes of a global"),
        (REBUILD + b"N}" + text("__code__") + text("x") + b"s\x86b", "attributes of a global"),
    ],
)
@pytest.mark.parametrize("nested", [False, True])
def test_nothing_is_imported_called_or_changed(
    craft: Craft, monkeypatch: pytest.MonkeyPatch, attack: bytes, asks_for: str, nested: bool
):
    monkeypatch.chdir(craft.path.parent)
    if nested:
        craft.items["outc.bias"] = attack
        pickled = program(craft.items)
    else:
        pickled = b"\x80\x02" + attack + b"."
    message = f"data.pkl asks for {asks_for}: a checkpoint may hold tensors only; nothing was executed"
    assert craft.refused(pickled) == message
    assert os.listdir() == ["some.pkl"]  # noqa: PTH208


@pytest.mark.parametrize("protocol", range(6))
def test_an_object_that_runs_a_command_does_not(craft: Craft, monkeypatch: pytest.MonkeyPatch, protocol: int):
    class Attack:
        def __reduce__(self) -> Any:
            return os.system, ("touch executed",)

    monkeypatch.chdir(craft.path.parent)
    message = craft.refused(pickle.dumps({"outc.bias": Attack()}, protocol))
    assert "nothing was executed" in message
    assert os.listdir() == ["some.pkl"]  # noqa: PTH208


DAMAGED = [
    b"",
    b".",
    b"\x80\x02.",
    b"\x80\x02}",
    b"\x80\x63}.",
    b"\xff\xff",
    b"\x80\x02s.",
    b"\x80\x02Ns.",
    b"\x80\x02t.",
    b"\x80\x02NNNs.",
    b"\x80\x02NNe.",
    b"\x80\x02}(Nu.",
    b"\x80\x02]N(Na.",
    b"\x80\x02R.",
    b"\x80\x02Q.",
    b"\x80\x02b.",
    b"\x80\x02q\x00.",
    b"\x80\x02h\x07.",
    b"\x80\x02j\xff\xff\xff\xff.",
    b"\x80\x02}r\xff\xff\xff\xff0.",
    b"\x80\x02X\xff\xff\xff\x7fabc.",
    b"\x80\x02X\x02\x00\x00\x00\xff\xfe.",
    b"\x80\x02B\xff\xff\xff\x7fabc.",
    b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\x7f.",
    b"\x80\x02\x8b\xff\xff\xff\x7f.",
    b"\x80\x02\x8b\xff\xff\xff\xff.",
    b"\x80\x02cos",
    b"\x80\x02I" + b"9" * 10_000 + b"\n.",
    b"\x80\x02S'\\q'\n.",
    b"\x80\x02N.",
    b"\x80\x02].",
    b"\x80\x02}" + tupled(text("a")) + b"Ns.",
    b"\x80\x02)" + b"\x85" * 200_000 + b".",
    b"\x80\x02})" + b"\x85" * 200_000 + b"Ns.",
    b"\x80\x02" + b"(" * 200_000 + b".",
    b"\x80\x02" + b"]q\x00" + b"h\x00" * 50_000 + b".",
    b"\x80\x02]q\x00h\x00a.",
    b"\x80\x02}q\x00" + text("a") + b"h\x00s.",
    b"\x80\x02" + b")" + b"\x85" * 100_000 + b"N\x93.",
    b"\x80\x02" + text("os") + b")" + b"\x85" * 100_000 + b"\x93.",
]


@pytest.mark.parametrize("pickled", DAMAGED, ids=range(len(DAMAGED)))
def test_a_damaged_pickle_is_an_error(craft: Craft, pickled: bytes):
    assert craft.refused(pickled)


def test_the_memo_is_bounded_by_the_pickle_not_by_its_numbers(craft: Craft):
    """Python's own machine would make an array of as many places as the number says."""
    assert same(read_checkpoint(craft.write(program(craft.items, b"r\xff\xff\xff\xff"))), random(1))


def test_tuples_that_double_cost_nothing(craft: Craft):
    craft.items["outc.bias"] = tupled(b")q\x00", b"h\x00h\x00\x86q\x00" * 10_000)
    assert craft.refused() == "outc.bias: expected a tensor, got tuple"


def test_text_of_a_stranger_stays_on_one_line(craft: Craft):
    craft.items["a\n\x1b[31m\u202e" + "x" * 10_000] = b"N"
    assert len(craft.refused()) < 200
    message = craft.refused(program({"b\nc\x00": b"N"}))
    assert message == r"no tensor of this network in it; its keys: b\nc\x00"


def test_a_large_pickle_is_refused_before_it_is_read(craft: Craft):
    assert craft.refused(b"N" * (checkpoint.MAX_PICKLE_BYTES + 1)) == "data.pkl is larger than 256 KiB"


def test_any_byte_may_be_wrong(craft: Craft):
    """A changed byte gives weights or a WeightsError; no other exception, and no warning."""
    good = program(craft.items)
    generator = stdlib_random.Random(1)
    for _ in range(150):
        spoilt = bytearray(good)
        for _ in range(generator.choice((1, 1, 3))):
            spoilt[generator.randrange(len(spoilt))] = generator.randrange(256)
        with suppress(WeightsError):
            read_checkpoint(craft.write(bytes(spoilt)))


# Archives


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "the file is empty"),
        (pickle.dumps({"a": 1}, 2), "a bare pickle, not a zip archive"),
        (pickle.dumps(0x1950A86A20F9469CFC6C, 2) + b"\x80\x02M\xe9\x03.", "the format of PyTorch before 1.6"),
        (struct.pack("<Q", 2) + b"{}", "it looks like safetensors"),
        (bytes(257) + b"ustar" + bytes(250), "a tar archive"),
        (b"\x7fELF\x02\x01\x01\x00rest", r"expected a zip archive, the file begins with b'\x7fELF\x02\x01\x01\x00'"),
    ],
)
def test_another_format_is_recognised(tmp_path: Path, data: bytes, message: str):
    path = tmp_path / "some.pkl"
    path.write_bytes(data)
    assert refusal(path).startswith(f"not a PyTorch checkpoint: {message}")


def test_pytorch_s_own_old_format_is_recognised(tmp_path: Path):
    torch = pytest.importorskip("torch")
    path = tmp_path / "old.pkl"
    torch.save({"a": torch.zeros(2)}, path, _use_new_zipfile_serialization=False)
    assert "the format of PyTorch before 1.6" in refusal(path)


def test_what_can_not_be_opened_is_named(tmp_path: Path):
    assert refusal(tmp_path / "absent.pkl") == "No such file or directory"
    assert refusal(tmp_path) == "expected a regular file, found a folder"
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe")
        assert refusal(tmp_path / "pipe") == "expected a regular file, found a pipe"


def test_a_huge_file_is_refused(tmp_path: Path):
    path = tmp_path / "huge.pkl"
    with path.open("wb") as file:
        file.truncate(checkpoint.MAX_BYTES + 1)
    assert refusal(path) == "expected at most 64 MiB, found more"


@pytest.mark.parametrize("share", [0.0001, 0.3, 0.9, 0.999, 0.99999])
def test_a_truncated_archive_is_refused(craft: Craft, share: float):
    data = craft.write().read_bytes()
    craft.path.write_bytes(data[: int(len(data) * share)])
    assert "damaged or truncated zip archive" in refusal(craft.path)


def test_a_wrong_checksum_names_the_tensor(craft: Craft):
    data = bytearray(craft.write().read_bytes())
    values = random(1)["outc.weight"].astype("<f4").tobytes()
    data[data.index(values) + 5] ^= 1
    craft.path.write_bytes(data)
    assert refusal(craft.path).startswith("outc.weight: data/90: damaged zip archive (Bad CRC-32")


def test_a_missing_storage_names_the_tensor(craft: Craft):
    del craft.files["archive/data/91"]
    assert craft.refused() == "outc.bias: data/91 is missing from the zip archive"


def test_a_short_storage_names_the_tensor(craft: Craft):
    craft.files["archive/data/91"] = bytes(44)
    assert craft.refused() == "outc.bias: storage of 12 numbers has 44 bytes"


def test_an_unknown_byte_order_is_refused(craft: Craft):
    craft.files["archive/byteorder"] = b"middle"
    assert craft.refused() == "byteorder: expected little or big, got b'middle'"


def test_a_compressed_entry_is_refused(craft: Craft):
    """A zip bomb must be compressed."""
    craft.write(compression=zipfile.ZIP_DEFLATED)
    assert refusal(craft.path) == "archive/data.pkl is compressed, which PyTorch never does"


def test_an_entry_that_lies_about_its_size_is_refused(craft: Craft):
    data = bytearray(craft.write().read_bytes())
    entry = data.index(b"PK\x01\x02")
    data[entry + 24 : entry + 28] = struct.pack("<I", 2**31)
    craft.path.write_bytes(data)
    assert "compressed" in refusal(craft.path)
    data[entry + 20 : entry + 24] = struct.pack("<I", 2**31)
    craft.path.write_bytes(data)
    assert "claim more than 64 MiB" in refusal(craft.path)


def test_an_encrypted_entry_is_refused(craft: Craft):
    data = bytearray(craft.write().read_bytes())
    for signature, flags in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(signature) + flags] |= 1
    craft.path.write_bytes(data)
    assert "data.pkl: damaged zip archive" in refusal(craft.path)


def test_many_entries_are_refused(craft: Craft):
    craft.files |= {f"archive/data/{key}": b"" for key in range(1000, 2000)}
    assert craft.refused() == "more than 1000 entries in the zip archive"


def test_two_entries_of_one_name_are_refused(craft: Craft):
    craft.write()
    with zipfile.ZipFile(craft.path, "a") as file, pytest.warns(UserWarning, match="Duplicate name"):
        file.writestr("archive/data.pkl", b"N.")
    assert refusal(craft.path) == "the zip archive has two entries of one name"


def test_an_archive_without_a_pickle_or_with_two_is_refused(craft: Craft):
    craft.files["other/data.pkl"] = b"N."
    assert "2 entries named data.pkl" in craft.refused()
    with zipfile.ZipFile(craft.path, "w") as file:
        file.writestr("readme.txt", b"hello")
    assert "0 entries named data.pkl" in refusal(craft.path)


def test_a_torchscript_program_is_recognised(craft: Craft):
    craft.files["archive/constants.pkl"] = b"N."
    assert craft.refused() == "a TorchScript program, not a checkpoint"
