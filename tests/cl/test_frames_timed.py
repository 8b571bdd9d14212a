"""The benchmark's frames in sequence, on each class of device."""

import numpy as np

from stss_lab.bench.ours import contender, frame_inputs, truth
from tests.app.lab.test_bench import WEIGHTS, setup
from tests.cl.conftest import ALL_LAYERS


@ALL_LAYERS
def test_frames_in_sequence_end_with_that_of_the_inputs(opened):
    """Else their error would be that of other frames."""
    inputs = frame_inputs(16, 24)
    want = truth(inputs, WEIGHTS)
    for name in ("cl-stream", "cl-stream-ahead"):
        engine = contender(name, setup(16, 24))
        engine.prepare(inputs)
        for _ in range(2):
            engine.run()
            assert np.abs(engine.image() - want).max() < 1e-3
