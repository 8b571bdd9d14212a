# SPDX-License-Identifier: MIT
"""The authors' checkpoint, read without PyTorch and without executing it.

A checkpoint is a zip archive of one pickle, ``data.pkl``, and the numbers of each storage, ``data/0``, ``data/1``, ...
What the pickle describes is compared with the table of the network before any array is made.

Source: spec 10.
"""

from __future__ import annotations

import io
import re
import zipfile
from pathlib import Path

import numpy as np

from stss.weights.tensor_pickle import describe, short, tensor
from stss_ground.regular_file import read_regular
from stss_ref.arrays import Array
from stss_ref.weights import TENSORS, Weights, WeightsError, check, require_names, require_shape

MAX_BYTES = 64 * 2**20
MAX_ENTRIES = 1000
MAX_PICKLE_BYTES = 256 * 2**10

_LEGACY_MAGIC = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19"


def read_checkpoint(path: str | Path) -> Weights:
    """Read the weights that the authors published as a PyTorch file.

    Args:
        path: the file; written by ``torch.save(model.state_dict())`` of PyTorch 1.6 or newer.

    Returns:
        The 92 tensors, checked.

    Raises:
        WeightsError: the file can't be read, is damaged, is something else, asks for anything but tensors, or a tensor
            is not what the network takes. The message names the file and the tensor.
    """
    try:
        return _Archive(_read_file(Path(path))).weights()
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from error


def _read_file(path: Path) -> bytes:
    data = read_regular(path, MAX_BYTES)
    if not data.startswith(b"PK\x03\x04"):
        raise WeightsError(f"not a PyTorch checkpoint: {_kind(data)}")
    return data


def _kind(data: bytes) -> str:
    if not data:
        return "the file is empty"
    if data.startswith(_LEGACY_MAGIC):
        return "the format of PyTorch before 1.6; load it there and save it again with a newer PyTorch"
    if data.startswith(b"\x80"):
        return "a bare pickle, not a zip archive"
    if data[8:9] == b"{":
        return "it looks like safetensors, which needs no import"
    if data[257:262] == b"ustar":
        return "a tar archive"
    return f"expected a zip archive, the file begins with {data[:8]!r}"


class _Archive:
    """A checkpoint's zip archive; its bounds are checked before anything of it is unpacked."""

    def __init__(self, data: bytes) -> None:
        # No archive has more entries than signatures of one, so this comes before the directory is read.
        if data.count(b"PK\x01\x02") > MAX_ENTRIES:
            raise WeightsError(f"more than {MAX_ENTRIES} entries in the zip archive")
        try:
            self._zip = zipfile.ZipFile(io.BytesIO(data))
        except Exception as error:
            # The bytes may be anything: zipfile lets struct.error, ValueError and others through.
            raise WeightsError(f"damaged or truncated zip archive ({short(str(error))})") from error
        entries = self._zip.infolist()
        self._entries = {entry.filename: entry for entry in entries}
        if len(self._entries) < len(entries):
            raise WeightsError("the zip archive has two entries of one name")
        for entry in entries:
            if entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size:
                raise WeightsError(f"{short(entry.filename)} is compressed, which PyTorch never does")
        if sum(entry.file_size for entry in entries) > MAX_BYTES:
            raise WeightsError(f"the entries of the zip archive claim more than {MAX_BYTES >> 20} MiB")
        pickles = [name for name in self._entries if re.fullmatch(r"([^/]+/)?data\.pkl", name)]
        if len(pickles) != 1:
            raise WeightsError(f"not a PyTorch checkpoint: {len(pickles)} entries named data.pkl in the zip archive")
        self._prefix = pickles[0].removesuffix("data.pkl")
        if f"{self._prefix}constants.pkl" in self._entries:
            raise WeightsError("a TorchScript program, not a checkpoint")
        self._storages: dict[str, bytes] = {}

    def _read(self, name: str) -> bytes:
        entry = self._entries[self._prefix + name]
        try:
            data = self._zip.read(entry)
        except Exception as error:
            # As above; a wrong checksum is BadZipFile.
            raise WeightsError(f"{name}: damaged zip archive ({short(str(error))})") from error
        if len(data) != entry.file_size:
            raise WeightsError(f"{name}: damaged zip archive, {len(data)} of {entry.file_size} bytes")
        return data

    def _byte_order(self) -> str:
        if f"{self._prefix}byteorder" not in self._entries:
            return "<"  # before PyTorch 2.1
        order = self._read("byteorder")
        if order not in {b"little", b"big"}:
            raise WeightsError(f"byteorder: expected little or big, got {order[:20]!r}")
        return "<" if order == b"little" else ">"

    def weights(self) -> Weights:
        """Compare what the pickle describes with the network, and read that."""
        if self._entries[f"{self._prefix}data.pkl"].file_size > MAX_PICKLE_BYTES:
            raise WeightsError(f"data.pkl is larger than {MAX_PICKLE_BYTES >> 10} KiB")
        described = describe(self._read("data.pkl"))
        names = [str(name) for name in described]
        if not set(names) & set(TENSORS):
            found = ", ".join(short(name) for name in names[:5]) + (", ..." if len(names) > 5 else "")
            raise WeightsError(f"no tensor of this network in it; its keys: {found or 'none'}")
        require_names(names)
        order = self._byte_order()
        return check({name: self._tensor(name, described[name], order) for name in TENSORS})

    def _tensor(self, name: str, value: object, order: str) -> Array:
        view = tensor(name, value)
        require_shape(name, view.shape)
        if view.dtype != "float32":
            raise WeightsError(f"{name}: expected dtype float32, got {view.dtype}")
        data = self._storage(name, view.storage)
        if len(data) != 4 * view.length:
            raise WeightsError(f"{name}: storage of {view.length} numbers has {len(data)} bytes")
        strides = tuple(4 * step for step in view.strides)
        numbers = np.ndarray(view.shape, f"{order}f4", data, 4 * view.offset, strides)
        return numbers.astype(np.float32, order="C")

    def _storage(self, name: str, storage: str) -> bytes:
        if storage not in self._storages:
            if f"{self._prefix}data/{storage}" not in self._entries:
                raise WeightsError(f"{name}: data/{short(storage)} is missing from the zip archive")
            try:
                self._storages[storage] = self._read(f"data/{storage}")
            except WeightsError as error:
                raise WeightsError(f"{name}: {error}") from error
        return self._storages[storage]
