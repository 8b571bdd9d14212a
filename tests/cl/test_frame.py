"""A whole frame on OpenCL against the reference, and as a backend and a port."""

from dataclasses import fields

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from conformance.cases.planes import SEEDS, motions, sizes
from conformance.tolerance import ratio
from stss_cl import Frame
from stss_cl.frame import run_stage
from stss_ref.arrays import ArrayError
from stss_ref.frame import FrameInputs, frame
from stss_ref.weights import Weights, zeros
from stss_ref.weights import random as random_weights
from tests.cl.conftest import QUICK

few = settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def frame_inputs(draw, size):
    random = np.random.default_rng(draw(SEEDS))
    steps = draw(st.sampled_from([(0, 2, 4), (1, 3, 5), (0, 0, 0), (1, 1, 1), (0, 2, 2), (1, 3, 3)]))

    def noise(*shape):
        return random.random(shape, dtype=np.float32)

    chain = [draw(motions(size)) for _ in range(max(steps))]
    return FrameInputs(
        colors=noise(3, *size, 3),
        steps=steps,
        motions=np.stack(chain).astype(np.float32) if chain else np.zeros((0, *size, 2), np.float32),
        gbuffer=noise(*size, 9),
        nov=noise(*size),
        stencils=(noise(4, *size) > 0.8).astype(np.float32),
        normals=noise(4, *size, 3),
        positions=noise(4, *size, 3) * 30,
    )


def arguments(inputs):
    return {f.name: getattr(inputs, f.name) for f in fields(inputs)}


@pytest.fixture(scope="module", params=QUICK)
def made(request, device):
    return Frame(random_weights(5), device, request.param)


@few
@given(data=st.data(), size=sizes(24))
def test_the_frame_is_the_references(made, data, size):
    """The holes are the float32 reference's bit for bit, the image within the network's bound."""
    inputs = data.draw(frame_inputs(size))
    image, valid = made(**arguments(inputs))
    want, want_valid = frame(inputs, random_weights(5))
    np.testing.assert_array_equal(valid, want_valid)
    assert ratio(f"network.cl.{made.precision}", image, want.astype(np.float64)) <= 1


def test_without_a_residual_it_is_the_references_bits(device):
    """The `bilinear` weights: warping, holes and upsampling alone, which are exact; one frame after another in the same buffers."""
    random, size = np.random.default_rng(3), (13, 21)
    made = Frame(zeros(), device)
    for steps in ((1, 3, 5), (2, 3, 5), (1, 1, 1), (0, 2, 4), (1, 3, 5)):
        inputs = FrameInputs(
            colors=random.random((3, *size, 3), dtype=np.float32),
            steps=steps,
            motions=random.uniform(-3, 3, (5, *size, 2)).astype(np.float32),
            gbuffer=random.random((*size, 9), dtype=np.float32),
            nov=random.random(size, dtype=np.float32),
            stencils=(random.random((4, *size)) < 0.1).astype(np.float32),
            normals=random.random((4, *size, 3), dtype=np.float32),
            positions=random.random((4, *size, 3), dtype=np.float32) * 40,
        )
        image, valid = made(**arguments(inputs))
        want, want_valid = frame(inputs, zeros())
        np.testing.assert_array_equal(image, want)
        np.testing.assert_array_equal(valid, want_valid)
    np.testing.assert_array_equal(run_stage("frame", arguments(inputs), zeros(), device)["image"], want)


@pytest.mark.parametrize("on_device", [False, True])
def test_what_the_weights_do_not_read_is_not_looked_at(device, on_device):
    """Two older colour frames that would make any image non-finite, and motions that lead to them alone."""
    import pyopencl.array as cla

    size = (9, 11)
    random = np.random.default_rng(6)
    shapes = {"colors": (3, *size, 3), "gbuffer": (*size, 9), "nov": size, "stencils": (4, *size), "normals": (4, *size, 3)}
    arrays = {n: random.random(shape, np.float32) for n, shape in shapes.items()}
    arrays |= {"motions": np.full((5, *size, 2), 0.5, np.float32), "positions": np.zeros((4, *size, 3), np.float32)}
    weights = random_weights(1)
    without = weights | {
        n: np.zeros_like(w) for n, w in weights.items() if n.startswith("lowlevelGated.") and n.endswith(".weight")
    }
    spoilt = {n: a.copy() for n, a in arrays.items()}
    for name, first in {"colors": 1, "motions": 1, "stencils": 2, "normals": 2, "positions": 2}.items():
        spoilt[name][first:] = np.nan

    def given(arrays):
        return {n: cla.to_device(device.queue, a) if on_device else a for n, a in arrays.items()}

    made = Frame(without, device)
    want, want_valid = frame(FrameInputs(steps=(1, 3, 5), **arrays), without)
    image, valid = made(steps=(1, 3, 5), **given(spoilt))
    assert ratio("network.cl.float32", image.get() if on_device else image, want.astype(np.float64)) <= 1
    np.testing.assert_array_equal(valid, want_valid)
    with pytest.raises(ArrayError, match="colors: expected"):
        made(steps=(1, 3, 5), **given(arrays | {"colors": arrays["colors"][:1].copy()}))
    with pytest.raises(ArrayError, match=r"colors: .* non-finite values"):
        Frame(weights, device)(steps=(1, 3, 5), **given(spoilt))


@pytest.mark.parametrize("precision", ["float32", "half"])
@settings(few, max_examples=8)
@given(data=st.data(), size=sizes(24))
def test_with_an_earlier_second_colour_the_frame_is_the_references(device, precision, data, size):
    """With weights that do not read the history, and with some that do; of those that do not, the oldest frame is not looked at."""
    inputs, weights = data.draw(frame_inputs(size)), random_weights(5)
    unread = weights | {n: w * 0 for n, w in weights.items() if n.startswith("lowlevelGated.") and n.endswith(".weight")}
    if data.draw(st.booleans()):
        weights, last = unread, 2
    else:
        last = 3
    weights = Weights(weights, "earlier")
    want, want_valid = frame(inputs, weights)
    spoilt = {n: a if n in ("steps", "gbuffer", "nov") else a.copy() for n, a in arguments(inputs).items()}
    for name, first in {"colors": last, "stencils": last + 1, "normals": last + 1, "positions": last + 1}.items():
        spoilt[name][first:] = np.nan
    image, valid = Frame(weights, device, precision)(**spoilt)
    np.testing.assert_array_equal(valid, want_valid)
    assert ratio(f"network.cl.{precision}", image, want.astype(np.float64)) <= 1
