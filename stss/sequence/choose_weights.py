# SPDX-License-Identifier: MIT
"""Which of the weights that come with the program suit a sequence: chosen once for all of its frames."""

from __future__ import annotations

from collections.abc import Callable

from stss.sequence.antialiasing import Sampling, judge_sampling
from stss.sequence.reader import Sequence
from stss.weights.file import ANTIALIASED, BILINEAR, DEFAULT, REALTIME, LoadedWeights, load

AUTO = "auto"
"""In place of a name of weights: those that suit the frames."""


def suited(sampling: Sampling) -> str:
    """The name of the weights for frames that are sampled so."""
    return ANTIALIASED if sampling.antialiased else REALTIME


def choose_weights(source: str, sequence: Sequence, tell: Callable[[str], None], *, needed: bool = True) -> LoadedWeights:
    """The weights named, or with `AUTO` those that suit the sequence; the same for every part of it.

    Args:
        source: `AUTO` or `DEFAULT`, which mean the same here, or see `stss.weights.file.load`.
        sequence: a few of its frames are looked at, see `stss.sequence.antialiasing.judge_sampling`.
        tell: is handed the choice and its reason.
        needed: whether a network runs at all; where none does, `AUTO` chooses and tells nothing.

    Raises:
        InputError: the file can't be read or is of another format.
        WeightsError: a tensor is not what the network takes.
    """
    if source not in (AUTO, DEFAULT):
        return load(source)
    if not needed:
        return load(BILINEAR)
    sampling = judge_sampling(sequence)
    name = suited(sampling)
    tell(f"weights: {name} ({sampling.reason}); --weights chooses others")
    return load(name)
