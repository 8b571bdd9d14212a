"""NaN and infinities, and numbers too large for their type."""

from __future__ import annotations

import numpy as np
import pytest

from stss.cli.main import stss
from stss.frames.backends import open_backend
from stss.frames.compute_options import ComputeOptions
from stss.frames.supersampler import Supersampler
from stss.images.color import transfer
from stss.images.read_write import read_channels
from stss.sequence.reader import open_sequence
from stss.weights.file import load
from stss_cl.device import amx
from stss_cl.image_space.output import CURVE_ERROR
from stss_cl.network.network import Network
from stss_cl.options import SKIPS
from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import random as random_weights
from tests.app.conftest import write_frames  # noqa: F401 - a fixture
from tests.cl.conftest import OFTEN
from tests.cl.films import network_inputs

SIZE, NUMBERS, RENDERED = (24, 32), range(7), (0, 2, 4, 6)
FAULTS = {
    "color": ("R",),
    "base_color": ("basecolor.G",),
    "normal": ("normal.X", "normal.Y", "normal.Z"),
    "roughness": ("roughness.X",),
    "metallic": ("metallic.X",),
    "nov": ("nov.X",),
    "stencil": ("stencil.X",),
    "all of these": ("R", "G", "B", "basecolor.R", "normal.Y", "roughness.X", "metallic.X", "nov.X", "stencil.X"),
    "what may be": ("motion.X", "depth.Z", "position.Z"),
}
"""Channels of the frames by what is wrong in them; of the last ones it is not wrong (docs/decisions/0003-non-finite-input.md)."""
PLACES = {"pixel": np.s_[11:12, 13:14], "corner": np.s_[:1, -1:], "border": np.s_[-1:, :], "frame": np.s_[:, :]}
VALUES = {"nan": np.nan, "inf": np.inf, "-inf": -np.inf}


def broken(name, place, value, frames):
    """For ``write_frames``: such values in these frames."""

    def change(number, channels):
        for channel in FAULTS[name] if number in frames else ():
            if channel in channels:
                channels[channel] = channels[channel].copy()
                channels[channel][PLACES[place]] = VALUES[value]

    return change


ALIKE = CURVE_ERROR + 8 * 2.0**-24
"""Relative: the images are the same to the bit before the sRGB curve, whose host has roundings too (tests/cl/test_output.py)."""


@pytest.fixture(scope="module")
def backends():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STSS_TRUST_DEVICE", "1")
        ours = {skip: open_backend("cl", load("realtime").weights, ComputeOptions(skip=skip)) for skip in SKIPS}
        plain = load("bilinear").weights
        return ours | {"cl": open_backend("cl", plain), "ref": open_backend("ref", plain)}


@pytest.mark.parametrize(
    ("name", "place"), [*zip(FAULTS, [*PLACES] * 3, strict=False), *(("all of these", place) for place in PLACES)]
)
def test_masked_values_end_in_finite_images_alike_everywhere(write_frames, backends, name, place):  # noqa: F811
    """In an SF and in an EF, however much is left out, and on both backends."""
    value = list(VALUES)[(len(name) + len(place)) % 3]
    change = broken(name, place, value, frames=(2, 3))
    sequence = open_sequence(write_frames(NUMBERS, change=change, rendered=RENDERED, size=SIZE), "stss", non_finite="mask")
    frames = [sequence.load(number) for number in NUMBERS]
    images = {which: list(Supersampler(backend=backend)(frames)) for which, backend in backends.items()}
    assert {len(outputs) for outputs in images.values()} == {len(NUMBERS)}
    for outputs in zip(*images.values(), strict=True):
        got = dict(zip(images, outputs, strict=True))
        for output in outputs:
            assert np.isfinite(output.image).all()
            np.testing.assert_array_equal(output.valid, got["ref"].valid)
        np.testing.assert_array_equal(got["exact"].image, got["off"].image)
        np.testing.assert_allclose(got["cl"].image, got["ref"].image, rtol=ALIKE, atol=0)


REFUSED = [(name, number) for name in FAULTS if name != "what may be" for number in ((2,) if name == "color" else (3,))]
"""What, and in which frame; an EF has no colour."""


@pytest.mark.parametrize(("name", "number"), REFUSED)
def test_refused_values_are_named_and_nothing_is_written(write_frames, tmp_path, monkeypatch, name, number):  # noqa: F811
    """Frames before the broken one are whole; nothing of it, or behind it, is there."""
    monkeypatch.setenv("STSS_TRUST_DEVICE", "1")
    value = list(VALUES)[(len(name) + number) % 3]
    folder = write_frames(NUMBERS, change=broken(name, "pixel", value, (number,)), rendered=RENDERED, size=SIZE)
    command = ["run", str(folder), "-o", str(tmp_path / "out"), "--profile", "stss", "--weights", "bilinear"]
    with pytest.raises(InputError, match=rf"seq\.000{number}\.exr: channel .*: 1 non-finite values, first at \(y=11, x=13\)"):
        stss.main(command, standalone_mode=False)
    names = sorted(path.name for path in (tmp_path / "out").glob("*.exr"))
    assert names == [f"frame.{n:04d}.exr" for n in range(number)]
    for path in (tmp_path / "out").glob("*.exr"):
        assert all(np.isfinite(plane).all() for plane in read_channels(path, ["R", "G", "B"]).values())


def huge(weights, factor):
    """Weights whose first layer makes activations ``factor`` times as large."""
    return weights | {
        name: weights[name] * np.float32(factor) for name in ("conv1.conv_feature.weight", "conv1.weight") if name in weights
    }


@pytest.mark.parametrize("precision", OFTEN)
@pytest.mark.parametrize("factor", [1e6, 1e36])
def test_activations_too_large_are_no_image(device, precision, factor):
    """Half holds 65504 at most: what is larger is stored as that. Whatever comes out that is not finite is refused, and never written."""
    if precision == "bfloat16" and (why_slow := amx.missing(device)):
        pytest.skip(why_slow)
    image = Network(huge(random_weights(3), factor), device, precision)(*network_inputs(SIZE, 4))
    if precision == "half" and factor == 1e6:
        assert np.isfinite(image).all()
    if np.isfinite(image).all():
        return
    for name in ("none", "srgb"):
        with pytest.raises(ArrayError, match=r"image: \d+ non-finite"):
            transfer(name).decode(image)
