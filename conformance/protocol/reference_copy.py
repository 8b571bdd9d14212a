# SPDX-License-Identifier: MIT
"""Copies of the reference in which functions are replaced, as ports: mistakes, and correct ports with other arithmetic.

A *plant* changes one name of a copy: ``put``, ``change_arguments``, ``returns`` and ``wrap`` make one. A name is ``module.name``: of
the module that defines it, and the whole copy gets the new one, as ``sample.follow``; or of a module that imports it, and that module
alone does, as ``warp.follow``. A copy computes in the dtype of its inputs, so in float32 as a port.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial, update_wrapper
from importlib.util import find_spec, module_from_spec
from inspect import signature
from typing import Any

import numpy as np

from conformance.protocol.layers import choose
from conformance.protocol.port import AnyArray, Arrays, Outputs
from conformance.protocol.stages import STAGES
from conformance.protocol.watch import Watch
from stss_ref.weights import Weights

SHARED = ("stss_ref.arrays", "stss_ref.weights")
"""Modules that a copy shares with the reference: they compute nothing, and their classes must be the same."""


class PlantError(ValueError):
    """The reference has no such name."""


def _names_to_copy() -> list[str]:
    return [name for name in sys.modules if name.partition(".")[0] == "stss_ref" and name not in SHARED]


class Copy:
    """The table of stages and the modules of the reference that it needs, once more."""

    def __init__(self) -> None:
        originals = {name: sys.modules.pop(name) for name in _names_to_copy()}
        try:
            spec = find_spec("conformance.protocol.stages")
            assert spec is not None
            assert spec.loader is not None
            stages = module_from_spec(spec)
            spec.loader.exec_module(stages)
            self._modules = {"stages": stages, **{name.partition(".")[2]: sys.modules[name] for name in _names_to_copy()}}
        finally:
            for name in _names_to_copy():
                del sys.modules[name]
            sys.modules.update(originals)

    def get(self, name: str) -> Any:
        """The object called ``module.name``; PlantError if there is none."""
        word, _, attribute = name.partition(".")
        if not hasattr(self._modules.get(word), attribute):
            raise PlantError(f"{name}: no such name in the reference")
        return getattr(self._modules[word], attribute)

    def put(self, name: str, value: Any) -> None:
        """Replace it, everywhere if ``module`` defines it; errors as above."""
        old = self.get(name)
        word, _, attribute = name.partition(".")
        defined = getattr(old, "__module__", None) == self._modules[word].__name__
        for module in self._modules.values() if defined else (self._modules[word],):
            if vars(module).get(attribute) is old:
                setattr(module, attribute, value)

    def wrap_all(self, attribute: str, around: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
        """Put ``around(function)`` in the place of the function ``attribute`` of every module that has one."""
        for module in self._modules.values():
            if callable(function := vars(module).get(attribute)):
                setattr(module, attribute, around(function))


Plant = Callable[[Copy], None]


def put(name: str, value: Any) -> Plant:
    """``value`` in place of a function or a constant."""
    return lambda copy: copy.put(name, value)


def wrap(name: str, wrong: Callable[..., Any]) -> Plant:
    """``wrong`` in place of a function; its first argument is the original."""

    def plant(copy: Copy) -> None:
        right = copy.get(name)
        copy.put(name, update_wrapper(partial(wrong, right), right))

    return plant


def change_arguments(name: str, **changes: Callable[..., Any]) -> Plant:
    """A function is given the change of each argument that is named; a change may read other arguments, which it names as its own."""

    def wrong(right: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        by_name = _by_name(right, arguments, keywords)
        return right(**{**by_name, **{key: change(by_name[key], **_read_by(change, by_name)) for key, change in changes.items()}})

    return wrap(name, wrong)


def returns(name: str, change: Callable[..., Any]) -> Plant:
    """A function returns the change of its result; a change may read arguments, which it names as its own."""

    def wrong(right: Callable[..., Any], *arguments: Any, **keywords: Any) -> Any:
        return change(right(*arguments, **keywords), **_read_by(change, _by_name(right, arguments, keywords)))

    return wrap(name, wrong)


def _by_name(function: Callable[..., Any], arguments: Sequence[Any], keywords: Mapping[str, Any]) -> dict[str, Any]:
    bound = signature(function).bind(*arguments, **keywords)
    bound.apply_defaults()
    return bound.arguments


def _read_by(change: Callable[..., Any], by_name: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments of a function that a change reads besides its first."""
    if isinstance(change, np.ufunc):
        return {}
    return {key: by_name[key] for key in list(signature(change).parameters)[1:] if key in by_name}


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mistake that a porter could make.

    Attributes:
        stage: its tests must catch the mistake. It is the narrowest stage; ``network`` and ``frame``, which contain it, fail, too.
        name: unique within the stage.
        what: the mistake, in one line.
        plants: the mistake, as changes of a copy.
        also: other narrow stages whose tests must catch it, since they share the code.
        bits: the numbers stay within any bound, so that only a test of exact bits can catch it.
        large: no small frame shows it.
    """

    stage: str
    name: str
    what: str
    plants: tuple[Plant, ...]
    also: tuple[str, ...] = ()
    bits: bool = False
    large: bool = False

    @property
    def id(self) -> str:
        """An identifier: ``warp_x_sign``."""
        return f"{self.stage}_{self.name}"

    def port(self) -> Variant:
        """The reference with this mistake; PlantError if it no longer applies."""
        return load(self.id, *self.plants)


def fault(stage: str, name: str, what: str, *plants: Plant, **marks: Any) -> Mistake:
    """Make a mistake; ``marks`` as its attributes."""
    return Mistake(stage, name, what, plants, **marks)


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
        copy: Copy,
        dtype: str = "float32",
        winograd: bool = False,
        entry: Callable[[AnyArray], AnyArray] | None = None,
    ):
        """Make a port of a copy; ``entry`` first changes every float array and weight."""
        self.name = name
        self.dtype = dtype
        self.winograd = winograd
        self._entry = entry
        self._reference = copy.get("stages.reference")
        self._watch = Watch(copy)

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
        with self._watch.open() as record:
            self.run(stage, inputs, weights)
        return choose(stage, record)


def load(name: str, *plants: Plant, **port: Any) -> Variant:
    """Make a copy of the reference, and change it; ``port``: further arguments of `Variant`. PlantError if a plant does not apply."""
    copy = Copy()
    for plant in plants:
        plant(copy)
    return Variant(name, copy, **port)


@cache
def _reference() -> Variant:
    return load("ref")


def reference_layers(stage: str, inputs: Arrays, weights: Weights) -> Outputs:
    """The layers of ``stage`` as the reference computes them, in the dtype of the inputs; errors as `stages.reference`."""
    return _reference().layers(stage, inputs, weights)


def half(x: AnyArray) -> AnyArray:
    """Rounded to half precision."""
    return x.astype(np.float16).astype(x.dtype)
