# SPDX-License-Identifier: MIT
"""Run time against error: what is measured, and what is said of it."""

from __future__ import annotations

import json
import math

import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss_cl.device.discovery import DeviceError, open_device
from stss_ground.errors import InputError
from stss_lab.bench.pareto import SETTINGS, chosen_settings, measure
from stss_ref.weights import random as random_weights


@pytest.fixture(scope="module")
def points():
    try:
        device = open_device()
    except DeviceError as error:
        pytest.skip(str(error))
    settings = chosen_settings(["float32 exact", "half off"])
    return list(measure(random_weights(1), device, ["static", "cut"], settings, (16, 24), 12))


def test_exact_has_the_bits_and_half_departs(points):
    for point in points:
        assert point.exact == (point.setting.name == "float32 exact")
        assert (point.departure == 0) == point.exact
        assert math.isfinite(point.psnr)
        assert len(point.times) == len(point.full) == 4
    # A float32 network of order 1 is good to some 1e-5; half stores eleven bits.
    assert all(point.error < 1e-4 for point in points if point.exact)
    assert all(point.error > 1e-6 for point in points if not point.exact)


def test_mistakes():
    with pytest.raises(InputError, match=r"--settings: expected parts of float32 off, .* got quarter"):
        chosen_settings(["quarter"])
    with pytest.raises(InputError, match=r"--scenes: expected some of .* got 'night'"):
        next(measure({}, None, ["night"], SETTINGS, (8, 8), 12))
    with pytest.raises(InputError, match="--frames: expected at least 10, got 3"):
        next(measure({}, None, ["static"], SETTINGS, (8, 8), 3))


def test_the_command_writes_every_time(points, tmp_path):
    out = tmp_path / "found.json"
    words = ["bench", "--pareto", "--size", "24x16", "--scenes", "static", "--frames", "10", "--peers"]
    ran = CliRunner().invoke(stss, [*words, "", "--settings", "float32 exact", "--json", str(out)])
    assert ran.exit_code == 0, ran.output
    (point,) = json.loads(out.read_text())["points"]
    assert (point["scene"], point["setting"], point["same_bits"]) == ("static", "float32 exact", True)
    assert len(point["times_ms"]) == 2
