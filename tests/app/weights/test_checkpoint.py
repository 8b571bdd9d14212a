# SPDX-License-Identifier: MIT
"""The authors' checkpoint: read as PyTorch reads it, and never executed."""

import os
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stss.weights import checkpoint
from stss.weights.checkpoint import read_checkpoint
from stss_ref.weights import TENSORS, WeightsError, random


class Call:
    """An object whose pickle calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.what = function, arguments

    def __reduce__(self) -> Any:
        return self.what


def refusal(path: Path) -> str:
    with pytest.raises(WeightsError) as error:
        read_checkpoint(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ")
    assert message.isprintable()
    return message.removeprefix(f"{path}: ")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "some.pkl"


def write(path: Path, content: object) -> None:
    """An archive like PyTorch's, of one pickle."""
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("archive/data.pkl", content if isinstance(content, bytes) else pickle.dumps(content, 2))


def saved(path: Path, **changed: Any) -> dict[str, Any]:
    """Save random weights as PyTorch does, some of them changed."""
    torch = pytest.importorskip("torch")
    state = OrderedDict((name, torch.from_numpy(value.copy())) for name, value in random(1).items())
    state |= {name.replace("__", "."): make(torch) for name, make in changed.items()}
    torch.save(state, path)
    return state


def test_what_pytorch_saves_today_is_read(path: Path):
    """Also views of a larger storage, whose strides and offset are their own."""
    torch = pytest.importorskip("torch")
    state = saved(path)
    flat = torch.arange(2 * 24 * 12 + 5, dtype=torch.float32)
    state["outc.weight"] = flat[5:].view(24, 12, 2)[:, :, 1].t().reshape(12, 24).t().t().view(12, 24, 1, 1)
    state["outc.bias"] = flat[3::7][:12]
    torch.save(state, path)
    tensors = read_checkpoint(path)
    assert all(np.array_equal(tensors[name], state[name].numpy()) for name in TENSORS)
    torch.save(state, path, _use_new_zipfile_serialization=False)
    assert "the format of PyTorch before 1.6" in refusal(path)


@pytest.mark.parametrize(
    ("name", "make", "message"),
    [
        ("outc__bias", lambda torch: torch.zeros(13), "outc.bias: expected shape (12,), got (13,)"),
        ("outc__bias", lambda torch: "x", "outc.bias: expected a tensor as PyTorch writes it, got str"),
        ("outc__more", lambda torch: torch.zeros(1), "'outc.more': not a tensor of this network"),
    ],
)
def test_a_tensor_that_does_not_fit_is_named(path: Path, name: str, make: Any, message: str):
    saved(path, **{name: make})
    assert refusal(path).startswith(message)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"epoch": 3, "state_dict": OrderedDict()}, "no tensor of this network in it; its keys: epoch, state_dict"),
        ({"outc.bias": Call(os.system, "touch executed")}, r"data.pkl asks for posix.system|data.pkl asks for nt.system"),
        (b"\x80\x02cos\nsystem\nX\x01\x00\x00\x00x\x85R.", "data.pkl asks for os.system"),
        (b"\x80\x02]q\x00h\x00a", "data.pkl: damaged pickle"),
    ],
)
def test_nothing_but_tensors_is_read(path: Path, monkeypatch: pytest.MonkeyPatch, content: object, message: str):
    """No function is called, nor is one imported."""
    monkeypatch.chdir(path.parent)
    write(path, content)
    assert refusal(path).startswith(tuple(message.split("|")))
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("data", [b"", pickle.dumps({"a": 1}, 2)], ids=["empty", "pickle"])
def test_another_format_is_refused(path: Path, data: bytes):
    path.write_bytes(data)
    assert refusal(path).startswith("not a PyTorch checkpoint: expected a zip archive")
    os.truncate(path, checkpoint.MAX_BYTES + 1)
    assert refusal(path).startswith("expected at most 64 MiB, found more")


def test_a_damaged_archive_is_refused(path: Path):
    saved(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * 0.999)])
    assert "damaged or truncated zip archive" in refusal(path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
    assert "damaged or truncated zip archive (Bad CRC-32" in refusal(path)
