# SPDX-License-Identifier: MIT
"""Mistakes that people make when they port a stage, as ports: they explain wrong answers, and test the judge."""

from __future__ import annotations

from conformance.mistakes.accumulate import ACCUMULATE
from conformance.mistakes.frame import FRAME
from conformance.mistakes.holes import HOLES, OCCLUSION_WARP, RRM
from conformance.mistakes.image import MOTION_CHAIN, WARP
from conformance.mistakes.network import DECODER, ENCODER, ERM, HISTORY, NETWORK
from conformance.mistakes.reshade import RESHADE
from conformance.protocol.reference_copy import Mistake

MISTAKES: tuple[Mistake, ...] = (
    *MOTION_CHAIN, *WARP, *HOLES, *OCCLUSION_WARP, *RESHADE, *RRM, *HISTORY, *ENCODER, *ERM, *DECODER, *NETWORK, *FRAME,
    *ACCUMULATE,
)  # fmt: skip


def of_stage(stage: str, *, shared: bool = False) -> tuple[Mistake, ...]:
    """Mistakes that the tests of ``stage`` ought to catch; with ``shared``, also those of other stages whose code it shares."""
    return tuple(mistake for mistake in MISTAKES if mistake.stage == stage or (shared and stage in mistake.also))


def find(name: str) -> Mistake:
    """The mistake with this `Mistake.id`."""
    return next(mistake for mistake in MISTAKES if mistake.id == name)
