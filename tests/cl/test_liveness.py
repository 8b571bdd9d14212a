# SPDX-License-Identifier: MIT
"""The layers and units of the network that must run with given weights."""

import numpy as np
import pytest

from stss_cl.liveness import colors_read, find_live
from stss_ref.history import history_embedding
from stss_ref.weights import BY_NAME, LAYERS, Weights, random


@pytest.mark.parametrize("left", ["", "conv_feature.weight", "conv_mask.0.weight"])
def test_weights_read_the_history_if_a_kernel_of_its_last_layer_is_not_zero(left: str):
    """And what is said is so: other histories, the same feature or another."""
    tensors = dict(random(2))
    for name in ("conv_feature.weight", "conv_mask.0.weight"):
        tensors[f"lowlevelGated.{name}"] = np.zeros_like(tensors[f"lowlevelGated.{name}"])
    if left:
        tensors[f"lowlevelGated.{left}"][0, :, 1, 1] = 1e-2
    assert find_live(tensors).reads_history == bool(left)
    rng = np.random.default_rng(0)
    first, second = (history_embedding(rng.random((3, 16, 16, 4), np.float32), tensors) for _ in range(2))
    assert np.array_equal(first, second) == (not left)


def test_what_the_image_needs():
    """Kernels of 0 read nothing: what only they read never runs, and what they make of it is the same for each frame."""
    weights = random(2)
    assert find_live(weights)[:2] == (BY_NAME, set())
    for empty, never, once in (
        ({"outc"}, {layer.name for layer in LAYERS[:-1]}, {"outc"}),
        ({"KEncoder.0"}, set(), {f"KEncoder.{i}" for i in (0, 2, 4)}),
        (
            {"up1.conv.double_conv.0"},
            {n for n in BY_NAME if n.startswith(("convHis", "low", "latent", "KEn", "down2", "down3"))},
            None,
        ),
    ):
        live = find_live(
            {n: w * (w.ndim < 4 or n.split(".conv_")[0].removesuffix(".weight") not in empty) for n, w in weights.items()}
        )
        assert BY_NAME.keys() - live.layers.keys() == never
        assert once is None or live.once == once


def test_groups_of_units_are_left_out():
    """That nobody reads, or that are 0; with what only they read, and not where one unit of a group is needed."""
    weights, units = {n: w.copy() for n, w in random(2).items()}, slice(16, 48)
    for name in ("weight", "bias"):
        weights[f"up1.conv.double_conv.0.{name}"][units] *= -(name == "bias") * np.sign(
            weights[f"up1.conv.double_conv.0.{name}"][units]
        )
    weights["up1.conv.double_conv.0.weight"][:, 96:112] = 0
    weights["latentEncoder.2.weight"][:, 1:16] = 0
    layers, _, tensors = find_live(weights)
    assert {n: layer.outputs for n, layer in layers.items() if layer.outputs != BY_NAME[n].outputs} == {
        "up1.conv.double_conv.0": 32, "lowlevelGated": 16,
    }  # fmt: skip
    assert tensors["lowlevelGated.conv_mask.0.weight"].shape == (1, 96, 3, 3)
    np.testing.assert_array_equal(
        tensors["up1.conv.double_conv.2.weight"], np.delete(weights["up1.conv.double_conv.2.weight"], units, axis=1)
    )
    weights["up1.conv.double_conv.0.bias"][20] = 1
    weights["latentEncoder.2.weight"][:, 0] = 0
    layers = find_live(weights).layers
    assert [layers[n].outputs for n in ("up1.conv.double_conv.0", "latentEncoder.0")] == [48, 48]


def test_how_many_colour_frames_the_image_depends_on():
    unread = random(2) | {name: tensor * 0 for name, tensor in random(2).items() if name.startswith("lowlevelGated")}
    assert [colors_read(weights, find_live(weights)) for weights in (unread, Weights(unread, "detail"), random(2))] == [1, 3, 3]
