# SPDX-License-Identifier: MIT
"""The correct ports are correct, and their arithmetic differs from the reference's."""

from functools import cache

import numpy as np
import pytest

from conformance.judging.judge import Judge, Tier
from conformance.protocol.stages import STAGES, check_inputs, check_outputs, reference
from conformance.suite.run_suite import SUITE, run_suite
from stss.port import ReferencePort
from stss_lab.stress.inputs import exact
from tests.meta import right_ports as others
from tests.meta.samples import departs, samples, weights_of
from tests.tiers import every

ROWS = {"float32": "stage.cl", "float16": "network.cl.half"}
"""The row of bounds for the port: that of the OpenCL backend."""

NETWORK = {"history", "encoder", "erm", "decoder", "network", "frame"}
READS = {"warp", "occlusion_warp", "accumulate"}
DIFFERENT = {
    "as_is": set(),
    "in_order": NETWORK,
    "pairwise": NETWORK,
    "fma": NETWORK | READS,
    "orders": NETWORK | READS | {"reshade"},
    "double": {"warp", "occlusion_warp", "frame", "accumulate"},
    "flush": set(),
    "winograd_2": NETWORK,
    "winograd_4": NETWORK,
    "winograd_4_near": NETWORK,
    "half": NETWORK | READS | {"reshade"},
}
"""Stages in which a port's bits are others than those of the reference run in float32; of all but ``half_flush``, a ``half`` with more."""


@cache
def port_of(name):
    return others.port(name)


@cache
def samples_of(stage, dtype):
    """A stage's samples as a port of this dtype is given them, and what the reference makes of them in float64 and float32."""
    with np.errstate(all="ignore"):
        # Loud weights amplify every rounding.
        return [
            (inputs, weights, reference(stage, exact(inputs), weights), reference(stage, inputs, weights))
            for inputs, weights in [(as_stored(case.inputs, dtype), case.weights) for case in samples(stage)]
            if weights is not weights_of("loud")
            and all(np.isfinite(a).all() for n, a in inputs.items() if n.startswith("stencil"))  # half has no 65,536
        ]


def as_stored(inputs, dtype):
    return {name: others.to_half(a) if dtype == "float16" and a.dtype.kind == "f" else a for name, a in inputs.items()}


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.parametrize("name", every(3, DIFFERENT))
def test_each_is_near_the_reference(name, stage):
    """Within the OpenCL backend's bounds; with other bits in exactly those stages where they must differ."""
    port = port_of(name)
    different = False
    for inputs, weights, truth, rounded in samples_of(stage, port.dtype):
        got = port.run(stage, inputs, weights)
        check_outputs(stage, got, check_inputs(stage, inputs))
        assert not departs(got, truth, ROWS[port.dtype])
        different |= departs(got, rounded, None)
    assert different == (stage in DIFFERENT[name])


@pytest.mark.parametrize("stage", [stage.name for stage in STAGES.values() if not stage.weights])
def test_what_is_stored_in_half_is_half(stage):
    """All that the stages of image space give; the network's image is a sum that is stored in float32."""
    for inputs, *_ in samples_of(stage, "float16"):
        for name, array in port_of("half_flush").run(stage, inputs).items():
            is_half = np.array_equal(array, others.to_half(array), equal_nan=array.dtype.kind == "f")
            assert is_half, f"{stage}.{name} is float32: expected a plant of half in tests/meta/right_ports.py"


@pytest.mark.parametrize("stage", every(4, sorted({*SUITE} - {"rrm"})))
def test_what_needs_no_reference_holds_for_it(stage):
    """Whole frames as often as in the quick tier. Comparisons with the reference have other tests, and ``make alarms``."""
    judge = Judge(ReferencePort(), Tier("some", 24, 24 if stage in ("frame", "sequence") else 6, 0), shrink=False)
    results = run_suite(judge, [stage], only="not agree and not kept_by and not wide and not thresholds and not round")
    assert not [f"{result.id}: {result.message}" for result in results if result.outcome != "passed"]


def test_a_fused_sum_rounds_once():
    """1 + 2**-12 squared, less 1 + 2**-11, is 2**-24; rounded before the sum it is 0."""
    a = np.array([1 + 2.0**-12], np.float32)
    c = -np.array([1 + 2.0**-11], np.float32)
    assert (a * a + c).item() == 0
    assert others.multiply_add(a, a, c).item() == 2.0**-24
    assert others.add_fused(a[None], a[None], c).item() == 2.0**-24
