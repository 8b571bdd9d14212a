"""The image-space stages in OpenCL: every value is the float32 reference's, bit for bit, but that subnormal ones are 0."""

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from conformance.cases import stage_inputs as drawn
from conformance.cases.planes import SEEDS, motions, sizes
from conformance.protocol.stages import reference
from stss_cl.device.buffers import inputs_for, read
from stss_cl.image_space.accumulate import Accumulate
from stss_cl.image_space.prepare import FINITE, Prepare, PrepareOptions
from stss_cl.image_space.stages import STAGES, ImageStages
from stss_ref.accumulate import accumulate
from stss_ref.arrays import ArrayError
from stss_ref.frame import FrameInputs, prepare
from stss_ref.motion_chain import chain_steps, motion_chain
from stss_ref.occlusion_warp import occlusion_warp, splat
from stss_ref.resample import downsample_8, pad_to_8
from stss_ref.reshade import reshade
from tests.cl.films import frame_inputs as noise
from tests.meta.samples import samples
from tests.tiers import thorough

BROKEN = (np.nan, np.inf, -np.inf, 3e38, -3e38, -0.0, 1e-42)
TINY = 2.0**-100
"""Inputs below it are 0 where bits are compared: what is made of larger ones is not subnormal, and no device flushes it to 0, but products
that are too small to count."""


@pytest.fixture(scope="module")
def stages(device):
    return ImageStages(device)


@st.composite
def broken(draw, arrays):
    """An array in float32 with a few values that are no numbers, huge, or as small as they get."""
    array = draw(arrays).astype(np.float32)
    random = np.random.default_rng(draw(SEEDS))
    if draw(st.booleans()):
        bad = random.random(array.shape) < 0.1
        array[bad] = random.choice(np.array(BROKEN, np.float32), int(bad.sum()))
    return array


@st.composite
def depths(draw, size):
    """Normalised depth in float32: all different, many ties, -0 among 0, and beyond where the splat starts."""
    random = np.random.default_rng(draw(SEEDS))
    kinds = {
        "any": random.random(size),
        "ties": random.integers(0, 4, size) / 4,
        "zeros": random.choice([0.0, -0.0, 1e-42], size),
        "edge": random.choice([0.5, 10.0, np.nextafter(np.float32(10), np.float32(0)), 11.0, -1.0, -2.0], size),
    }
    return kinds[draw(st.sampled_from(sorted(kinds)))].astype(np.float32)


def without_tiny(array):
    """The same with 0 for numbers below ``TINY``."""
    return np.where(np.abs(array) < TINY, np.zeros((), array.dtype), array) if array.dtype.kind == "f" else array


def assert_same(got, want):
    """Same dtype, shape and bits, but for the sign of 0, the payload of NaN, and numbers below ``TINY``."""
    assert got.dtype == want.dtype
    np.testing.assert_array_equal(without_tiny(got), without_tiny(want))


@pytest.mark.parametrize("stage", STAGES)
def test_each_stage_alone(stages, stage):
    for case in samples(stage):
        inputs = {name: without_tiny(array) for name, array in case.inputs.items()}
        with np.errstate(invalid="ignore", over="ignore"):
            want = reference(stage, inputs)
        got = stages.run_stage(stage, inputs)
        for name, array in want.items():
            assert_same(got[name], array)


def test_what_is_subnormal_is_0(stages):
    """The time does not depend on the data. PoCL alone says by which option; without a sum or a product a number stays."""
    color = np.full((8, 8, 3), 2.0**-127, np.float32)
    for value, is_zero in ((2.0**-127, True), (2.0**-120, False)):
        color[3, 4] = value
        motion = np.full((8, 8, 2), 0.5, np.float32)
        warped = stages.run_stage("warp", {"color": color, "motion": motion})["warped"]
        assert (warped == 0).all() == is_zero


def test_motion_chain_among_equally_long_motions(stages):
    """Contracted to a fused multiply-add, one of the two squared lengths would be larger."""
    motion = np.array([[(0.5, 0.5), (3.1, 1.7)], [(1.7, 3.1), (-3.1, 1.7)]], np.float32)
    chain = np.stack([np.full_like(motion, 0.25), motion])
    assert_same(stages.run_stage("motion_chain", {"motions": chain})["motion"], motion_chain(chain))


def test_a_splat_of_many_ties_is_the_same_every_time(stages):
    """A hundred thousand pixels of three depths fall on a small part of the frame: the sequential splat, every time."""
    size = (270, 480)
    random = np.random.default_rng(5)
    to = random.uniform((100, 50), (180, 100), (*size, 2))
    motion = (to - np.stack(np.indices(size)[::-1], axis=-1)).astype(np.float32)
    color = random.random((*size, 3)).astype(np.float32)
    depth = random.choice([0.0, -0.0, 0.25, 0.5], size).astype(np.float32)
    inputs = {"color": color, "warped": color, "motion": motion, "depth": depth, "valid": np.zeros(size, np.uint8)}
    want, filled = occlusion_warp(**inputs)
    assert np.count_nonzero(splat(motion, depth)) > 0
    for _ in range(5):
        got = stages.run_stage("occlusion_warp", inputs)
        assert_same(got["occlusion_motion"], want)
        assert_same(got["occlusion_warp"], filled)


@settings(max_examples=20)
@given(inputs=drawn.reshade_inputs())
def test_reshade(stages, inputs):
    """The stage alone; a frame runs it with the others (test_prepare)."""
    planes = {name: without_tiny(a).astype(np.float32) if a.dtype == np.float64 else a for name, a in inputs.items()}
    with np.errstate(invalid="ignore", over="ignore"):
        want = reshade(**planes)
    assert_same(stages.run_stage("reshade", planes)["reshade"], want)


def test_a_weight_that_vanishes_in_a_dark_channel_is_none(stages):
    """It is 2.6e-38; an eighth of it is no normal number, which the device may take for 0: no quotient of zeros is written."""
    inputs = {
        name: np.zeros((1, 20, 3), np.float32) for name in ("color", "warped", "position_previous", "position", "base_color")
    }
    inputs |= {name: np.zeros((1, 20), np.float32) for name in ("stencil_previous", "stencil")}
    inputs |= {name: np.full((1, 20, 3), (0, 0, 1), np.float32) for name in ("normal_previous", "normal")}
    inputs |= {"motion": np.full((1, 20, 2), np.inf, np.float32), "valid": np.arange(20)[None] != 10}
    inputs["warped"][:] = 0.5
    inputs["base_color"][0, [8, 12, 6, 14, 2, 18], 0] = 2.5e9
    assert np.isfinite(stages.run_stage("reshade", inputs)["reshade"]).all()


STEPS = ((1, 3, 5), (0, 2, 4), (1, 3, 3), (1, 1, 1), (0, 2, 2), (0, 0, 0), (2, 3, 5))


@st.composite
def frame_inputs(draw, size):
    """The judge's, with motion of any kind, depths that tie, values that are no numbers; none that is tiny."""
    steps = draw(st.sampled_from(STEPS))
    inputs = draw(drawn.frame_inputs(st.just(size), steps)) | {"steps": steps}
    inputs["motions"] = np.stack([draw(broken(motions(size))) for _ in range(max(*steps, 1))])
    inputs["gbuffer"] = np.random.default_rng(draw(SEEDS)).random((*size, 9))
    inputs["gbuffer"][..., 3] = draw(depths(size))
    inputs["positions"] = draw(broken(st.just(inputs["positions"] * draw(st.sampled_from([1, 1.1])))))
    return FrameInputs(**{name: a if name == "steps" else without_tiny(a).astype(np.float32) for name, a in inputs.items()})


def downloaded(device, buffer, shape, dtype=np.float32):
    array = np.empty(shape, dtype)
    assert buffer.size >= array.nbytes  # behind it lies room for strips that stick out
    cl.enqueue_copy(device.queue, array, buffer)
    return array


def prepared(preparation, inputs):
    preparation.begin(**vars(inputs))
    preparation.strip()
    return preparation


def assert_prepared(device, preparation, inputs, size, second="newest", test="footprint", hole_fill="occlusion_warp"):
    """All that the network is given, padding and borders too."""
    rows, columns, got = preparation.rows, preparation.columns, preparation.inputs
    with np.errstate(invalid="ignore", over="ignore"):
        want = prepare(inputs, second=second, test=test, hole_fill=hole_fill)
    color, gbuffer, mask = pad_to_8(want.color), pad_to_8(want.gbuffer), pad_to_8(want.mask[..., None])
    packed = np.concatenate([color, color * mask, gbuffer, np.zeros((rows, columns, 3), np.float32)], axis=-1)
    border = ((1, 1), (1, 1), (0, 0))
    assert_same(downloaded(device, got.input.data, (rows + 2, columns + 2, 24)), np.pad(packed, border))
    history = np.pad(pad_to_8(want.history), ((0, 0), *border))
    assert_same(downloaded(device, got.earlier.data, (3, rows + 2, columns + 2, 4)), history)
    assert_same(downloaded(device, got.base, (rows, columns, 4)), np.pad(color[..., :3], ((0, 0), (0, 0), (0, 1))))
    f = np.concatenate([downsample_8(gbuffer), downsample_8(mask), np.zeros((rows // 8, columns // 8, 6), np.float32)], axis=-1)
    assert_same(read(device, got.eighth), f)
    assert_same(downloaded(device, preparation.mask, size, np.uint8), want.mask.astype(np.uint8))


@pytest.mark.parametrize(
    ("test", "second", "hole_fill"),
    [
        ("footprint", "newest", "occlusion_warp"),
        thorough("paper", "newest", "occlusion_warp"),
        thorough("footprint", "detail", "occlusion_warp"),
        ("footprint", "detail", "reshade"),
        thorough("paper", "newest", "reshade"),
    ],
)
@settings(max_examples=20)
@given(data=st.data(), size=sizes(26))
def test_prepare(device, test, second, hole_fill, data, size):
    """One frame after another in the same buffers, whole and in strips: nothing of the first is left in the second."""
    options = PrepareOptions(second=second, test=test, hole_fill=hole_fill)
    whole = Prepare(device, *size, options)
    strip = inputs_for(device, 8, whole.columns, np.dtype(np.float32))
    tops = range(0, whole.rows, 8)
    parts = Prepare(device, *size, options, inputs=strip, tops=tops)
    for _ in range(2):
        inputs = data.draw(frame_inputs(size))
        assert_prepared(device, prepared(whole, inputs), inputs, size, second, test, hole_fill)
        parts.begin(**vars(inputs))
        shape = whole.rows + 2, whole.columns + 2, 24
        rows = downloaded(device, whole.inputs.input.data, shape)
        for top in tops:
            parts.strip(top)
            assert_same(downloaded(device, strip.input.data, (10, *shape[1:]))[1:-1], rows[top + 1 : top + 9])


def test_prepare_in_wide_frames(device):
    """Fractions that a sum with the column would lose, motion just beside whole pixels, and each kind of far and lost motion."""
    size = (8, 4099)
    random = np.random.default_rng(6)
    motions = random.uniform(-3, 3, (5, *size, 2))
    beside = np.rint(motions) + random.choice([-1, 1], motions.shape) * 2.0 ** -random.integers(12, 40, motions.shape)
    motions = np.where(random.random(motions.shape) < 0.3, beside, motions).astype(np.float32)
    far = np.array([f * 2.0**e for f in (-1.5, -1, 1, 1.5) for e in range(11, 34)] + [np.nan, np.inf, -np.inf, 3e38, -3e38])
    motions[:, :, ::50][..., 0] = np.resize(far, motions[:, :, ::50][..., 0].shape)
    motions[:, :, 25::50][..., 1] = np.resize(far, motions[:, :, 25::50][..., 1].shape)
    stencils = (random.random((4, *size)) < 0.1).astype(np.float32)
    inputs = noise(size, motions=motions, stencils=stencils, positions=random.random((4, *size, 3)) * 30)
    options = PrepareOptions(second="detail", hole_fill="reshade")
    assert_prepared(device, prepared(Prepare(device, *size, options), inputs), inputs, size, "detail", hole_fill="reshade")


@pytest.mark.parametrize(
    ("test", "motion", "hole_fill"),
    [
        ("footprint", (1.5, 0.75), "reshade"),
        ("footprint", (0.0, 0.0), "reshade"),
        thorough("footprint", (1.5, 0.75), "occlusion_warp"),
        thorough("paper", (-3.25, 0.0), "occlusion_warp"),
    ],
)
def test_prepare_where_hardly_anything_is_a_hole(device, test, motion, hole_fill):
    """A surface that slides past: eight pixels in a row are read at once and trusted, but where one of the eight is another surface."""
    size = (24, 70)
    random = np.random.default_rng(9)
    steps = (1, 3, 5)
    y, x = np.indices(size)
    positions = np.stack([np.stack([x - s * motion[0], y - s * motion[1], 0 * x], -1) for s in (0, *steps)]).astype(np.float32)
    stencils = np.zeros((4, *size), np.float32)
    for plane in range(4):
        for value in (400, np.nan, np.inf):
            positions[plane, random.integers(24), random.integers(70), random.integers(3)] = value
        stencils[plane, random.integers(24), random.integers(70)] = 1
    colors, normals = random.normal(0.5, 0.5, (3, *size, 3)), random.normal((0, 0, 1), 0.2, (4, *size, 3))
    normals[:, :, 30:45] = 0
    motions = motion + random.uniform(0, 0.2, (5, *size, 2))
    inputs = noise(size, colors=colors, motions=motions, stencils=stencils, normals=normals, positions=positions)
    preparation = Prepare(device, *size, PrepareOptions(second="detail", test=test, hole_fill=hole_fill))
    for _ in range(2):  # nothing that the first marked is left in the second
        assert_prepared(device, prepared(preparation, inputs), inputs, size, "detail", test, hole_fill)
        if hole_fill == "occlusion_warp":
            assert not downloaded(device, preparation.splat, size, np.uint32).any()
    assert 0 < np.mean(downloaded(device, preparation.mask, size, np.uint8) == 0) < 0.2


def edge(motion, off, where=..., *, far=None, apart=1, depth=0.0, stencil=0.0):
    """A surface, ``apart`` cm from pixel to pixel, a hundred times that from row to row, seen again by ``motion``, ``off`` cm away; pixels
    that are ``far`` do not count for their neighbours."""
    size, (dx, dy) = (16, 24), motion
    y, x = np.indices(size)
    now = np.stack([apart * x, apart * 100 * y, 0 * x], -1).astype(np.float32)
    if far is not None:
        now[..., 2][far] = 1e20
    before = now.copy()
    before[..., 2][where] += off
    positions = np.stack([now, now, *3 * [np.roll(before, (int(dy), int(dx)), (0, 1))]])[1:]  # finite before the first row, too
    planes = {"gbuffer": np.full((*size, 9), depth), "nov": np.ones(size), "motions": np.full((5, *size, 2), motion)}
    return noise(size, positions=positions, stencils=np.stack([x * 0 + stencil, *3 * [0 * x]]), **planes)


ROOT = 1.5 * 10001**0.5
"""The largest trusted distance by the footprint; by the paper's test it is 7.5 cm + 50 ``depth``."""


@pytest.mark.parametrize(
    ("test", "inputs"),
    [
        ("footprint", edge((0, 0), ROOT * (1 + 1e-5))),
        ("footprint", edge((0, 0), 160, np.s_[:, 0], far=np.s_[:, 1])),
        ("footprint", edge((-1, 0), 160, np.s_[:, 23], far=np.s_[:, 22])),
        ("footprint", edge((0, 0), 2, np.s_[0], far=np.s_[1])),
        ("footprint", edge((0, -1), 2, np.s_[15], far=np.s_[14])),
        ("footprint", edge((0, 0), 0, stencil=0.34)),
        thorough("paper", edge((0, 0), 7.5 * (1 + 1e-5), apart=0)),
        thorough("paper", edge((0, 0), 1, apart=0, depth=-1.0)),
        thorough("paper", edge((0, 0), 2e19, apart=0, depth=1e18)),
    ],
)
def test_prepare_trusts_eight_pixels_only_where_it_trusts_each(device, test, inputs):
    preparation = Prepare(device, 16, 24, PrepareOptions(test=test))
    assert_prepared(device, prepared(preparation, inputs), inputs, (16, 24), test=test)


def test_a_normal_is_0_by_its_components(device):
    """A square is 0 from 1e-23 on, where subnormal numbers are flushed from 1e-19: a surface must not become a background."""
    inputs = edge((0.25, 0.25), 0)
    inputs.normals[0], inputs.normals[1:] = 0, 1e-22
    preparation = Prepare(device, 16, 24)
    assert_prepared(device, prepared(preparation, inputs), inputs, (16, 24))
    assert not downloaded(device, preparation.mask, (16, 24), np.uint8).any()


@pytest.mark.parametrize("steps", [(0, 2, 4), (1, 3, 5), (1, 1, 1)])
def test_prepare_sees_what_is_not_finite(device, steps):
    """In each plane of each array, in whole rows of eight and behind the last one, in one strip and in three; and forgets it."""
    size, random = (17, 21), np.random.default_rng(3)
    arrays = vars(noise(size, steps=steps))
    for inputs, tops in ((None, (0,)), (inputs_for(device, 8, 24, np.dtype(np.float32)), (0, 8, 16))):
        preparation = Prepare(device, *size, inputs=inputs, tops=tops)

        def bad(preparation=preparation, tops=tops):
            preparation.begin(**arrays)
            for top in tops:
                preparation.strip(top)
            return preparation.not_finite()

        assert bad() is None
        for name in FINITE:
            array = arrays[name]
            values = 1 if array.shape[-1] == 21 else array.shape[-1]
            lasts = range((5 * 21 + 16) * values - 1, array.size, 17 * 21 * values)  # of eight pixels, in each plane
            for place in (0, array.size - 1, *lasts, *random.integers(array.size, size=2)):
                old, array.flat[place] = array.flat[place], random.choice([np.nan, np.inf, -np.inf])
                assert bad() == name, (name, np.unravel_index(place, array.shape))
                array.flat[place] = old
        assert bad() is None


def test_accumulation_of_frames_in_turns(device):
    """Sizes change; arrays are read in place or, at an address that OpenCL does not take, copied; and an answer is the caller's."""
    accumulate_frames, random, answers = Accumulate(device), np.random.default_rng(3), []
    for size in ((5, 7), (24, 40), (5, 7)):
        display = tuple(2 * length for length in size)
        image, *earlier = (random.random((*display, 3), np.float32) for _ in range(3))
        motions = random.uniform(-3, 3, (2, *size, 2)).astype(np.float32)
        motions[:, 0, 0] = np.nan
        odd = np.empty(image.size + 1, np.float32)[1:].reshape(image.shape)
        odd[:] = image
        chained = np.stack([*chain_steps(motions)])
        for count in (1, 2):
            want = accumulate(image, np.stack(earlier[:count]), chained[:count])
            there = [cla.to_device(device.queue, each) for each in (*earlier, *motions)]
            answers += [(accumulate_frames(each, earlier[:count], motions[:count]), want) for each in (image, odd)]
            answers.append((accumulate_frames(image, there[:count], there[2 : 2 + count]), want))
    for got, want in answers:
        np.testing.assert_array_equal(got.get() if isinstance(got, cla.Array) else got, want)


@pytest.mark.parametrize(
    ("name", "wrong", "words"),
    [
        ("image", np.zeros((8, 12, 4), np.float32), r"image: expected shape \(8, 12, 3\), got \(8, 12, 4\)"),
        ("earlier", [np.zeros((8, 12, 3))], r"earlier\[0\]: expected dtype float32, got float64"),
        ("earlier", [], "earlier, motions: expected one or two each, as many of both, got 0 and 1"),
        ("motions", [np.zeros((4, 6, 3), np.float32)], r"motions\[0\]: expected shape \(any, any, 2\), got \(4, 6, 3\)"),
        ("motions", 2 * [np.zeros((4, 6, 2), np.float32)], "as many of both, got 1 and 2"),
    ],
)
def test_images_that_do_not_fit_are_named(device, name, wrong, words):
    right = {"image": np.zeros((8, 12, 3), np.float32), "earlier": [np.zeros((8, 12, 3), np.float32)]}
    right["motions"] = [np.zeros((4, 6, 2), np.float32)]
    with pytest.raises(ArrayError, match=words):
        Accumulate(device)(**{**right, name: wrong})
