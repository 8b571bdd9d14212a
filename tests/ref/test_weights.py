# SPDX-License-Identifier: MIT
"""The table of the network's tensors, the check, and the weights to start from."""

import math
import pickle
from typing import Any

import numpy as np
import pytest

from stss_ref.weights import BY_NAME, LAYERS, SOURCES, TENSORS, Weights, WeightsError, astype, check, random, zeros


def test_the_network_has_the_papers_size():
    """The table of costs is that of the paper: tests/app/weights/test_weights_file.py."""
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
    with pytest.raises(WeightsError) as error:
        check({name: tensor for name, tensor in {**zeros(), **changes}.items() if tensor is not None})
    assert str(error.value) == message


def test_the_table_says_what_each_layer_reads():
    for layer in LAYERS:
        channels = [
            SOURCES[n] if n in SOURCES else BY_NAME[n].outputs * (BY_NAME[n].repeats // layer.repeats) for n in layer.reads
        ]
        assert sum(channels) == layer.inputs, layer.name


def test_the_second_colour_stays_with_the_tensors():
    """Checked, rounded, copied to another process; tensors alone mean the newest frame."""
    weights = Weights(random(2), "detail")
    for same in (
        check(weights),
        weights | {"outc.bias": weights["outc.bias"]},
        astype(weights, float),
        pickle.loads(pickle.dumps(weights)),
    ):
        assert same.second_color == "detail"
    for other in (check(dict(weights)), random(2), zeros()):
        assert other.second_color == "newest"
