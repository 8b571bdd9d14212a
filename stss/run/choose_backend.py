# SPDX-License-Identifier: MIT
"""Open the backend that the user's options ask for: device, and what may be skipped."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from stss.frames.backends import Backend, open_backend
from stss.frames.compute_options import ComputeOptions, Skip
from stss.frames.display_frame import DisplayFrame, prepare
from stss.frames.supersample import choose_rendered
from stss.images.color import transfer
from stss.run import budget as budgeting
from stss.run.options import RunOptions
from stss.sequence.reader import Sequence
from stss.weights.file import LoadedWeights
from stss_ground.errors import InputError


def with_skipping(options: ComputeOptions, skip: Skip | None, budget: float | None, *, possible: bool) -> ComputeOptions:
    """Add the user's choices about skipping to ``options``, and check that they go together.

    Args:
        options: the other choices.
        skip: one of ``SKIPS``; None: not given, so ``exact``.
        budget: seconds a frame, by which ``skip`` and the precision are chosen; None: not given.
        possible: whether the backend can skip anything.

    Raises:
        InputError: the options do not go together.
    """
    if budget is not None and (skip or options.precision != "float32"):
        raise InputError("--budget: expected neither --skip nor --precision: it chooses them")
    if (budget or skip) and not possible:
        raise InputError("--skip, --budget: expected the network on the backend cl")
    return replace(options, skip=skip or "exact")


def within_budget(
    loaded: LoadedWeights,
    options: ComputeOptions,
    budget: float,
    frames: list[DisplayFrame],
    *,
    tell: Callable[[str], None] = lambda line: None,
) -> tuple[Backend, str]:
    """Open the most accurate backend whose frames take no more than ``budget`` seconds.

    Args:
        loaded: the network's weights.
        options: names the device; precision and skipping are chosen here.
        budget: seconds a frame.
        frames: frames to try settings on, see ``first_frames``.
        tell: called with lines for the user.

    Returns:
        The backend and the label of its weights.

    Raises:
        InputError: there are too few frames.
    """

    def make(setting: ComputeOptions) -> Backend:
        tried = replace(setting, device=options.device, memory_limit=options.memory_limit)
        return open_backend("cl", loaded.weights, tried, tell=tell)

    return budgeting.choose(frames, budget, make, tell)[1], loaded.label


def first_frames(sequence: Sequence, options: RunOptions) -> list[DisplayFrame]:
    """The first consecutive frames that begin with a rendered one, as the run prepares them: as many as a budget is tried on."""
    rendered, curve = (
        choose_rendered(sequence.numbers, sequence.rendered, options.rendered, options.cuts),
        transfer(options.transfer),
    )
    frames: list[DisplayFrame] = []
    for number in sequence.numbers:
        if frames and number != frames[-1].number + 1:
            break
        if frames or number in rendered:
            frames.append(prepare(sequence.load(number, color=number in rendered), curve, options.depth, options.planes))
        if len(frames) == budgeting.FRAMES:
            break
    return frames
