# SPDX-License-Identifier: MIT
"""From the user's options to what computes: the method, the backend, and what may be left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from stss.baselines.registry import MethodBackend
from stss.color import transfer
from stss.errors import InputError
from stss.frames.backends import NETWORK, Backend, open_backend
from stss.frames.compute_options import Setting
from stss.frames.display_frame import Prepared, prepare
from stss.frames.supersample import choose_rendered
from stss.run import budget as budgeting
from stss.run.job import RunOptions
from stss.sequence.reader import Sequence
from stss.weights.file import LoadedWeights

NO_WEIGHTS = "none"
"""Stands for the weights' identity in the files of a method without a network."""


def open_method(
    method: str,
    loaded: LoadedWeights,
    backend: str = "cl",
    *,
    device: str | None = None,
    precision: str = "float32",
    memory_limit: int | None = None,
    skip: str = "exact",
    max_error: float = 0.0,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Backend, str]:
    """What computes a method, and the identity of its weights.

    Args:
        method: ``network``, or one of ``METHODS``; the other arguments matter to the network alone.
        loaded: the network's weights.
        backend, device, precision, skip, max_error, tell: see ``stss.frames.backends.open_backend``.
        memory_limit: MiB.

    Raises:
        InputError: there is no such method, or the options do not go together.
    """
    if method != NETWORK:
        return MethodBackend(method), NO_WEIGHTS
    limit = None if memory_limit is None else memory_limit << 20
    chosen = {"device": device, "precision": precision, "memory_limit": limit, "skip": skip, "max_error": max_error, "tell": tell}
    engine = open_backend(backend, loaded.weights, **chosen)  # pyright: ignore[reportArgumentType]
    return engine, loaded.identity


@dataclass(frozen=True)
class Engine:
    """What the user chose; see ``open_method``."""

    method: str
    weights: LoadedWeights
    backend: str
    device: str | None
    precision: str
    memory_limit: int | None

    def open(
        self,
        skip: str | None,
        max_error: float | None,
        budget: float | None,
        sequence: Sequence,
        options: RunOptions,
        tell: Callable[[str], None],
    ) -> tuple[Backend, str]:
        """The backend, and the identity of its weights.

        Args:
            skip: of ``stss.frames.backends.SKIPS``; None: what goes with the others.
            max_error: for ``bounded``.
            budget: seconds a frame, in place of the two and of the precision.
            sequence: on whose first frames settings are tried.
            options: how its frames are taken.
            tell: is handed lines for the user.

        Raises:
            InputError: the options do not go together.
        """
        if budget is not None and (skip or max_error or self.precision != "float32"):
            raise InputError("--budget: expected neither --skip, --max-error nor --precision: it chooses them")
        if max_error is not None and skip not in (None, "bounded"):
            raise InputError(f"--max-error: expected --skip bounded, got {skip}")
        if skip == "bounded" and max_error is None:
            raise InputError("--skip bounded: expected --max-error, such as 2/255")
        if (budget or skip or max_error) and (self.backend != "cl" or self.method != NETWORK):
            raise InputError("--skip, --max-error, --budget: expected the network on the backend cl")
        if budget is None:
            return self._make(self.precision, skip or ("bounded" if max_error else "exact"), max_error or 0.0, tell)

        def make(setting: Setting) -> Backend:
            return self._make(setting.precision, setting.skip, setting.max_error, tell)[0]

        _, backend = budgeting.choose(_first_frames(sequence, options), budget, make, tell)
        return backend, self.weights.identity

    def _make(self, precision: str, skip: str, max_error: float, tell: Callable[[str], None]) -> tuple[Backend, str]:
        return open_method(
            self.method, self.weights, self.backend, device=self.device, precision=precision, memory_limit=self.memory_limit,
            skip=skip, max_error=max_error, tell=tell,
        )  # fmt: skip


def _first_frames(sequence: Sequence, options: RunOptions) -> list[Prepared]:
    """The first consecutive frames from a rendered one on, as the run will prepare them."""
    rendered, curve = choose_rendered(sequence.numbers, sequence.rendered, options.rendered), transfer(options.transfer)
    frames: list[Prepared] = []
    for number in sequence.numbers:
        if frames and number != frames[-1].number + 1:
            break
        if frames or number in rendered:
            frames.append(prepare(sequence.load(number, color=number in rendered), curve, options.depth))
        if len(frames) == budgeting.FRAMES:
            break
    return frames
