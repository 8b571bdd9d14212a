# SPDX-License-Identifier: MIT
"""From the user's options to what computes: the method, the backend, and what may be left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from stss.baselines.registry import MethodBackend
from stss.color import transfer
from stss.errors import InputError
from stss.frames.backends import DEFAULTS, NETWORK, Backend, open_backend
from stss.frames.compute_options import ComputeOptions, Skip
from stss.frames.display_frame import DisplayFrame, prepare
from stss.frames.supersample import choose_rendered
from stss.run import budget as budgeting
from stss.run.options import RunOptions
from stss.sequence.reader import Sequence
from stss.weights.file import LoadedWeights

NO_WEIGHTS = "none"
"""Stands for the weights' label in the files of a method without a network."""


def open_method(
    method: str,
    loaded: LoadedWeights,
    backend: str = "cl",
    options: ComputeOptions = DEFAULTS,
    *,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Backend, str]:
    """What computes a method, and the label of its weights.

    Args:
        method: ``network``, or one of ``METHODS``; the other arguments matter to the network alone.
        loaded: the network's weights.
        backend, options, tell: see ``stss.frames.backends.open_backend``.

    Raises:
        InputError: there is no such method, or the options do not go together.
    """
    if method != NETWORK:
        return MethodBackend(method), NO_WEIGHTS
    return open_backend(backend, loaded.weights, options, tell=tell), loaded.label


def with_skipping(
    options: ComputeOptions, skip: Skip | None, max_error: float | None, budget: float | None, *, possible: bool
) -> ComputeOptions:
    """``options`` with what the user said of skipping, where it goes together.

    Args:
        options: of the other choices.
        skip: of ``SKIPS``; None: what goes with ``max_error``.
        max_error: for ``bounded``; None: not said.
        budget: seconds a frame, which choose the others and the precision; None: not said.
        possible: whether the backend can leave anything out.

    Raises:
        InputError: the options do not go together.
    """
    if budget is not None and (skip or max_error or options.precision != "float32"):
        raise InputError("--budget: expected neither --skip, --max-error nor --precision: it chooses them")
    if max_error is not None and skip not in (None, "bounded"):
        raise InputError(f"--max-error: expected --skip bounded, got {skip}")
    if skip == "bounded" and max_error is None:
        raise InputError("--skip bounded: expected --max-error, such as 2/255")
    if (budget or skip or max_error) and not possible:
        raise InputError("--skip, --max-error, --budget: expected the network on the backend cl")
    return replace(options, skip=skip or ("bounded" if max_error else "exact"), max_error=max_error or 0.0)


def within_budget(
    loaded: LoadedWeights,
    options: ComputeOptions,
    budget: float,
    frames: list[DisplayFrame],
    *,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Backend, str]:
    """The most accurate backend whose frames take no more than ``budget`` seconds, and the label of its weights.

    Args:
        loaded: the network's weights.
        options: of the device; precision and skipping are chosen.
        budget: seconds a frame.
        frames: what settings are tried on, see ``first_frames``.
        tell: is handed lines for the user.

    Raises:
        InputError: there are too few frames.
    """

    def make(setting: ComputeOptions) -> Backend:
        tried = replace(setting, device=options.device, memory_limit=options.memory_limit)
        return open_backend("cl", loaded.weights, tried, tell=tell)

    return budgeting.choose(frames, budget, make, tell)[1], loaded.label


def first_frames(sequence: Sequence, options: RunOptions) -> list[DisplayFrame]:
    """The first consecutive frames from a rendered one on, as the run will prepare them: as many as a budget is tried on."""
    rendered, curve = choose_rendered(sequence.numbers, sequence.rendered, options.rendered), transfer(options.transfer)
    frames: list[DisplayFrame] = []
    for number in sequence.numbers:
        if frames and number != frames[-1].number + 1:
            break
        if frames or number in rendered:
            frames.append(prepare(sequence.load(number, color=number in rendered), curve, options.depth))
        if len(frames) == budgeting.FRAMES:
            break
    return frames
