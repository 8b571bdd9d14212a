# SPDX-License-Identifier: MIT
"""The layers that the backend returns: right by the judge's bounds, in the table's shapes."""

import numpy as np
import pytest

from conformance.answers.expected import largest
from conformance.answers.network import expect_layers
from conformance.answers.port_arithmetic import Arithmetic
from conformance.protocol.layers import LAYERS_OF, check_layers
from stss.port import OpenCLPort
from tests.meta.samples import samples
from tests.tiers import thorough

FUSED = {"up3.conv.double_conv.2", "outc"}
"""One launch with the image, or two with it."""


@pytest.mark.parametrize("precision", ["float32", thorough("float32-direct"), thorough("half")])
@pytest.mark.parametrize("stage", ["history", "encoder", "erm", "decoder", "network"])
@pytest.mark.usefixtures("opened")
def test_layers(stage, precision, device, request):
    if device.kind == "CPU" and not device.is_cpu:  # no other test of every commit has all of these kernels
        request.getfixturevalue("unoptimised")
    case, port = samples(stage)[0], OpenCLPort(precision)
    layers = port.layers(stage, case.inputs, case.weights)
    check_layers(stage, layers, case.inputs)
    assert set(LAYERS_OF[stage]) - set(layers) <= FUSED
    exact = {name: a.astype(np.float64) for name, a in case.inputs.items()}
    right = expect_layers(stage, exact, case.weights, Arithmetic(port.dtype, port.winograd))
    assert max(largest(right[name], layer) for name, layer in layers.items()) <= 1


@pytest.mark.usefixtures("opened")
def test_the_whole_frame_hands_over_none():
    case = samples("frame")[0]
    assert OpenCLPort().layers("frame", case.inputs, case.weights) == {}
