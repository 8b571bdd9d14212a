# SPDX-License-Identifier: MIT
"""Copies of the reference with changed source, as ports: mistakes, and correct ports with other arithmetic.

A copy has all of `stss_ref`, and ``conformance/protocol/stages.py``, under another package name. It is made in memory and leaves no
trace in ``sys.modules``. It computes in the dtype of its inputs, so in float32 as a port.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import numpy as np

import conformance.protocol.stages
import stss_ref
from conformance.protocol.layers import Watched, chosen
from conformance.protocol.port import AnyArray, Arrays, Outputs
from conformance.protocol.stages import STAGES
from conformance.tolerance import ratio
from stss_ref.weights import Weights

ROOT = Path(stss_ref.__file__).parent
STAGES_FILE = Path(conformance.protocol.stages.__file__)
PACKAGE = "stss_variant"
"""Package name of every copy; only one copy is made at a time."""

Change = tuple[str, str, str]
"""File, old text, new text. A file is named without its folder: one of `stss_ref`, or ``stages.py``."""
Functions = Mapping[str, Callable[..., Any]]
"""``module.function`` -> the function that replaces it."""


class VariantError(ValueError):
    """A change does not fit the reference as it is now; the message names the file and the text."""


@dataclass(frozen=True)
class Mistake:
    """A mistake that a porter could make.

    Attributes:
        stage: its tests ought to catch the mistake. It is the narrowest stage; ``network`` and ``frame``, which contain it, fail, too.
        name: unique within the stage.
        what: the mistake, in one line.
        changes: the mistake, as changes of the reference's source.
        also: other narrow stages whose tests ought to catch it, since they share the code.
        bits: the numbers stay within any bound, so that only a test of exact bits can catch it.
        large: no small frame shows it.
    """

    stage: str
    name: str
    what: str
    changes: tuple[Change, ...]
    also: tuple[str, ...] = ()
    bits: bool = False
    large: bool = False

    @property
    def id(self) -> str:
        """An identifier: ``warp_x_sign``."""
        return f"{self.stage}_{self.name}"

    def port(self) -> Variant:
        """The reference with this mistake; VariantError if it no longer applies."""
        return load(self.id, self.changes)


def fault(stage: str, name: str, what: str, *change: str, more: Sequence[Change] = (), **marks: Any) -> Mistake:
    """Make a mistake from the change ``file, old, new``, and from the changes ``more``."""
    file, old, new = change
    return Mistake(stage, name, what, ((file, old, new), *more), **marks)


class Variant:
    """A copy as a port (`conformance.protocol.port.Port`).

    Attributes:
        name: shown in reports.
        dtype: ``float32`` or ``float16``; picks the bounds.
        winograd: it uses Winograd convolutions at stride 1, whose bits and errors depend on more than the window.
    """

    def __init__(
        self,
        name: str,
        reference: Callable[..., Outputs],
        watched: Watched,
        dtype: str = "float32",
        winograd: bool = False,
        entry: Callable[[AnyArray], AnyArray] | None = None,
    ):
        """Make a port of a copy's ``reference`` and ``watched``; ``entry`` first changes every float array and weight."""
        self.name = name
        self.dtype = dtype
        self.winograd = winograd
        self._reference = reference
        self._entry = entry
        self._watched = watched

    def __repr__(self) -> str:
        return f"Variant({self.name!r})"

    def stages(self) -> frozenset[str]:
        """All stages."""
        return frozenset(STAGES)

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """See `conformance.protocol.port.Port`. Wrong numbers raise no NumPy warning, since other languages give none."""
        if (entry := self._entry) is not None:
            inputs = {name: entry(array) if array.dtype.kind == "f" else array for name, array in inputs.items()}
            weights = None if weights is None else weights.convert(entry)
        with np.errstate(all="ignore"):
            return self._reference(stage, inputs, weights)

    def layers(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Activations of the stage's layers, see `conformance.protocol.layers`."""
        with self._watched() as seen:
            self.run(stage, inputs, weights)
        return chosen(stage, seen)


def load(name: str, changes: Sequence[Change] = (), functions: Functions | None = None, **port: Any) -> Variant:
    """Make a copy of the reference and change it.

    Args:
        name: of the port.
        changes: texts to replace, one after the other; each must occur exactly once.
        functions: functions to replace; modules that import one get the new one.
        port: further arguments of `Variant`.

    Raises:
        VariantError: a text does not occur exactly once, or there is no such file or function.
    """
    finder = _Copy(_changed(changes), functions or {})
    sys.meta_path.insert(0, finder)
    try:
        stages, watch = import_module(f"{PACKAGE}.stages"), import_module(f"{PACKAGE}.watch")
    finally:
        sys.meta_path.remove(finder)
        for module in [module for module in sys.modules if module.partition(".")[0] == PACKAGE]:
            del sys.modules[module]
    if missing := sorted(set(finder.functions) - finder.replaced):
        raise VariantError(f"{missing[0]}: no such function in the reference")
    return Variant(name, stages.reference, watch.watched, **port)


def departs(got: Outputs, want: Outputs, row: str | None) -> bool:
    """Whether outputs differ by more than ``row`` of the table of bounds allows, or at all if ``row`` is None; masks may never differ.

    The row's floor is meant for numbers of order 1, so larger outputs are divided by their largest number.
    """
    for name, right in want.items():
        if right.dtype == np.uint8 or row is None:
            if not np.array_equal(got[name], right, equal_nan=right.dtype.kind == "f"):
                return True
            continue
        finite = np.isfinite(right) & np.isfinite(got[name])
        if not np.array_equal(got[name][~finite], right[~finite], equal_nan=True):
            return True
        largest = max(1, np.abs(right[finite]).max(initial=0))
        if ratio(row, got[name][finite] / largest, right[finite] / largest) > 1:
            return True
    return False


class _Copy(MetaPathFinder, Loader):
    """Finds and executes the modules of one copy."""

    def __init__(self, sources: Mapping[str, str], functions: Functions):
        self._sources = sources
        self.functions = functions
        self.replaced: set[str] = set()

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        return ModuleSpec(fullname, self, is_package=fullname == PACKAGE) if fullname.partition(".")[0] == PACKAGE else None

    def exec_module(self, module: ModuleType) -> None:
        word = module.__name__.partition(".")[2]
        file = f"{word or '__init__'}.py"
        if file not in self._sources:
            raise ModuleNotFoundError(f"no module {module.__name__}", name=module.__name__)
        exec(_code(file, self._sources[file]), vars(module))
        for name, function in self.functions.items():
            owner, _, attribute = name.partition(".")
            if owner == word and callable(getattr(module, attribute, None)):
                setattr(module, attribute, function)
                self.replaced.add(name)


@cache
def _sources() -> dict[str, str]:
    # `arrays` and `weights` are not copied: they compute nothing, and are known by their classes.
    paths = [path for path in ROOT.glob("*.py") if path.name not in ("arrays.py", "weights.py")]
    return {path.name: path.read_text(encoding="utf-8") for path in [*paths, STAGES_FILE]}


def _changed(changes: Sequence[Change]) -> dict[str, str]:
    sources = dict(_sources())
    for file, old, new in changes:
        if file not in sources:
            raise VariantError(f"{file}: no such file in the reference")
        if (count := sources[file].count(old)) != 1:
            raise VariantError(f"{file}: expected once, found {count} times: {old!r}")
        sources[file] = sources[file].replace(old, new)
    return sources


@cache
def _code(file: str, source: str) -> CodeType:
    source = re.sub(r"^from stss_ref\b(?!\.(?:arrays|weights)\b)", f"from {PACKAGE}", source, flags=re.MULTILINE)
    return compile(source, f"<{PACKAGE}/{file}>", "exec", dont_inherit=True)
