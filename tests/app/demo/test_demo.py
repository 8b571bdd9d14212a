# SPDX-License-Identifier: MIT
"""The demo's files."""

import io
from contextlib import nullcontext
from threading import Event

import numpy as np
import pytest
from rich.console import Console

from conformance.scenes import DEMO, render
from stss import demo as demonstration
from stss.demo import BACKGROUND, INPUT_SAMPLES, demo_path, frame_channels, write_demo_sequence
from stss.frames.backends import ReferenceBackend
from stss.images.headers import read_header
from stss.images.read_write import read_channels
from stss_ground.errors import DeviceError, InputError
from stss_ref.weights import zeros

SIZE = (18, 32)


def test_files_hold_what_was_rendered(demo):
    """Float channels to the bit; the rest to half precision: 11 bits."""
    assert [len(read_header(demo_path(demo / "frames", n)).channels) for n in range(4)] == [19, 16, 19, 16]
    path, frame = demo_path(demo / "frames", 2), render(DEMO, 2, *SIZE, samples=INPUT_SAMPLES)
    names = read_header(path).channels
    channels, expected = read_channels(path, names), frame_channels(frame, rendered=True)
    assert set(names) == set(expected)
    for name, plane in expected.items():
        if name[0] in "RGB" or name.startswith(("basecolor", "roughness", "metallic")):
            assert np.max(np.abs(channels[name] - plane) - 2.0**-11 * np.abs(plane)) <= 0, name
        else:
            np.testing.assert_array_equal(channels[name], plane, err_msg=name)
    sky = np.isinf(frame.depth)
    assert np.all(channels["depth.Z"][sky] == np.float32(BACKGROUND))
    np.testing.assert_array_equal(channels["depth.Z"][~sky], frame.depth[~sky].astype(np.float32))


def test_an_earlier_demo_is_only_replaced_when_asked(tmp_path):
    write_demo_sequence(tmp_path, 2, (4, 8))
    (tmp_path / "frames" / "notes.txt").write_text("kept")
    with pytest.raises(InputError, match="--overwrite"):
        write_demo_sequence(tmp_path, 1, (4, 8))
    write_demo_sequence(tmp_path, 1, (4, 8), overwrite=True)
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["demo.0000.exr", "notes.txt"]
    assert [p.name for p in (tmp_path / "truth").iterdir()] == ["demo.0000.exr"]


@pytest.mark.parametrize("ends", [None, DeviceError("self-test: failed"), KeyboardInterrupt()], ids=repr)
def test_the_device_is_tested_while_the_scene_is_rendered(tmp_path, monkeypatch, ends):
    """An error or interrupt that ends the test of the device also ends the rendering, at the next frame."""
    frames, tested, start, render = 4, [], Event(), demonstration.render

    def choose(name, tell, *, trial):
        tested.append((trial, len([*tmp_path.glob("frames/*.exr")])))
        if ends:
            raise ends
        start.set()

    def second_waits(scene, number, *size, samples):
        if number == 1:
            start.wait(0.5 if ends else 30)
        return render(scene, number, *size, samples=samples)

    monkeypatch.setattr("stss.devices.selection.choose", choose)
    monkeypatch.setattr(demonstration, "render", second_waits)
    monkeypatch.setattr(demonstration, "open_backend", lambda name, weights, *_, **__: ReferenceBackend(zeros()))
    with pytest.raises(type(ends)) if ends else nullcontext():
        demonstration.demo(tmp_path, frames=frames, size=SIZE, console=Console(file=io.StringIO()))
    assert tested == [("realtime", 1)]
    assert (tmp_path / "page.html").exists() is not bool(ends)
    assert len([*tmp_path.glob("truth/*.exr")]) == (2 if ends else frames)


def test_what_stands_in_the_way_is_said_before_the_device_is_tested(tmp_path, monkeypatch):
    monkeypatch.setattr("stss.devices.selection.choose", lambda *_, **__: pytest.fail("tested"))
    write_demo_sequence(tmp_path, 1, (4, 8))
    with pytest.raises(InputError, match="--overwrite"):
        demonstration.demo(tmp_path, frames=2, size=(4, 8), console=Console(file=io.StringIO()))
