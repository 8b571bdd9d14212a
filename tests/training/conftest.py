"""A folder of samples, small enough to train on in a test."""

import numpy as np
import pytest

from stss_ref.schedule import FrameKind
from training.samples import Sample, write


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Frames whose truth is 0.1 brighter than what bilinear gives; an odd size, so that validation has to pad."""
    folder, random = tmp_path_factory.mktemp("data"), np.random.default_rng(0)
    for split in ("training", "validation"):
        samples = []
        for kind in (FrameKind.SF, FrameKind.EF):
            inputs = random.random((17, 20, 35)) * 0.2 + 0.3
            inputs[..., [15, 19, 23]] = 1
            inputs[..., :3] = 0.4
            samples.append(Sample(0, kind, inputs, np.full((34, 40, 3), 0.5)))
        write(folder / split, split, split, "occlusion_warp", samples)
    return folder
