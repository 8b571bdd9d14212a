# SPDX-License-Identifier: MIT
"""The protocol of a port: an object with these four members. A port needs no import from here."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from conformance.protocol.weights_format import VERSIONS
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights

AnyArray = NDArray[Any]
"""An array of floats, a mask (uint8, 0 or 1) or integers."""
Arrays = Mapping[str, AnyArray]
"""Inputs by the names of the stage table."""
Outputs = dict[str, AnyArray]
"""Outputs likewise."""
Members = TypeVar("Members")


class PortError(RuntimeError):
    """A port failed or broke the protocol; the message names the port, the stage, and what was expected and found.

    Attributes:
        at: number of the case of a job at which it failed, as far as that can be seen.
        late: whether the time of a start was over.
        silent: whether it was over before any case was answered.
    """

    def __init__(self, message: str, at: int | None = None, *, late: bool = False, silent: bool = False):
        super().__init__(message)
        self.at, self.late, self.silent = at, late, silent


@contextmanager
def foreign_code() -> Generator[None, None, None]:
    """Run code of a port: it is foreign, and every exception except an interrupt is its failure on this case.

    Its settings for NumPy's errors end with it.

    Raises:
        PortError: the code raised something.
    """
    with np.errstate():
        try:
            yield
        except (PortError, KeyboardInterrupt):
            raise
        except ArrayError as error:
            raise PortError(str(error)) from error
        except BaseException as error:
            raise PortError(error_text(error)) from error


def error_text(error: BaseException) -> str:
    """Type and message of an error of foreign code, whose message may fail too."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:
        return f"{type(error).__name__}, whose message cannot be shown"


@dataclass(frozen=True)
class Unsupported:
    """Returned instead of outputs: the port lacks the stage."""

    stage: str


@dataclass(frozen=True)
class Case:
    """One call of a stage.

    Attributes:
        stage: its name in ``conformance.protocol.stages.STAGES``.
        inputs: the arrays that the table names for it.
        weights: the network's tensors, float32; None for a stage that takes none.
    """

    stage: str
    inputs: Arrays = field(repr=False)
    weights: Weights | None = field(default=None, repr=False)


class Port(Protocol):
    """An implementation of stages, judged from outside.

    Arrays are C-contiguous; floats are float32 (for a float16 port they are rounded to float16 beforehand), masks uint8.

    Attributes:
        name: its name in reports.
        dtype: ``float32`` or ``float16``: the port's arithmetic, by which the bounds are chosen.
    """

    name: str
    dtype: str

    def stages(self) -> frozenset[str]:
        """The stages that it has; the others are skipped, and reports name them."""
        ...

    def run(self, stage: str, inputs: Arrays, weights: Weights | None = None) -> Outputs:
        """Compute one of its ``stages()``; returns outputs by the names of the stage table."""
        ...


@dataclass(frozen=True)
class Abilities:
    """Properties and abilities of a port besides `Port`'s members: it has any of these as its own.

    Attributes:
        dtype: ``float32``, ``float16`` or ``bfloat16``: its arithmetic.
        winograd: whether its convolutions are Winograd's.
        weights_version: the latest version of weights that it knows.
        run_many: computes many cases at one start.
        restart: forgets its state.
        layers: hands over layers of a stage, given as ``run`` is: see `conformance.protocol.layers`.
    """

    dtype: str = "float32"
    winograd: bool = False
    weights_version: int = max(VERSIONS)
    run_many: Callable[[Sequence[Case]], Sequence[Outputs | Unsupported]] | None = None
    restart: Callable[[], None] | None = None
    layers: Callable[[str, Arrays, Weights | None], Outputs] | None = None


def abilities_of(port: Port) -> Abilities:
    """A port's abilities; those that it does not mention are as in `Abilities`."""
    return own_members(port, Abilities)


def own_members(port: object, kind: Callable[..., Members]) -> Members:
    """The members that a port has of those that dataclass ``kind`` names; the others have its defaults."""
    names = [each.name for each in fields(cast("Any", kind))]
    return kind(**{name: getattr(port, name) for name in names if hasattr(port, name)})
