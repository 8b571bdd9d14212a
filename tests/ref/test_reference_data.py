"""The reference against the authors' network and ExtraNet's published warping, where their files are at hand."""

import numpy as np
import pytest
from safetensors.numpy import load_file

from conformance.tolerance import ratio
from stss.weights.checkpoint import read_checkpoint
from stss_ref.holes import holes
from stss_ref.network import network
from stss_ref.occlusion_warp import occlusion_warp
from stss_ref.sample import follow, leads_inside
from stss_ref.warp import warp
from stss_ref.weights import astype

NETWORKS = ["arena_small", "arena_mid", "arena_wide", "lewis_small", "lewis_mid", "lewis_wide"]
WARPS = ["case1", "case2", "case3", "case4"]


def channels_last(x):
    return np.ascontiguousarray(np.moveaxis(x, -3, -1))


class Case:
    def __init__(self, folder, name, dtype):
        data = load_file(folder / "network" / f"{name}.safetensors")
        self.color, self.gbuffer, self.history = (
            channels_last(data[f"input.{key}"]).astype(dtype) for key in ("color", "gbuffer", "history")
        )
        self.mask = data["input.mask"][0].astype(dtype)
        self.output = channels_last(data["output.float64"])
        self.weights = astype(read_checkpoint(folder / "checkpoints" / f"{name.split('_')[0]}.pkl"), dtype)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_image_is_the_authors(reference_data, name, dtype):
    case = Case(reference_data, name, dtype)
    image = network(case.color, case.gbuffer, case.mask, case.history, case.weights)
    assert image.dtype == dtype
    assert ratio(f"network.{np.dtype(dtype).name}", image, case.output) <= 1


@pytest.mark.parametrize("name", WARPS)
def test_warping_is_the_published(reference_data, name):
    """Motion y up and previous = p - (mx, -my) there; compared where all four taps lie inside."""
    data = load_file(reference_data / "warp" / f"{name}.safetensors")
    inputs = {k[3:]: v.astype(np.float64) for k, v in data.items() if k.startswith("in.")}
    motion = inputs["motion"][..., :2] * (-1, 1)
    height, width, _ = motion.shape
    at = follow(motion)
    inner = leads_inside(at) & (at.x + 1 < width) & (at.y + 1 < height)
    assert inner.mean() > 0.75

    warped, _ = warp(inputs["color_prev"], motion)
    assert ratio("warp.published", warped[inner], data["out.warp_no_hole"][inner]) <= 1

    depth = inputs["depth"][..., 0]
    valid = holes(
        motion,
        inputs["stencil_prev"][..., 0],
        inputs["stencil"][..., 0],
        inputs["normal_prev"],
        inputs["normal"],
        inputs["position_prev"],
        inputs["position"],
        inputs["nov"][..., 0],
        depth,
        test="paper",
    )
    # No pixel of these files meets a threshold to within rounding: none may differ.
    assert np.count_nonzero((~valid != data["out.hole"].astype(bool))[inner]) == 0

    occlusion_motion, filled = occlusion_warp(inputs["color_prev"], warped, motion, depth, valid)
    np.testing.assert_array_equal(occlusion_motion, data["out.occlusion_motion"][..., :2].astype(np.float64) * (-1, 1))
    there = [np.indices(depth.shape)[1 - i] + occlusion_motion[..., i] for i in (0, 1)]
    inner &= (there[0] >= 0) & (np.floor(there[0]) + 1 < width) & (there[1] >= 0) & (np.floor(there[1]) + 1 < height)
    assert ratio("warp.published", filled[inner], data["out.occlusion_warp"][inner]) <= 1
