# SPDX-License-Identifier: MIT
"""The correct ports are correct, and their arithmetic is another one."""

from functools import cache, partial

import numpy as np
import pytest

from conformance.protocol.stages import STAGES, check_inputs, check_outputs, reference
from stss_lab.stress.inputs import exact
from stss_ref.conv import conv
from tests.meta import right_ports as others
from tests.meta.samples import departs, samples, weights_of

ROWS = {"float32": "stage.cl", "float16": "network.cl.half"}
"""What the port is held to: that of the OpenCL backend."""

NETWORK = {"history", "encoder", "erm", "decoder", "network", "frame"}
READS = {"warp", "occlusion_warp"}
DIFFERENT = {
    "as_is": set(),
    "in_order": NETWORK,
    "pairwise": NETWORK,
    "fma": NETWORK | READS,
    "orders": NETWORK | READS,
    "double": {"warp", "occlusion_warp", "frame"},
    "flush": set(),
    "winograd_2": NETWORK,
    "winograd_4": NETWORK,
    "winograd_4_near": NETWORK,
    "half": NETWORK | READS,
}
"""Stages in which a port's bits are others than those of the reference run in float32; of all but ``half_flush``, which is ``half``."""


@cache
def made(name):
    return others.port(name)


@cache
def given(stage, dtype):
    """A stage's samples as a port of this dtype is given them, and what the reference makes of them in float64 and float32."""
    with np.errstate(all="ignore"):
        # Loud weights amplify every rounding.
        return [
            (inputs, weights, reference(stage, exact(inputs), weights), reference(stage, inputs, weights))
            for inputs, weights in [(held(case.inputs, dtype), case.weights) for case in samples(stage)]
            if weights is not weights_of("loud")
            and all(np.isfinite(a).all() for n, a in inputs.items() if n.startswith("stencil"))  # half has no 65,536
        ]


def held(inputs, dtype):
    return {name: others.to_half(a) if dtype == "float16" and a.dtype.kind == "f" else a for name, a in inputs.items()}


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("name", DIFFERENT)
def test_each_is_near_the_reference(name, stage):
    """Within what is asked of the OpenCL backend; with other bits where they ought to be others, and only there."""
    judged = made(name)
    different = False
    for inputs, weights, truth, rounded in given(stage, judged.dtype):
        got = judged.run(stage, inputs, weights)
        check_outputs(stage, got, check_inputs(stage, inputs))
        assert not departs(got, truth, ROWS[judged.dtype])
        different |= departs(got, rounded, None)
    assert different == (stage in DIFFERENT[name])


def operands(size=(5, 6), channels=4, outputs=3, kernel=3):
    random = np.random.default_rng(6)
    x, weight, bias = (
        random.normal(0, 1, shape).astype(np.float32)
        for shape in ((*size, channels), (outputs, channels, kernel, kernel), (outputs,))
    )
    return x, weight, bias


def test_a_fused_sum_rounds_once():
    """1 + 2**-12 squared, less 1 + 2**-11, is 2**-24; rounded before the sum it is 0."""
    a = np.array([1 + 2.0**-12], np.float32)
    c = -np.array([1 + 2.0**-11], np.float32)
    assert (a * a + c).item() == 0
    assert others.multiply_add(a, a, c).item() == 2.0**-24
    assert others.add_fused(a[None], a[None], c).item() == 2.0**-24


@pytest.mark.parametrize("name", ["winograd_2", "winograd_4", "winograd_4_near"])
@pytest.mark.parametrize("size", [(1, 1), (4, 4), (5, 6), (9, 3)])
def test_winograd_is_a_convolution(name, size):
    """To float64's rounding, at every size: what departs in float32 is rounding and nothing else."""
    function = partial(others.winograd, *others.WINOGRAD[name])
    x, weight, bias = (a.astype(np.float64) for a in operands(size))
    assert not departs({"y": function(x, weight, bias)}, {"y": conv(x, weight, bias)}, "network.float64")
    np.testing.assert_array_equal(function(x, weight, bias, 2), conv(x, weight, bias, 2))


def test_ports_are_found_by_name():
    assert [judged.name for judged in others.ports()] == list(others.PORTS)
    assert {judged.name for judged in others.ports() if judged.winograd} == {
        "winograd_2",
        "winograd_4",
        "winograd_4_near",
    }
    assert {judged.name for judged in others.ports() if judged.dtype == "float16"} == {"half", "half_flush"}
    assert [getattr(others, name)().name for name in others.PORTS] == list(others.PORTS)
    with pytest.raises(AttributeError):
        others.quarter  # noqa: B018
