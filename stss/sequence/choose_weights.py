# SPDX-License-Identifier: MIT
"""Choose the set of weights that suits a sequence, once for all of its frames."""

from __future__ import annotations

from collections.abc import Callable

from stss.sequence.antialiasing import Sampling, judge_sampling
from stss.sequence.sequence import Sequence
from stss.weights.file import ANTIALIASED, BILINEAR, REALTIME, LoadedWeights, load

AUTO = "auto"
"""In place of a name of weights: choose the set that suits the frames."""


def weights_for(sampling: Sampling) -> str:
    """The name of the weights for frames with this sampling."""
    return ANTIALIASED if sampling.antialiased else REALTIME


def choose_weights(source: str, sequence: Sequence, tell: Callable[[str], None], *, needed: bool = True) -> LoadedWeights:
    """Load the weights named, or with `AUTO` those that suit the sequence; every part of it gets the same.

    Args:
        source: `AUTO`, or see `stss.weights.file.load`.
        sequence: a few of its frames are looked at, see `stss.sequence.antialiasing.judge_sampling`.
        tell: called with the choice and its reason.
        needed: whether a network runs at all; if not, `AUTO` neither reads frames nor calls ``tell``.

    Raises:
        InputError: the file can't be read or is of another format.
        WeightsError: a tensor does not fit the network.
    """
    if source != AUTO:
        return load(source)
    if not needed:
        return load(BILINEAR)
    sampling = judge_sampling(sequence)
    name = weights_for(sampling)
    tell(f"weights: {name} ({sampling.reason}); --weights chooses others")
    return load(name)
