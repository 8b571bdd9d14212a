# SPDX-License-Identifier: MIT
"""Stage holes."""

import numpy as np
from hypothesis import strategies as st

from conformance.answers.port_arithmetic import reach
from conformance.answers.warp import within_frame
from conformance.cases.near_limits import hardly_far, hardly_turned
from conformance.cases.planes import SEEDS, Size, sizes
from conformance.cases.stage_inputs import Inputs, holes_inputs, thresholds
from conformance.judging.judge import Judge
from conformance.judging.questions import Talk, ask
from conformance.suite.properties import (
    agrees_in_large_frames,
    agrees_in_windows,
    agrees_on_constants,
    agrees_on_engines,
    cases,
    cases_of,
    keeps_nothing_by_a_part,
    same_twice,
)

SEEDED = sizes(12).flatmap(lambda size: st.tuples(st.just(size), SEEDS))


@cases(holes_inputs())
def test_agrees_with_the_reference(judge: Judge, inputs: Inputs) -> Talk:
    """The mask is the float64 reference's; either answer is right where a comparison is within rounding of its threshold."""
    yield from judge.agrees("holes", inputs)


@cases(thresholds())
def test_agrees_near_the_thresholds(judge: Judge, inputs: Inputs) -> Talk:
    """Masks agree, too, if one comparison decides: a surface's distance or angle near its limit, or the edge of another object."""
    yield from judge.agrees("holes", inputs)


@cases_of([hardly_far, hardly_turned])
def test_comparisons_need_all_bits(judge: Judge, inputs: Inputs) -> Talk:
    """The last bits of a surface's depth, view or normal in float32 decide a hole."""
    yield from judge.agrees("holes", inputs)


@cases(sizes(12).flatmap(lambda size: st.tuples(st.just(size), SEEDS, st.sampled_from([np.nan, np.inf]))))
def test_a_lost_position_is_a_hole(judge: Judge, case: tuple[Size, int, float]) -> Talk:
    """If nothing moves, a pixel is a hole if one of the four positions that it reads is not finite: its own, or right, below, or both."""
    size, seed, value = case
    rng = np.random.default_rng(seed)
    position = rng.integers(-8, 8, (*size, 3)) / 8
    quarters = _quarters(size, seed)
    inputs = {name: array if name == "paper" else np.zeros_like(array) for name, array in quarters.items()}
    broken = rng.random(size) < 0.2
    previous = np.where((broken & (rng.random(size) < 0.8))[..., None] & (rng.random((*size, 3)) < 0.7), value, position)
    non_finite = ~np.asarray(np.isfinite(previous).all(axis=-1))
    down, right = (np.minimum(np.arange(n) + 1, n - 1) for n in size)
    holes = non_finite | non_finite[down] | non_finite[:, right] | non_finite[down][:, right]
    got = (yield ask("holes", {**inputs, "position": position, "position_previous": previous}))["valid"]
    judge.same("holes.valid", got, (~holes).astype(np.uint8))


WORLDS = st.sampled_from([(-512.0, 1.0), (0.25, 1.0), (64.0, 1.0), (0.0, -8.0), (0.0, 0.25), (0.0, 1024.0)])
"""A distance that the whole world is moved by, and a factor of its unit."""


@cases(st.tuples(sizes(12), SEEDS, WORLDS, st.permutations(range(3))))
def test_the_world_has_no_origin_axis_or_unit(judge: Judge, case: tuple[Size, int, tuple[float, float], list[int]]) -> Talk:
    """No shift of the whole world and no order of its axes changes a hole; by the footprint no unit or mirror either. All is exact."""
    size, seed, (shift, times), order = case
    inputs = _quarters(size, seed)
    inputs["paper"] *= times == 1
    other = {n: array[..., order] if n.startswith(("normal", "position")) else array for n, array in inputs.items()}
    other |= {name: (other[name] + shift) * times for name in ("position", "position_previous")}
    first, second = yield [ask("holes", i) for i in (inputs, other)]
    judge.same("holes.valid", second["valid"], first["valid"])


@cases(SEEDED)
def test_a_plane_that_slides_past_has_no_holes(judge: Judge, case: tuple[Size, int]) -> Talk:
    """In the footprint's test a plane has no hole where its motion leads into the frame, at any distance between its pixels."""
    size, seed = case
    rng = np.random.default_rng(seed)
    inputs = {name: np.zeros_like(array) for name, array in _quarters(size, seed).items()}
    inputs["normal"] = inputs["normal_previous"] = inputs["normal"] + np.eye(3)[seed % 3]
    motion, (y, x) = rng.integers(-6, 7, 2) / 4, np.indices(size)[..., None]
    across, down = rng.integers(1, 8, (2, 3)) * 2.0 ** rng.integers(-2, 7)
    position = x * across + y * down
    moved = np.broadcast_to(motion, (*size, 2))
    planes = {"motion": moved, "position": position, "position_previous": position - motion[0] * across - motion[1] * down}
    valid = (yield ask("holes", {**inputs, **planes}))["valid"]
    judge.same("holes.valid", valid, within_frame(reach(moved, judge.arithmetic))[0].astype(np.uint8))


@cases(SEEDED)
def test_a_background_is_no_surface(judge: Judge, case: tuple[Size, int]) -> Talk:
    """In the footprint's test, if nothing moves, a surface that was background is a hole, and so is a background that was a surface."""
    size, seed = case
    rng = np.random.default_rng(seed)
    inputs = {name: np.zeros_like(array) for name, array in _quarters(size, seed).items()}
    before, now = (rng.random(size) < 0.5 for _ in range(2))
    normals = {
        name: is_surface[..., None] * np.eye(3)[seed % 3] for name, is_surface in (("normal_previous", before), ("normal", now))
    }
    valid = (yield ask("holes", {**inputs, **normals}))["valid"]
    judge.same("holes.valid", valid, (before == now).astype(np.uint8))


test_the_same_twice = same_twice("holes", cases(holes_inputs(), slow=True))


test_constants_are_those_of_the_specification = agrees_on_constants("holes")


test_agrees_on_what_engines_send = agrees_on_engines("holes")


test_nothing_is_kept_by_a_part_of_the_inputs = keeps_nothing_by_a_part("holes")


test_large_frames_agree_with_the_reference = agrees_in_large_frames("holes")


test_a_users_size_agrees_in_windows = agrees_in_windows("holes")


def _quarters(size: Size, seed: int) -> Inputs:
    """Positions in quarters, normals along the axes, a view in eighths: sums of squares are exact in any order."""
    rng = np.random.default_rng(seed)
    axis = np.eye(3)[rng.integers(0, 3, size)] * rng.choice([-1, 1], (*size, 1))
    position = rng.integers(-128, 128, (*size, 3)) / 4
    return {
        "motion": rng.integers(-3, 4, (*size, 2)).astype(np.float64),
        "stencil_previous": rng.integers(0, 2, size).astype(np.float64),
        "stencil": rng.integers(0, 2, size).astype(np.float64),
        "normal_previous": np.where(rng.random((*size, 1)) < 0.5, axis, np.roll(axis, 1, axis=-1)),
        "normal": axis,
        "position_previous": position + rng.integers(-60, 60, (*size, 3)) / 4,
        "position": position,
        "nov": rng.integers(-8, 9, size) / 8,
        "depth": rng.integers(0, 9, size) / 8,
        "paper": rng.integers(0, 2, 1, np.int32),
    }
