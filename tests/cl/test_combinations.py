"""Every precision and way to skip, on both classes of device, on small frames"""

from __future__ import annotations

import numpy as np
import pytest

from conformance.tolerance import ratio
from stss.frames.backends import ReferenceBackend
from stss_cl.options import PRECISIONS
from stss_cl.skip.stream import Stream
from tests.cl.films import WEIGHTS, assert_same, calls_of, film

SIZE = 19, 45  # rows of eight pixels and the rest of one; whole tiles and cut ones
CHANGES = (*6 * ["nothing"], "moving", "moving", "pixel", "moving", "nothing", "moving", "rectangle", "moving")


@pytest.mark.thorough
@pytest.mark.parametrize("precision", PRECISIONS)
def test_every_way_gives_the_frames_of_the_reference(device, precision):
    """Those of `off` are the reference's; `exact` has its bits."""
    if precision == "bfloat16" and not device.is_cpu:
        pytest.skip("the same kernels on either class")
    reference = ReferenceBackend(WEIGHTS)
    off, exact = (Stream(WEIGHTS, device, precision, skip=skip) for skip in ("off", "exact"))
    in_part = [0, 0]
    for i, (window, steps) in enumerate(calls_of(film(CHANGES, SIZE))):
        image, valid = off(window, steps)
        want, want_valid = reference.compute(window, steps)
        np.testing.assert_array_equal(valid, want_valid)
        assert ratio(f"network.cl.{precision}", image, want.astype(np.float64)) <= 1
        assert_same(exact(window, steps), (image, valid))
        in_part[i % 2] += exact.cost.network == "changed"
    assert min(in_part) > 0  # of either kind, or nothing was tried
