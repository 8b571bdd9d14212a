"""A whole frame on OpenCL against the reference, and as a backend and a port."""

from dataclasses import replace

import numpy as np
import pyopencl.array as cla
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, motions, sizes
from conformance.tolerance import BOUNDS, ratio
from stss_cl import Frame
from stss_cl.frame import FrameStages
from stss_cl.liveness import colors_read, find_live
from stss_ref.arrays import ArrayError
from stss_ref.frame import frame
from stss_ref.reshade import STEPS as STEPS_OF_RINGS
from stss_ref.weights import Weights, zeros
from tests.cl.conftest import ALL_LAYERS
from tests.cl.films import DETAILED, SHIPPED, UNREAD, WEIGHTS, appearing, frame_inputs, uneven
from tests.tiers import thorough

STEPS = [(0, 2, 4), (1, 3, 5), (0, 0, 0), (1, 1, 1), (0, 2, 2), (1, 3, 3)]


QUICK = {"cpu": [("float32", WEIGHTS), ("float32", UNREAD), ("float32", DETAILED)], "gpu": [("float32", SHIPPED)]}
MORE = {
    "cpu": [("float32-direct", WEIGHTS), ("half", WEIGHTS), ("half", Weights(WEIGHTS, "detail"))],
    "gpu": [*QUICK["cpu"], ("half", WEIGHTS), ("half", Weights(WEIGHTS, "detail"))],
}


@pytest.fixture(scope="module")
def frame_and_weights(request, device):
    precision, weights = request.param
    return Frame(weights, device, precision), weights


@pytest.mark.parametrize(
    ("device", "frame_and_weights"),
    [(name, case) for name, cases in QUICK.items() for case in cases]
    + [thorough(name, case) for name, cases in MORE.items() for case in cases],
    indirect=True,
)
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data(), size=sizes(24), seed=SEEDS, steps=st.sampled_from(STEPS))
def test_the_frame_is_the_references(frame_and_weights, data, size, seed, steps):
    """The holes bit for bit, the image within the network's bound; frames that the weights do not read are not looked at."""
    (ours, weights), chain = frame_and_weights, [data.draw(motions(size)) for _ in range(max(steps))]
    moving = np.stack(chain) if chain else np.zeros((0, *size, 2))
    inputs = frame_inputs(size, seed, steps, motions=moving, **uneven(size, seed))
    want, want_valid = frame(inputs, weights)
    depth_of_colors = colors_read(weights, find_live(weights))
    spoilt = {"colors": inputs.colors.copy()} | {n: getattr(inputs, n).copy() for n in ("stencils", "normals", "positions")}
    for name, array in spoilt.items():
        array[depth_of_colors + (name != "colors") :] = np.nan
    image, valid = ours(**vars(replace(inputs, **spoilt)))
    np.testing.assert_array_equal(valid, want_valid)
    assert ratio(f"network.cl.{ours.precision}", image, want.astype(np.float64)) <= 1


def test_wide_holes_are_filled_from_like_materials_far_away(device):
    """The filled colours, enlarged, within the bound of stage reshade; of squares of 40 pixels the middle reads 32 and 64 pixels away."""
    size, weights = (170, 187), Weights(zeros(), hole_fill="reshade")
    inputs = frame_inputs(size, 3, gbuffer=np.random.default_rng(3).integers(0, 3, (*size, 9)) / 2, **appearing(size))
    image, valid = Frame(weights, device)(**vars(inputs))
    want, want_valid = frame(inputs, weights)
    np.testing.assert_array_equal(valid, want_valid)
    assert 0.1 < (valid == 0).mean() < 0.6
    roundings = BOUNDS["like"].roundings + BOUNDS["own"].roundings + 2 * 16 * len(STEPS_OF_RINGS)
    np.testing.assert_allclose(image, want, rtol=0, atol=roundings * 2.0**-24)


def test_without_a_residual_it_is_the_references_bits(device):
    """The `bilinear` weights: warping, holes and upsampling alone, which are exact; one frame after another in the same buffers."""
    size, engine = (13, 21), Frame(zeros(), device)
    for seed, steps in enumerate(((1, 3, 5), (2, 3, 5), (1, 1, 1), (0, 2, 4), (1, 3, 5))):
        inputs = frame_inputs(size, seed, steps, **uneven(size, seed))
        image, valid = engine(**vars(inputs))
        want, want_valid = frame(inputs, zeros())
        np.testing.assert_array_equal(image, want)
        np.testing.assert_array_equal(valid, want_valid)
    np.testing.assert_array_equal(FrameStages(zeros(), device).run_stage("frame", vars(inputs))["image"], want)


@ALL_LAYERS
@pytest.mark.parametrize("on_device", [False, True])
def test_older_frames_are_checked_where_they_are_read(device, on_device):
    inputs = vars(frame_inputs((9, 11)))
    nan = inputs["colors"].copy()
    nan[1:] = np.nan

    def call(weights, colors):
        arrays = inputs | {"colors": colors}
        arrays_there = {n: cla.to_device(device.queue, a) if on_device and n != "steps" else a for n, a in arrays.items()}
        return Frame(weights, device)(**arrays_there)

    image, _ = call(UNREAD, nan)
    assert np.isfinite(image.get() if on_device else image).all()
    for colors, words in ((nan[:1].copy(), "colors: expected"), (nan, r"colors: .* non-finite values")):
        with pytest.raises(ArrayError, match=words):
            call(WEIGHTS, colors)
