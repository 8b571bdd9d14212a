# SPDX-License-Identifier: MIT
"""The rasteriser's clips: the choice of clips, and their files. No browser."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from stss.images.read_write import read_rgb
from stss.sequence.reader import open_sequence
from stss_ground.errors import InputError
from training.raster.make import DRAW, HELD_OUT, LIGHT, TRACKS, VALIDATION, draw_clip, jitter, main, write_clip
from training.rivals.jittered import read_offsets


def test_no_clip_shows_what_is_measured():
    """Every track has clips, the held-out ones have none, and a number always draws the same clip."""
    clips = [draw_clip(n) for n in range(64)]
    assert {c["track"] for c in clips} == {*TRACKS, *VALIDATION}
    assert not {*HELD_OUT} & {*TRACKS, *VALIDATION}
    assert not {*TRACKS} & {*VALIDATION}
    assert all(draw(7) == draw(7) for draw in DRAW.values())
    assert {c["camera"] for c in clips} == {"fly", "pan", "still"}
    assert {c["bias"] for c in clips} == {0, -1}
    with pytest.raises(InputError, match="--track candela_city: expected another"):
        main(["--assets", "none", "--track", "candela_city", "-o", "none"])
    for size in ("960 540", "0 144", "4096 144"):
        with pytest.raises(InputError, match=f"--size {size}: expected multiples of 8 from 8 to 2048"):
            main(["--assets", "none", "--size", *size.split(), "-o", "none"])


def test_clips_have_the_size_that_was_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    asked = []

    def drive(command, check):
        asked.extend(json.loads(Path(command[3]).read_text()))

    monkeypatch.setattr("subprocess.run", drive)
    monkeypatch.setattr("training.raster.make.write_clip", lambda raw, clip, out: None)
    for size in ([], ["--size", "960", "544"]):
        main(["--assets", "none", "--clips", "1", "-o", str(tmp_path), *size])
    assert [clip["size"] for clip in asked] == [[256, 144], [960, 544]]


def test_clips_of_one_track_differ_in_cameras_and_karts_but_not_in_light():
    clips = [draw_clip(n, "snowtuxpeak") for n in range(32)]
    assert {c["track"] for c in clips} == {"snowtuxpeak"}
    assert len({c["name"] for c in clips}) == len({c["start"] for c in clips}) == len(clips)
    assert {c["camera"] for c in clips} == {"fly", "pan", "still"}
    assert all(len({str(c[name]) for c in clips}) == 1 for name in (*LIGHT, "bias"))


def test_jitter_is_by_half_pixels_for_two_frames_each_or_by_halton_for_one():
    """Half pixels shift the truth too, Halton's offsets, bases 2 and 3 and begun anew after 16, do not."""
    clip = draw_clip(0) | {"frames": 18}
    half, offsets = jitter(clip, "half"), jitter(clip, "halton")
    assert half["jitter"][:9] == [(0, 0), (0, 0), (0.5, 0.5), (0.5, 0.5), (0.5, 0), (0.5, 0), (0, 0.5), (0, 0.5), (0, 0)]
    assert (half["steady"], offsets["steady"]) == (False, True)
    first = [(1 / 2, 1 / 3), (1 / 4, 2 / 3), (3 / 4, 1 / 9), (1 / 8, 4 / 9), (5 / 8, 7 / 9)]
    np.testing.assert_allclose(offsets["jitter"][:5], np.array(first) - 0.5, atol=1e-15)  # a sum of three roundings
    assert offsets["jitter"][16:] == offsets["jitter"][:2]
    assert jitter(clip, None)["jitter"] is None


def test_planes_arrive_in_the_conventions_of_the_profile(tmp_path: Path):
    """Rows go down, y up becomes z up, metres become centimetres, the sky is far; the exposure is the truth's too."""
    clip = draw_clip(0) | {"size": (4, 2), "frames": 1, "truths": (0,), "exposed": 0.5, "name": "c"}
    clip |= {"jitter": [(0.25, -0.125)], "steady": True}
    color = np.zeros((2, 4, 4), np.float32)
    color[..., :3] = 0.25
    color[0, 0] = 1.0  # the lowest row comes first
    base, normal, position, motion = (np.zeros((2, 4, 4), np.float32) for _ in range(4))
    base[:] = (0.1, 0.2, 0.3, 0.9)
    normal[:] = (0, 2, 0, 0.5)
    position[:] = (1, 2, 3, 5)
    position[1, 3] = 0
    motion[:] = (0.5, -1.5, 2, 0.75)
    for i, plane in enumerate((color, base, normal, position, motion)):
        plane.tofile(tmp_path / f"c.0.{i}")
    np.full((4, 8, 4), 0.125, np.float32).tofile(tmp_path / "c.0.truth")
    (tmp_path / "c.eyes.json").write_text(json.dumps([[0, 1, -2]]))

    write_clip(tmp_path, clip, tmp_path / "out")

    frame = open_sequence(tmp_path / "out" / "lr", "stss").load(0)
    assert frame.color is not None
    assert frame.color[:, 0, 0].tolist() == [0.5, 2]
    assert frame.normal[0, ::3].tolist() == [[0, 0, 1], [0, 0, 0]]
    assert frame.position[0, 0].tolist() == [100, -300, 200]
    assert frame.depth[0].tolist() == [5, 5, 5, np.inf]
    assert frame.motion[0, 0].tolist() == [0.5, -1.5]
    assert frame.stencil[0].tolist() == [2, 2, 2, 0]
    assert (tmp_path / "out" / "camera.csv").read_text() == "frame,x,y,z\n0,0.0000,200.0000,100.0000\n"
    assert read_offsets(tmp_path / "out" / "jitter.csv") == {0: (-0.25, 0.125)}  # the image goes against the camera
    assert (read_rgb(tmp_path / "out" / "hr" / "frame.0000.exr") == 0.25).all()
