"""The OpenCL backend before its own judge, on whatever runtime is found: a part of what ``stss conform`` does."""

import pytest

from conformance.judging.judge import Judge, Tier
from conformance.suite.run_suite import run_suite
from stss.port import OpenCLPort


@pytest.mark.thorough
@pytest.mark.usefixtures("opened")
def test_conforms(device):
    precision = "float32" if device.is_cpu else "half"
    results = run_suite(Judge(OpenCLPort(precision), Tier("some", 3, 1, int(device.is_cpu))))
    assert len(results) > 50
    assert not [f"{result.id}: {result.message}" for result in results if result.outcome != "passed"]
