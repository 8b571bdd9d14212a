"""The motion of the background: the findings of `stss check`, and the computation from the camera."""

import numpy as np
import pytest

from conformance.scenes import SCENES, render
from stss.check_sequence.report import check
from stss.demo import demo_path, frame_channels
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.sequence.background import projection_of
from stss.sequence.camera import FAR, PLACE
from stss.sequence.reader import SequenceOptions, open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN
from tests.hostile.cases import call

SIZE = (48, 80)
FRAMES = 5
TURNS = 0.25
"""Pixels: the camera of the scene ``pan`` turns by more in each frame."""
RIGHT = 0.02
"""Pixels: how near the computed motion must be. Positions are float32: each is off by up to a thousandth of a pixel (measured: 0.002)."""


def write(folder, scene, change=lambda motion: motion):
    """A sequence of a scene whose background's motion is changed."""
    folder.mkdir()
    for number in range(FRAMES):
        view = render(SCENES[scene], number, *SIZE)
        channels = frame_channels(view, rendered=number % 2 == 0)
        missed = ~np.isfinite(view.depth)
        for name in ("motion.X", "motion.Y"):
            channels[name] = np.where(missed, change(channels[name]), channels[name]).astype(np.float32)
        write_channels(demo_path(folder, number), channels)
    return folder


def findings_of(folder, **options):
    return [
        (f.level, f.text) for f in check(folder, SequenceOptions("stss", **options)).findings if f.text.startswith("background")
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [(lambda m: 0 * m, "0"), (lambda m: 0 * m - 3, "off by"), (lambda m: 2 * m, "off by"), (lambda m: -m, "off by")],
    ids=["0", "flushed", "twice", "negated"],
)
def test_a_background_without_its_motion_is_told(tmp_path, change, words):
    ((level, text),) = findings_of(write(tmp_path / "in", "pan", change))
    assert level == "warning"
    assert text.startswith(f"background: its motion is {words}")
    assert "give --background camera" in text
    ((level, text),) = findings_of(tmp_path / "in", background="camera")
    assert (level, text[:31]) == ("note", "background: its motion is right")


@pytest.mark.parametrize("scene", ["pan", "demo", "static", "flythrough"])
def test_a_background_as_it_is_gives_no_warning(tmp_path, scene):
    assert [level for level, _ in findings_of(write(tmp_path / "in", scene))] == ["note"]


def test_a_background_that_is_not_finite_is_told(tmp_path):
    folder = write(tmp_path / "in", "pan")
    change = open_sequence(folder, "stss")
    assert findings_of(folder)[0][0] == "note"
    for number in range(FRAMES):
        buffers = change.load(number)
        channels = frame_channels(render(SCENES["pan"], number, *SIZE), rendered=True)
        channels["motion.X"] = np.where(np.isfinite(buffers.depth), channels["motion.X"], 3e38).astype(np.float32)
        write_channels(demo_path(folder, number), channels)
    assert findings_of(folder)[0][1].startswith("background: its motion is off by 3e+38 pixels")


@pytest.mark.parametrize("scene", ["pan", "demo", "flythrough"])
def test_the_camera_gives_the_background_its_motion(tmp_path, scene):
    """Near the truth, and not a bit elsewhere. The first frame, which has none before it, stays as it is."""
    write(tmp_path / "right", scene), write(tmp_path / "in", scene, lambda m: 0 * m)
    right, zero = open_sequence(tmp_path / "right", "stss"), open_sequence(tmp_path / "in", "stss", background="camera")
    for number in (0, 3, 2, 1, 4):
        a, b = right.load(number), zero.load(number)
        missed = ~np.isfinite(a.depth)
        assert np.array_equal(a.motion[~missed], b.motion[~missed])
        if number:
            assert np.abs(a.motion - b.motion)[missed].max() < RIGHT
            assert (scene != "pan") or np.abs(b.motion[missed]).max() > TURNS
        else:
            assert not b.motion[missed].any()


@pytest.mark.parametrize("scene", ["pan", "demo", "flythrough"])
def test_a_table_gives_it_where_nothing_rests(tmp_path, scene):
    """By directions alone: every surface moves, so no position says where the camera is."""
    write(tmp_path / "right", scene), write(tmp_path / "in", scene, lambda m: 0 * m)
    right, lines = open_sequence(tmp_path / "right", "stss"), [",".join([*PLACE, *FAR])]
    for number in range(FRAMES):
        far = projection_of(right.load(number)).far * [[1], [SIZE[1] / SIZE[0]], [1]]  # a share of the height, not of the width
        lines.append(",".join(map(str, [number, 0, 0, 0, *far.ravel()])))
        path = demo_path(tmp_path / "in", number)
        write_channels(
            path, {**(planes := read_channels(path, read_header(path).channels)), "stencil.X": planes["stencil.X"] * 0 + 1}
        )
    (tmp_path / "camera.csv").write_text("\n".join(lines))
    sequence = open_sequence(tmp_path / "in", "stss", camera=tmp_path / "camera.csv", background="camera")
    for number in range(1, FRAMES):
        a, b = right.load(number), sequence.load(number)
        assert np.abs(a.motion - b.motion)[~np.isfinite(a.depth)].max() < RIGHT


def test_a_run_says_where_the_motion_is_from(tmp_path):
    folder = write(tmp_path / "in", "pan", lambda m: 0 * m)
    result = call("run", folder, "-o", tmp_path / "out", *PLAIN, "--background", "camera")
    assert result.returncode == 0, result.stderr
    assert "background: its motion is computed from the camera" in result.stderr
    call("run", folder, "-o", tmp_path / "plain", *PLAIN)
    for name in ("frame.0001.exr", "frame.0003.exr"):
        attributes = read_header(tmp_path / "out" / name).attributes
        assert attributes["stss:background"] == "motion from the camera"
        assert "stss:background" not in read_header(tmp_path / "plain" / name).attributes


def test_without_a_camera_the_background_has_no_motion(write_frames):
    """A plane alone leaves the camera open: that is an error, not a guess."""

    def change(number, channels):
        channels["depth.Z"][:20] = 0

    sequence = open_sequence(write_frames([1, 2], change=change), "stss", background="camera")
    sequence.load(1)
    with pytest.raises(
        InputError,
        match=r"seq\.0002\.exr: --background camera: positions of .* in frame 2 do not give the camera: .* in one plane; let static",
    ):
        sequence.load(2)
