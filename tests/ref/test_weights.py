# SPDX-License-Identifier: MIT
"""The table of the network's tensors, the check, and the weights to start from."""

import math
import pickle
from typing import Any

import numpy as np
import pytest

from stss_ref.history import history_embedding
from stss_ref.weights import (
    BY_NAME,
    LAYERS,
    SOURCES,
    TENSORS,
    Weights,
    WeightsError,
    astype,
    check,
    colors_read,
    find_needed,
    random,
    reads_history,
    zeros,
)


def test_the_network_has_the_papers_size():
    """The table of costs is that of the paper: tests/app/test_weights_file.py."""
    assert len(TENSORS) == 92
    assert sum(math.prod(shape) for shape in TENSORS.values()) == sum(layer.parameters for layer in LAYERS)


def test_checked_weights_can_not_be_changed_by_anybody():
    tensors = {name: np.zeros(shape, np.float32) for name, shape in TENSORS.items()}
    weights = check(tensors)
    tensors["outc.bias"][0] = 1
    assert not weights["outc.bias"].any()
    with pytest.raises(ValueError, match="read-only"):
        weights["outc.bias"][0] = 1


SPOILT = np.where(np.arange(24 * 21 * 9) % 2000 == 1999, np.float32(np.nan), 0).reshape(24, 21, 3, 3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outc.bias": None}, "outc.bias: missing, of 92 tensors"),
        (dict.fromkeys(TENSORS), "conv1.conv_feature.weight: missing (and 91 more), of 92 tensors"),
        ({"outc.scale": np.zeros(1, np.float32)}, "'outc.scale': not a tensor of this network"),
        ({"outc.bias": np.zeros(13, np.float32)}, "outc.bias: expected shape (12,), got (13,)"),
        ({"outc.bias": np.zeros(12)}, "outc.bias: expected dtype float32, got float64"),
        ({"outc.bias": np.zeros(12, ">f4")}, "outc.bias: expected dtype float32, got >f4"),
        ({"conv1.conv_feature.weight": SPOILT}, "conv1.conv_feature.weight: 2 non-finite values, first at index (10, 12, 0, 1)"),
    ],
)
def test_a_defect_is_an_error_that_names_the_tensor(changes: dict[str, Any], message: str):
    with pytest.raises(WeightsError) as caught:
        check({name: tensor for name, tensor in {**zeros(), **changes}.items() if tensor is not None})
    assert str(caught.value) == message


@pytest.mark.parametrize("left", ["", "conv_feature.weight", "conv_mask.0.weight"])
def test_weights_read_the_history_if_a_kernel_of_its_last_layer_is_not_zero(left: str):
    """And what is said is so: other histories, the same feature or another."""
    made = dict(random(2))
    for name in ("conv_feature.weight", "conv_mask.0.weight"):
        made[f"lowlevelGated.{name}"] = np.zeros_like(made[f"lowlevelGated.{name}"])
    if left:
        made[f"lowlevelGated.{left}"][0, :, 1, 1] = 1e-2
    assert reads_history(made) == bool(left)
    rng = np.random.default_rng(0)
    first, second = (history_embedding(rng.random((3, 16, 16, 4), np.float32), made) for _ in range(2))
    assert np.array_equal(first, second) == (not left)


def test_the_table_says_what_each_layer_reads():
    for layer in LAYERS:
        found = [SOURCES[n] if n in SOURCES else BY_NAME[n].outputs * (BY_NAME[n].repeats // layer.repeats) for n in layer.reads]
        assert sum(found) == layer.inputs, layer.name


def test_what_the_image_needs():
    """Kernels of 0 read nothing: what only they read never runs, and what they make of it is the same for each frame."""
    weights = random(2)
    assert find_needed(weights)[:2] == (BY_NAME, set())
    for empty, never, once in (
        ({"outc"}, {layer.name for layer in LAYERS[:-1]}, {"outc"}),
        ({"KEncoder.0"}, set(), {f"KEncoder.{i}" for i in (0, 2, 4)}),
        (
            {"up1.conv.double_conv.0"},
            {n for n in BY_NAME if n.startswith(("convHis", "low", "latent", "KEn", "down2", "down3"))},
            None,
        ),
    ):
        made = find_needed(
            {n: w * (w.ndim < 4 or n.split(".conv_")[0].removesuffix(".weight") not in empty) for n, w in weights.items()}
        )
        assert BY_NAME.keys() - made.layers.keys() == never
        assert once is None or made.once == once


def test_groups_of_units_are_left_out():
    """That nobody reads, or that are 0; with what only they read, and not where one unit of a group is needed."""
    made, units = {n: w.copy() for n, w in random(2).items()}, slice(16, 48)
    for name in ("weight", "bias"):
        made[f"up1.conv.double_conv.0.{name}"][units] *= -(name == "bias") * np.sign(
            made[f"up1.conv.double_conv.0.{name}"][units]
        )
    made["up1.conv.double_conv.0.weight"][:, 96:112] = 0
    made["latentEncoder.2.weight"][:, 1:16] = 0
    layers, _, tensors = find_needed(made)
    assert {n: layer.outputs for n, layer in layers.items() if layer.outputs != BY_NAME[n].outputs} == {
        "up1.conv.double_conv.0": 32, "lowlevelGated": 16,
    }  # fmt: skip
    assert tensors["lowlevelGated.conv_mask.0.weight"].shape == (1, 96, 3, 3)
    np.testing.assert_array_equal(
        tensors["up1.conv.double_conv.2.weight"], np.delete(made["up1.conv.double_conv.2.weight"], units, axis=1)
    )
    made["up1.conv.double_conv.0.bias"][20] = 1
    made["latentEncoder.2.weight"][:, 0] = 0
    layers = find_needed(made).layers
    assert [layers[n].outputs for n in ("up1.conv.double_conv.0", "latentEncoder.0")] == [48, 48]


def test_the_second_colour_stays_with_the_tensors():
    """Checked, rounded, copied to another process; tensors alone mean the newest frame."""
    made = Weights(random(2), "detail")
    for same in (check(made), made | {"outc.bias": made["outc.bias"]}, astype(made, float), pickle.loads(pickle.dumps(made))):
        assert same.second_color == "detail"
    for other in (check(dict(made)), random(2), zeros()):
        assert other.second_color == "newest"


def test_how_many_colour_frames_the_image_depends_on():
    unread = random(2) | {name: tensor * 0 for name, tensor in random(2).items() if name.startswith("lowlevelGated")}
    assert [colors_read(weights) for weights in (unread, Weights(unread, "detail"), random(2))] == [1, 3, 3]
