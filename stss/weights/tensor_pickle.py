# SPDX-License-Identifier: MIT
"""What the pickle inside a checkpoint describes, found without executing it.

A pickle is a program for a small stack machine, and Python's own machine can import and call anything. This one has
only the instructions that a dictionary of tensors needs; it builds tuples, lists, dictionaries and descriptions, and
has nothing to import or call with. An instruction adds a few words of memory at most; no number in the pickle makes it
allocate more.

Source: spec 10; the instructions, Python's ``pickletools``.
"""

from __future__ import annotations

import pickletools
from typing import NamedTuple, cast

from stss_ref.weights import WeightsError

_DICT = "collections.OrderedDict"
_TENSOR = "torch._utils._rebuild_tensor_v2"
_STORAGES = {
    "torch.FloatStorage": "float32",
    "torch.DoubleStorage": "float64",
    "torch.HalfStorage": "float16",
    "torch.BFloat16Storage": "bfloat16",
    "torch.LongStorage": "int64",
    "torch.IntStorage": "int32",
    "torch.ShortStorage": "int16",
    "torch.CharStorage": "int8",
    "torch.ByteStorage": "uint8",
    "torch.BoolStorage": "bool",
}

_PUSH = frozenset({"BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"})
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False, "EMPTY_TUPLE": ()}
_SHORT_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUT = frozenset({"BINPUT", "LONG_BINPUT", "MEMOIZE"})
_GET = frozenset({"BINGET", "LONG_BINGET"})
_IGNORED = frozenset({"PROTO", "FRAME", "STOP"})
_REFUSED = "a checkpoint may hold tensors only; nothing was executed"
_MAX_AXES = 8


class _Global(NamedTuple):
    name: str


class _Storage(NamedTuple):
    arguments: object


class _Tensor(NamedTuple):
    arguments: object


class Tensor(NamedTuple):
    """A view of a storage, as the pickle describes it.

    Attributes:
        dtype: type of the numbers, in NumPy's word (and ``bfloat16``).
        storage: name of the storage, the file ``data/NAME`` of the archive.
        length: numbers in the storage.
        offset: place of the first number in the storage.
        shape: lengths of the axes.
        strides: step in the storage along each axis, in numbers.
    """

    dtype: str
    storage: str
    length: int
    offset: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]


def short(text: str) -> str:
    """Text from a file of unknown origin, cut and escaped for a message of one line."""
    return repr(text[:80])[1:-1]


def describe(pickle: bytes) -> dict[object, object]:
    """The dictionary that ``pickle`` describes; its values are for `tensor`.

    Raises:
        WeightsError: it is damaged, is not a dictionary, or asks for anything but tensors.
    """
    try:
        result = _Machine().run(pickle)
    except WeightsError:
        raise
    except Exception as error:
        # A stranger's bytes: an empty stack, a number missing from the memo, text that isn't UTF-8, ...
        raise WeightsError(f"data.pkl: damaged pickle ({type(error).__name__}: {short(str(error))})") from error
    if not isinstance(result, dict):
        raise WeightsError(f"data.pkl: expected a dictionary of tensors, got {_kind(result)}")
    return cast("dict[object, object]", result)


def tensor(name: str, value: object) -> Tensor:
    """Read the description of tensor ``name`` from ``value``, one of the values of `describe`.

    Raises:
        WeightsError: it is not a tensor, its description is not of PyTorch's form, or it reaches out of its storage.
    """
    match value:
        case _Tensor((_Storage(("storage", _Global(kind), str(key), str(), length)), offset, shape, strides, *_)):
            pass
        case _Tensor():
            raise WeightsError(f"{name}: a tensor with arguments that PyTorch never writes")
        case _:
            raise WeightsError(f"{name}: expected a tensor, got {_kind(value)}")
    if kind not in _STORAGES:
        raise WeightsError(f"{name}: {short(kind)} is no storage")
    sizes, steps = _naturals(name, shape), _naturals(name, strides)
    count, start = _naturals(name, (length, offset))
    if len(sizes) != len(steps) or len(sizes) > _MAX_AXES:
        raise WeightsError(f"{name}: {len(sizes)} axes, {len(steps)} strides")
    last = start + sum((n - 1) * step for n, step in zip(sizes, steps, strict=True))
    if 0 not in sizes and last >= count:
        raise WeightsError(f"{name}: reaches number {last} of a storage of {count}")
    return Tensor(_STORAGES[kind], key, count, start, sizes, steps)


def _naturals(name: str, values: object) -> tuple[int, ...]:
    items = cast("tuple[object, ...]", values) if isinstance(values, tuple) else (None,)
    numbers = tuple(item for item in items if type(item) is int and 0 <= item < 2**63)
    if len(numbers) < len(items):
        raise WeightsError(f"{name}: a size, stride or offset that is no natural number")
    return numbers


def _refusal(what: str) -> WeightsError:
    return WeightsError(f"data.pkl asks for {short(what)}: {_REFUSED}")


def _kind(value: object) -> str:
    return type(value).__name__.strip("_").lower()


class _Machine:
    """The stack machine of Python's pickles, without the instructions that make objects of classes."""

    def __init__(self) -> None:
        self._stack: list[object] = []
        self._stacks: list[list[object]] = []  # those below each mark
        self._memo: dict[int, object] = {}

    def run(self, pickle: bytes) -> object:
        for instruction, argument, _ in pickletools.genops(pickle):
            self._step(instruction.name, argument)
        return self._stack.pop()

    def _step(self, name: str, argument: object) -> None:
        stack = self._stack
        if name in _PUSH:
            stack.append(argument)
        elif name in _CONSTANTS:
            stack.append(_CONSTANTS[name])
        elif name in _PUT:
            self._memo[argument if isinstance(argument, int) else len(self._memo)] = stack[-1]
        elif name in _GET:
            stack.append(self._memo[cast("int", argument)])
        elif name in _SHORT_TUPLES:
            items = [stack.pop() for _ in range(_SHORT_TUPLES[name])]
            stack.append(tuple(reversed(items)))
        elif name == "EMPTY_DICT":
            stack.append({})
        elif name == "EMPTY_LIST":
            stack.append([])
        elif name == "MARK":
            self._stacks.append(stack)
            self._stack = []
        elif name not in _IGNORED:
            self._change(name, argument)

    def _change(self, name: str, argument: object) -> None:
        match name:
            case "TUPLE":
                items = self._above_mark()
                self._stack.append(tuple(items))
            case "SETITEMS":
                self._set_items(self._above_mark())
            case "SETITEM":
                value, key = self._stack.pop(), self._stack.pop()
                self._set_items([key, value])
            case "APPENDS":
                self._append(self._above_mark())
            case "APPEND":
                self._append([self._stack.pop()])
            case "BINPERSID":
                self._stack.append(_Storage(self._stack.pop()))
            case "REDUCE":
                self._reduce()
            case "BUILD":
                self._build()
            case "GLOBAL":
                self._global(str(argument).replace(" ", "."))
            case "STACK_GLOBAL":
                attribute, module = self._stack.pop(), self._stack.pop()
                self._global(f"{module}.{attribute}")
            case "INST":
                raise _refusal(str(argument).replace(" ", "."))
            case _:
                raise _refusal(f"the instruction {name}")

    def _above_mark(self) -> list[object]:
        items, self._stack = self._stack, self._stacks.pop()
        return items

    def _set_items(self, items: list[object]) -> None:
        target = self._stack[-1]
        if not isinstance(target, dict):
            raise WeightsError(f"data.pkl: damaged pickle (items for a {_kind(target)})")
        entries = cast("dict[object, object]", target)
        for key, value in zip(items[::2], items[1::2], strict=True):
            # The hash of a tuple of tuples of tuples ... would overflow the C stack.
            if not isinstance(key, str | int | float | None):
                raise WeightsError(f"data.pkl: a {_kind(key)} as a name")
            entries[key] = value

    def _append(self, items: list[object]) -> None:
        target = self._stack[-1]
        if not isinstance(target, list):
            raise WeightsError(f"data.pkl: damaged pickle (items for a {_kind(target)})")
        cast("list[object]", target).extend(items)

    def _global(self, name: str) -> None:
        if name not in {_DICT, _TENSOR, *_STORAGES}:
            raise _refusal(name)
        self._stack.append(_Global(name))

    def _reduce(self) -> None:
        arguments, function = self._stack.pop(), self._stack.pop()
        match function:
            case _Global(name) if name == _DICT and arguments == ():
                self._stack.append({})
            case _Global(name) if name == _TENSOR:
                self._stack.append(_Tensor(arguments))
            case _Global(name):
                raise _refusal(f"{name} with arguments")
            case _:
                raise _refusal(f"a call of a {_kind(function)}")

    def _build(self) -> None:
        # PyTorch sets one attribute of the dictionary, the versions of the modules it came from: not needed.
        self._stack.pop()
        if not isinstance(self._stack[-1], dict):
            raise _refusal(f"attributes of a {_kind(self._stack[-1])}")
