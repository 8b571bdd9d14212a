"""A camera that is jittered by parts of a pixel is found, with the jitter in motion or without."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from conformance.scenes import DEMO, render
from stss.check_sequence.report import check
from stss.check_sequence.static_positions import judge_static_geometry
from stss.frames.buffers import Buffers
from stss.sequence.reader import SequenceOptions

SIZE = (60, 96)
JITTER = ((0.0, 0.0), (0.25, -0.375), (-0.25, 0.125), (0.375, 0.25))
"""Pixels by which the camera of each frame is shifted."""
PIXEL = 0.0061
"""About an angle of one pixel, as a shift of the target at a distance of 1."""


def buffers(number, frame):
    planes = {name: getattr(frame, name) for name in frame.__dataclass_fields__}
    planes["position"] = np.where(np.isinf(frame.depth)[..., None], 1e6, frame.position)
    return Buffers(number=number, **planes)


def frames(*, jittered, moving):
    """Frames of the demo's scene; the camera stands or travels, its target shakes by the jitter. Motion is the camera's own."""
    frames_made = []
    for number in range(len(JITTER)):
        scene = DEMO if moving else replace(DEMO, camera=still(DEMO.camera))
        shaken = replace(scene, camera=shaken_by(scene.camera)) if jittered else scene
        frames_made.append(buffers(number, render(shaken, number, *SIZE)))
    return list(pairwise(frames_made))


def still(camera):
    return replace(camera, position=lambda frame: camera.position(0), target=lambda frame: camera.target(0))


def shaken_by(camera):
    """Within a frame the jitter is constant; motion leads to the previous frame, which has another jitter."""

    def target(frame):
        x, y, z = camera.target(frame)
        dx, dy = JITTER[round(frame) % len(JITTER)]
        far = np.linalg.norm(np.subtract(camera.target(frame), camera.position(frame)))
        return x + PIXEL * far * dx, y, z + PIXEL * far * dy

    return replace(camera, target=target)


@pytest.mark.parametrize("moving", [False, True])
def test_a_sound_camera_is_not_accused(moving):
    assert judge_static_geometry(frames(jittered=False, moving=moving)).jitter.lines == []


def test_a_jitter_that_motion_has_is_found_where_the_camera_stands():
    """As an offset of the projection is: the same for every pixel."""
    offsets = np.diff(JITTER, axis=0).astype(np.float32)
    pairs = [
        (before, replace(now, motion=now.motion - offset))
        for (before, now), offset in zip(frames(jittered=False, moving=False), offsets, strict=True)
    ]
    jitter = judge_static_geometry(pairs).jitter
    assert np.abs(np.array(jitter.in_motion) + offsets).max() < 1e-3
    assert any("all static geometry moves alike" in line for line in jitter.lines)


def test_check_warns_of_it(write_frames):
    def jitter(number, channels):
        dx, dy = JITTER[number % len(JITTER)]
        y, x = np.mgrid[:48, :64].astype(np.float64)
        zero = 0 * x
        return channels | {
            "position.X": x + dx, "position.Y": y + dy, "motion.X": zero, "motion.Y": zero, "stencil.X": zero,
        }  # fmt: skip

    report = check(write_frames([1, 2, 3, 4, 5], change=jitter), SequenceOptions("stss"))
    assert [f.level for f in report.findings if "jitter: positions are shifted" in f.text] == ["warning"]
    assert report.status == 1
    assert report.tables["jitter"]["against_motion"]
