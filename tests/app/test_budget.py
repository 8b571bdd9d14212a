# SPDX-License-Identifier: MIT
"""The choice of a setting by its time, and what options go together."""

from __future__ import annotations

import time

import numpy as np
import pytest

from conformance.scenes import SCENES
from stss.frames.compute_options import ComputeOptions
from stss.run import budget
from stss.run.budget import SETTINGS, choose
from stss.run.choose_backend import with_skipping
from stss.sequence.scenes import display_frames
from stss_ground.errors import InputError
from stss_lab.bench.pareto import frontier


class Sleeper:
    """A backend whose frames take so long."""

    def __init__(self, seconds):
        self._seconds = seconds

    def compute(self, window, steps):
        time.sleep(self._seconds)
        return np.zeros((2, 2, 3), np.float32), np.ones((1, 1), bool)


@pytest.fixture(scope="module")
def frames():
    return list(display_frames(SCENES["static"], (8, 8), budget.WARM + 3))


def make(times):
    """A backend for each setting, that takes the time of its place."""
    return lambda setting: Sleeper(times[SETTINGS.index(setting)])


def test_the_most_accurate_that_keeps_the_time_is_taken(frames):
    told = []
    setting, _ = choose(frames, 0.02, make([0.05, 0]), told.append)
    assert setting == SETTINGS[1]
    assert told[-1].startswith("--precision half --skip exact: ")


def test_where_none_keeps_it_the_fastest_is_taken_and_said(frames):
    told = []
    setting, _ = choose(frames, 1e-4, make([0.002, 0.03]), told.append)
    assert setting == SETTINGS[0]
    assert told[-1].startswith("no setting keeps within 0.1 ms")


def test_too_few_frames_are_said(frames):
    with pytest.raises(InputError, match="--budget: expected more than 8 frames in a row"):
        choose(frames[:4], 1, make([0, 0]), print)


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        ({"budget": 0.04, "skip": "exact"}, "--budget: expected neither --skip"),
        ({"skip": "exact", "possible": False}, "expected the network on the backend cl"),
    ],
)
def test_options_that_do_not_go_together(chosen, words):
    options = {"skip": None, "budget": None, "possible": True} | chosen
    with pytest.raises(InputError, match=words):
        with_skipping(ComputeOptions(), **options)


def test_frontier():
    """By hand: what another one beats in both is out."""
    assert frontier([(3, 1), (1, 5), (2, 2), (2.5, 4), (4, 1)]) == [1, 2, 0]
    assert frontier([]) == []
