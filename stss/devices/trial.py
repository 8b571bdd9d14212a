# SPDX-License-Identifier: MIT
"""The weights with which a self-test computes: as few layers as the user's weights allow."""

from __future__ import annotations

from stss.weights.file import REALTIME, load
from stss_cl.liveness import find_live
from stss_ref.weights import Weights, random

EVERY = "every"
"""Random weights, which need all layers."""
SIZE = 24, 40
"""Height and width of its frames."""
TRIALS = (REALTIME, EVERY)
"""Fewer layers first. Both shipped sets of weights have the same layers, so one of them stands for both."""


def trial_weights(trial: str) -> Weights:
    """The weights of this name."""
    return random(0) if trial == EVERY else load(trial).weights


def trial_for(weights: Weights) -> str:
    """The first of ``TRIALS`` that needs all layers that ``weights`` need."""
    layers = find_live(weights).layers.keys()
    return next(trial for trial in TRIALS if layers <= find_live(trial_weights(trial)).layers.keys())
