"""The whole frame and the whole network: properties that need no other implementation."""

from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, motions, sizes
from stss_ref.arrays import ArrayError
from stss_ref.conv import conv, sigmoid
from stss_ref.detail import detail
from stss_ref.frame import FrameInputs, frame, motion_by_step, prepare
from stss_ref.holes import holes
from stss_ref.motion_chain import motion_chain
from stss_ref.network import network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.resample import upsample_centres
from stss_ref.reshade import reshade
from stss_ref.warp import warp
from stss_ref.weights import Weights, zeros
from stss_ref.weights import random as random_weights


def still_scene(size, seed, steps=(1, 3, 5)):
    """A scene in which nothing moves, seen by a still camera."""
    random = np.random.default_rng(seed)
    color, gbuffer = random.random((*size, 3)), random.random((*size, 9))
    inputs = FrameInputs(
        colors=np.stack([color] * 3),
        steps=steps,
        motions=np.zeros((max(steps), *size, 2)),
        gbuffer=gbuffer,
        nov=random.random(size),
        stencils=np.zeros((4, *size)),
        normals=np.stack([gbuffer[..., :3]] * 4),
        positions=np.zeros((4, *size, 3)),
    )
    return astype(inputs, np.float64)


def astype(inputs, dtype):
    arrays = {f.name: getattr(inputs, f.name).astype(dtype) for f in fields(inputs) if f.name != "steps"}
    return replace(inputs, **arrays)


@settings(max_examples=15)
@given(data=st.data(), size=sizes(10), seed=SEEDS)
def test_without_a_residual_it_is_the_bilinear_image(data, size, seed):
    """The `bilinear` weights add exactly 0, for any motion."""
    inputs = replace(still_scene(size, seed), motions=np.stack([data.draw(motions(size)) for _ in range(5)]))
    image, valid = frame(inputs, zeros())
    prepared = prepare(inputs)
    np.testing.assert_array_equal(image, upsample_centres(prepared.color[..., :3]))
    np.testing.assert_array_equal(valid, prepared.mask == 1)


def test_a_first_frame_needs_no_motion():
    """All its steps are 0."""
    inputs = still_scene((3, 4), 0, (0, 0, 0))
    assert inputs.motions.shape == (0, 3, 4, 2)
    np.testing.assert_array_equal(prepare(inputs).color[..., :3], inputs.colors[0])


def test_what_the_network_is_given():
    """Order and content of the channels, by hand: an EF whose middle frame is there and whose oldest is missing."""
    inputs = still_scene((3, 4), 0, (1, 3, 3))
    colors = np.stack([np.full((3, 4, 3), v) for v in (0.25, 0.5, 0.5)])
    prepared = prepare(replace(inputs, colors=colors, motions=np.zeros((3, 3, 4, 2))))
    assert prepared.history.shape == (3, 3, 4, 4)
    oldest, middle, newest = prepared.history
    for entry, color, mask in ((oldest, 0.5, 0), (middle, 0.5, 1), (newest, 0.25, 1)):
        assert (entry[..., :3] == color).all()
        assert (entry[..., 3] == mask).all()
    assert (prepared.color == 0.25).all()
    assert prepared.color.shape == (3, 4, 6)


def test_holes_are_filled_in_the_first_three_channels_only():
    """Occlusion warp first, then the warped frame with what was read in its holes."""
    size = (1, 6)
    motion = np.zeros((1, *size, 2))
    motion[0, 0, 2, 0] = -2.0  # pixel 2 shows what was at 0; its motion splats to pixels 0 and 1
    inputs = still_scene(size, 3, (1, 1, 1))
    stencils = np.zeros((4, *size))
    stencils[0, 0, 0] = 5.0  # pixel 0 is another object now: a hole
    prepared = prepare(replace(inputs, motions=motion, stencils=stencils))
    assert prepared.mask[0].tolist() == [0, 1, 1, 1, 1, 1]
    color = inputs.colors[0]
    np.testing.assert_array_equal(prepared.color[0, 0, 3:], color[0, 0])
    np.testing.assert_array_equal(prepared.color[0, 0, :3], color[0, 0])  # 0 - 2 is clamped to the border
    np.testing.assert_array_equal(prepared.color[0, 2, :3], color[0, 0])
    like = prepare(replace(inputs, motions=motion, stencils=stencils, gbuffer=inputs.gbuffer * 0), hole_fill="reshade").color
    np.testing.assert_array_equal(like[0, 0], np.tile(color[0, 0], 2))  # it is alone: nothing is like it
    stencils[0, 0, 4] = 5.0
    stencils[1, 0, 4] = 5.0  # another pixel of that object, which is none: all are at one place
    like = prepare(replace(inputs, motions=motion, stencils=stencils, gbuffer=inputs.gbuffer * 0), hole_fill="reshade").color
    np.testing.assert_array_equal(like[0, 0], [*color[0, 4], *color[0, 0]])


def lively_scene(size, steps):
    """Every plane of every frame is another one: objects, slopes, normals and motions of noise."""
    random = np.random.default_rng(5)
    y, x = np.indices(size)
    return FrameInputs(
        colors=random.random((3, *size, 3)),
        steps=steps,
        motions=random.normal(0, 0.3, (5, *size, 2)),
        gbuffer=random.random((*size, 9)),
        nov=random.random(size),
        stencils=np.where(random.random((4, *size)) < 0.15, random.integers(1, 3, (4, *size)), 0.0),
        normals=np.array((0, 0, 1.0)) + random.normal(0, 0.4, (4, *size, 3)),
        positions=np.stack([12.0 * x, 12.0 * y, 0 * x], -1) + random.normal(0, 6, (4, *size, 3)),
    )


@pytest.mark.parametrize("test", ["footprint", "paper"])
@pytest.mark.parametrize("steps", [(1, 3, 5), (0, 2, 4), (1, 1, 3), (0, 0, 2), (0, 0, 0)])
def test_each_frame_is_compared_with_its_own_planes(steps, test):
    """Stage by stage, with every index written out."""
    inputs = lively_scene((9, 11), steps)
    prepared, detailed = (prepare(inputs, second=second, test=test) for second in ("newest", "detail"))
    depth, images, moved = inputs.gbuffer[..., 3], [], []
    for i in (0, 1, 2):
        missing = (i == 1 and steps[1] == steps[0]) or (i == 2 and steps[2] == steps[1])
        if steps[i] == 0:
            images.append((inputs.colors[i], np.full((9, 11), not missing)))
            continue
        motion = motion_chain(inputs.motions[: steps[i]])
        valid = holes(motion, inputs.stencils[i + 1], inputs.stencils[0], inputs.normals[i + 1], inputs.normals[0],
                      inputs.positions[i + 1], inputs.positions[0], inputs.nov, depth, test)  # fmt: skip
        assert 0.1 < valid.mean() < 0.9
        images.append((warp(inputs.colors[i], motion)[0], valid & (not missing)))
        if not missing:
            moved.append((inputs.colors[i], motion, inputs.stencils[i + 1]))
    (newest, valid), first = images[0], images[0][0]
    if steps[0]:
        first = occlusion_warp(inputs.colors[0], newest, motion_chain(inputs.motions[: steps[0]]), depth, valid)[1]
        assert not np.array_equal(first, newest)
    np.testing.assert_array_equal(prepared.color, np.concatenate([first, newest], -1))
    np.testing.assert_array_equal(detailed.color, np.concatenate([first, detail(first, inputs.stencils[0], moved)], -1))
    for result in (prepared, detailed):
        np.testing.assert_array_equal(result.mask, valid)
        for entry, (color, trusted) in zip(result.history, images[::-1], strict=True):
            np.testing.assert_array_equal(entry, np.concatenate([color, trusted[..., None]], -1))
    if steps[0]:
        filled = prepare(inputs, test=test, hole_fill="reshade").color[..., :3]
        planes = (
            inputs.stencils[1],
            inputs.stencils[0],
            inputs.normals[1],
            inputs.normals[0],
            inputs.positions[1],
            inputs.positions[0],
        )
        motion, base_color = motion_chain(inputs.motions[: steps[0]]), inputs.gbuffer[..., 6:9]
        want = reshade(inputs.colors[0], newest, motion, valid, *planes, base_color)
        assert not np.array_equal(want, newest)
        np.testing.assert_array_equal(filled, want)
    assert motion_by_step(inputs.motions, steps).keys() == {*steps} - {0}


@settings(max_examples=15)
@given(data=st.data(), size=sizes(10), seed=SEEDS)
def test_the_weights_say_what_the_second_colour_is(data, size, seed):
    """Which is part of no other input; it shows the frames that are warped and are not missing: in an SF not the newest."""
    inputs = replace(still_scene(size, seed, data.draw(st.sampled_from(((0, 2, 4), (1, 3, 5), (0, 0, 0), (1, 1, 3))))),
                     motions=np.stack([data.draw(motions(size)) for _ in range(5)]))  # fmt: skip
    inputs = replace(inputs, colors=np.random.default_rng(seed).random((3, *size, 3)))
    weights, newest, detailed = random_weights(seed), prepare(inputs), prepare(inputs, second="detail")
    for name in ("gbuffer", "mask", "history"):
        np.testing.assert_array_equal(getattr(newest, name), getattr(detailed, name))
    first, chained = newest.color[..., :3], motion_by_step(inputs.motions, inputs.steps)
    before = (0, *inputs.steps)
    there = [i for i, step in enumerate(inputs.steps) if step > before[i]]
    frames = [(inputs.colors[i], chained[inputs.steps[i]], inputs.stencils[i + 1]) for i in there]
    np.testing.assert_array_equal(detailed.color, np.concatenate([first, detail(first, inputs.stencils[0], frames)], axis=-1))
    for prepared, given_weights in ((newest, weights), (detailed, Weights(weights, "detail"))):
        want = network(prepared.color, prepared.gbuffer, prepared.mask, prepared.history, weights)
        np.testing.assert_array_equal(frame(inputs, given_weights)[0], want)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("steps", (3, 1, 5), "steps: expected three numbers >= 0, newest"),
        ("steps", (-1, 1, 5), "steps: expected three numbers >= 0, newest"),
        ("motions", np.zeros((4, 4, 4, 2)), r"motions: expected \(k, 4, 4, 2\) with k >= 5, got \(4, 4, 4, 2\)"),
        ("nov", np.full((4, 4), np.nan), "nov: 16 non-finite"),
        ("positions", np.zeros((4, 4, 4, 3), np.float32), "positions: expected dtype float64, that of gbuffer, got float32"),
    ],
)
def test_frame_errors_name_the_array(name, value, message):
    with pytest.raises(ArrayError, match=message):
        frame(replace(still_scene((4, 4), 0), **{name: value}), zeros())


def test_a_convolution_of_any_odd_size():
    """By hand: a window of 5 whose corner alone counts, at stride 1 where none is said."""
    x, weight = np.arange(20.0).reshape(4, 5, 1), np.zeros((1, 1, 5, 5))
    weight[0, 0, 0, 4] = 2
    want = np.full((4, 5, 1), 3.0)
    want[2:, :3] += 2 * x[:2, 2:]  # two rows above, two columns to the right; 0 outside
    np.testing.assert_array_equal(conv(x, weight, np.array([3.0])), want)
    with pytest.raises(ArrayError, match=r"conv: expected 1 channels .*, got 2"):
        conv(np.zeros((4, 5, 2)), weight, np.array([3.0]))


@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("at_once", [1, 3])
def test_a_convolution_of_a_few_rows_at_a_time_has_the_same_bits(stride, at_once, monkeypatch):
    """Of 13 rows, or 7 at stride 2, the last are fewer."""
    random = np.random.default_rng(0)
    x, weight, bias = random.random((13, 8, 3)), random.normal(size=(2, 3, 3, 3)), random.random(2)
    whole = conv(x, weight, bias, stride)
    monkeypatch.setattr("stss_ref.conv.IN_CACHE", at_once * whole[0].size)
    np.testing.assert_array_equal(conv(x, weight, bias, stride), whole)


def test_sigmoid_has_no_overflow_and_two_accurate_tails():
    x = np.array([-1000.0, -50.0, 0.0, 50.0, 1000.0])
    with np.errstate(all="raise", under="ignore"):
        y = sigmoid(x)
    assert y.tolist() == [0.0, np.exp(-50.0) / (1 + np.exp(-50.0)), 0.5, 1 / (1 + np.exp(-50.0)), 1.0]
