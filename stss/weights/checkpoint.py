# SPDX-License-Identifier: MIT
"""The authors' checkpoint, read without PyTorch and without executing anything in it.

A checkpoint is a zip archive of one pickle, ``data.pkl``, and the numbers of each storage, ``data/0``, ``data/1``, ... Its pickle can
only make a dictionary of descriptions, and no class or function of Python.

Source: spec 10.
"""

from __future__ import annotations

import io
import pickle
import re
import zipfile
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, NoReturn

import numpy as np

from stss_ground.regular_file import read_regular
from stss_ref.arrays import Array
from stss_ref.weights import TENSORS, Weights, WeightsError, check, require_names, require_shape

MAX_BYTES, MAX_ENTRIES, MAX_PICKLE_BYTES = 64 * 2**20, 1000, 256 * 2**10
"""Bounds of the file, of its entries' claims and number, and of ``data.pkl``."""

_DICT, _TENSOR, _FLOATS = "collections.OrderedDict", "torch._utils._rebuild_tensor_v2", "torch.FloatStorage"
_BEFORE_1_6 = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19"
_INSTRUCTIONS = (
    b"\x80\x95.("  # PROTO, FRAME, STOP, MARK
    b"NX\x8cJKM\x8aG\x88\x89"  # NONE, text, whole numbers, a float, True, False
    b")t\x85\x86\x87}su]ae"  # tuples, dictionaries, lists
    b"qr\x94hj"  # to and from the memo
    b"c\x93RbQ"  # GLOBAL, STACK_GLOBAL, REDUCE, BUILD, BINPERSID
)
"""The instructions of a pickle that PyTorch writes."""


def read_checkpoint(path: str | Path) -> Weights:
    """Read the weights that the authors published as a PyTorch file.

    Args:
        path: the file; written by ``torch.save(model.state_dict())`` of PyTorch 1.6 or newer.

    Returns:
        The 92 tensors, checked, with the paper's hole test.

    Raises:
        WeightsError: the file can't be read, is damaged, is something else, asks for anything but tensors, or a tensor
            does not fit the network. The message names the file and the tensor.
    """
    try:
        return _weights(_entries(read_regular(Path(path), MAX_BYTES)))
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from error
    except OSError as error:
        raise WeightsError(f"{path}: {error.strerror or error}") from error


def _short(text: str) -> str:
    """Text from a file of unknown origin, cut and escaped for a message of one line."""
    return repr(text[:80])[1:-1]


def _entries(data: bytes) -> dict[str, bytes]:
    """The files of the archive, without the folder that they lie in."""
    if data.startswith(_BEFORE_1_6):
        raise WeightsError("the format of PyTorch before 1.6; load it there and save it again with a newer PyTorch")
    if not data.startswith(b"PK\x03\x04"):
        raise WeightsError(f"not a PyTorch checkpoint: expected a zip archive, the file begins with {data[:8]!r}")
    # No archive has more entries than signatures of one, so this comes before the directory is read.
    if data.count(b"PK\x01\x02") > MAX_ENTRIES:
        raise WeightsError(f"more than {MAX_ENTRIES} entries in the zip archive")
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
        entries = archive.infolist()
        # Only compressed or overlapping entries are together larger than the file.
        if any(entry.compress_type != zipfile.ZIP_STORED or entry.file_size != entry.compress_size for entry in entries):
            raise WeightsError("an entry of the zip archive is compressed, which PyTorch never does")
        if sum(entry.file_size for entry in entries) > MAX_BYTES:
            raise WeightsError(f"the entries of the zip archive claim more than {MAX_BYTES >> 20} MiB")
        files = {entry.filename: archive.read(entry) for entry in entries}
    except WeightsError:
        raise
    except Exception as error:
        # For arbitrary bytes zipfile raises struct.error, ValueError and others.
        raise WeightsError(f"damaged or truncated zip archive ({_short(str(error))})") from error
    pickles = [name for name in files if re.fullmatch(r"([^/]+/)?data\.pkl", name)]
    if len(pickles) != 1 or len(files) < len(entries):
        raise WeightsError("not a PyTorch checkpoint: expected one entry data.pkl in the zip archive, and no two of one name")
    prefix = pickles[0].removesuffix("data.pkl")
    return {name.removeprefix(prefix): content for name, content in files.items()}


def _weights(files: dict[str, bytes]) -> Weights:
    if len(files["data.pkl"]) > MAX_PICKLE_BYTES:
        raise WeightsError(f"data.pkl is larger than {MAX_PICKLE_BYTES >> 10} KiB")
    try:
        dictionary = _Reader(io.BytesIO(files["data.pkl"])).load()
    except WeightsError:
        raise
    except Exception as error:
        # A stranger's bytes: an empty stack, an instruction without a method, text that isn't UTF-8, ...
        raise WeightsError(f"data.pkl: damaged pickle ({type(error).__name__}: {_short(str(error))})") from error
    if not isinstance(dictionary, _Dict):
        raise WeightsError(f"data.pkl: expected a dictionary of tensors, got {type(dictionary).__name__}")
    names = [str(name) for name in dictionary]
    if not set(names) & set(TENSORS):
        keys = ", ".join(_short(name) for name in names[:5]) + (", ..." if len(names) > 5 else "")
        raise WeightsError(f"no tensor of this network in it; its keys: {keys or 'none'}")
    require_names(names)
    order = files.get("byteorder", b"little")  # before PyTorch 2.1 there is none
    if order not in {b"little", b"big"}:
        raise WeightsError(f"byteorder: expected little or big, got {order[:20]!r}")
    dtype = np.dtype("<f4" if order == b"little" else ">f4")
    tensors = {name: _tensor(name, dictionary[name], files, dtype) for name in TENSORS}
    return check(Weights(tensors, hole_test="paper"))


def _tensor(name: str, value: object, files: dict[str, bytes], dtype: np.dtype[Any]) -> Array:
    match value:
        case _View((_Storage(kind, key, length), int(offset), tuple(shape), tuple(strides), *_)):
            pass
        case _:
            raise WeightsError(f"{name}: expected a tensor as PyTorch writes it, got {type(value).__name__}")
    require_shape(name, shape)
    if kind != _FLOATS:
        raise WeightsError(f"{name}: expected {_FLOATS}, got {_short(kind)}")
    data = files.get(f"data/{key}")
    if data is None or len(data) != length * dtype.itemsize:
        raise WeightsError(f"{name}: expected data/{_short(key)} of {length} numbers in the zip archive")
    try:
        return np.ndarray(shape, dtype, data, offset * dtype.itemsize, [step * dtype.itemsize for step in strides]).astype(
            np.float32, "C"
        )
    except (TypeError, ValueError, OverflowError) as error:
        raise WeightsError(f"{name}: offset or strides do not fit its storage ({_short(str(error))})") from error


class _Storage(NamedTuple):
    """A storage: its type, the file ``data/KEY``, and how many numbers it holds."""

    kind: str
    key: str
    length: int


class _View(NamedTuple):
    """A tensor: the arguments of the function that PyTorch makes it with."""

    arguments: tuple[object, ...]


class _Dict(dict[str | int, Any]):
    """A dictionary of the pickle; its attributes, the versions of PyTorch's modules, are not needed."""

    def __setitem__(self, key: object, value: object) -> None:
        if not isinstance(key, str | int):  # the hash of a tuple of tuples of tuples ... would overflow the stack
            raise WeightsError(f"data.pkl: a {type(key).__name__} as a name")
        super().__setitem__(key, value)

    def __setstate__(self, state: object) -> None:
        pass


class _Global(NamedTuple):
    """The meaning of the name of a class or a function; nothing in a pickle can change it."""

    name: str

    def __call__(self, *arguments: object) -> object:
        if self.name == _DICT and not arguments:
            return _Dict()
        if self.name == _TENSOR:
            return _View(arguments)
        return _refuse(f"{self.name} with arguments")


def _refuse(what: str) -> NoReturn:
    raise WeightsError(f"data.pkl asks for {_short(what)}: a checkpoint may hold tensors only; nothing was executed")


_Machine: Any = pickle._Unpickler  # noqa: SLF001  # the machine in Python: its memo grows with the pickle, not with its numbers


class _Reader(_Machine):
    """Python's machine for pickles, limited to the instructions of tensors, which can import nothing."""

    dispatch: ClassVar[dict[int, Any]] = {code: _Machine.dispatch[code] for code in _INSTRUCTIONS}

    def load_empty_dictionary(self) -> None:
        self.append(_Dict())

    dispatch[ord("}")] = load_empty_dictionary

    def find_class(self, module: str, name: str) -> _Global:
        """The inert `_Global` of a name that tensors need."""
        full = f"{module}.{name}"
        if full not in {_DICT, _TENSOR} and not re.fullmatch(r"torch\.[A-Za-z0-9]+Storage", full):
            _refuse(full)
        return _Global(full)

    def persistent_load(self, pid: object) -> _Storage:
        """The description of a storage."""
        match pid:
            case ("storage", _Global(kind), str(key), str(), int(length)):  # pyrefly: ignore[bad-match]
                return _Storage(kind, key, length)
            case _:
                _refuse("a storage that PyTorch never writes")
