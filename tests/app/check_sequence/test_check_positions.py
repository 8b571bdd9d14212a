"""Findings by static geometry: each mistake of a new user is planted in frames of an analytic scene, and named."""

import numpy as np
import pytest

from conformance.scenes import SCENES, render
from stss.check_sequence.report import check
from stss.demo import demo_path, frame_channels
from stss.images.read_write import write_channels
from stss.sequence.reader import SequenceOptions
from stss.sequence.solve_camera import solve_camera

SIZE = (54, 96)
NUMBERS = range(4)
ENCODED = "colour: looks encoded for a display"
FALLS = "depth: falls where the distance"
NDC = 'motion: seems to be in NDC, where 2 is the frame\'s side (unit = "ndc")'


@pytest.fixture(scope="module")
def rendered():
    return [frame_channels(render(SCENES["flythrough"], number, *SIZE), rendered=True) for number in NUMBERS]


@pytest.fixture
def findings_of(rendered, tmp_path):
    """The report on the frames after ``change(channels, frames, number)``: warnings, and notes."""

    def look(change=lambda channels, frames, number: None):
        for number in NUMBERS:
            channels = {name: plane.copy() for name, plane in rendered[number].items()}
            change(channels, rendered, number)
            write_channels(demo_path(tmp_path, number), {n: np.ascontiguousarray(p, np.float32) for n, p in channels.items()})
        report = check(tmp_path, SequenceOptions("stss"))
        return tuple([f.text for f in report.findings if f.level == level] for level in ("warning", "note"))

    return look


def of_motion(x, y=None):
    """``x`` and ``y`` of each component."""

    def change(channels, frames, number):
        channels["motion.X"], channels["motion.Y"] = x(channels["motion.X"]), (y or x)(channels["motion.Y"])

    return change


def upside_down(channels, frames, number):
    channels.update({name: plane[::-1] for name, plane in channels.items()})


def gbuffer_upside_down(channels, frames, number):
    channels.update({name: plane[::-1] for name, plane in channels.items() if name not in "RGB"})


def rows_of_motion(channels, frames, number):
    channels.update({name: channels[name][::-1] for name in ("motion.X", "motion.Y")})


def late(channels, frames, number):
    channels.update({name: plane for name, plane in frames[max(number - 1, 0)].items() if name not in "RGB"})


def half_rate(channels, frames, number):
    channels.update({name: plane for name, plane in frames[number // 2 * 2].items() if name not in "RGB"})


def encoded(channels, frames, number):
    for name in "RGB":
        channels[name] = np.clip(channels[name], 0, 1) ** np.float32(1 / 2.2)


def of_depth(function):
    def change(channels, frames, number):
        channels["depth.Z"] = np.where(channels["depth.Z"] < 1e9, function(channels["depth.Z"]), channels["depth.Z"])

    return change


def normal_of_a_turned_camera(channels, frames, number):
    x, y, z = (channels[f"normal.{axis}"] for axis in "XYZ")
    channels.update({"normal.X": x, "normal.Y": 0.8 * y + 0.6 * z, "normal.Z": 0.8 * z - 0.6 * y})


def bright(channels, frames, number):
    """Highlights above 1 where base colours change."""
    encoded(channels, frames, number)
    channels["R"] = np.where(channels["R"] > 0.5, 10 * channels["R"], channels["R"])


def without_numbers(channels, frames, number):
    channels["stencil.X"] *= 0


def of(buffer, function):
    """A change of all channels of a buffer."""

    def change(channels, frames, number):
        channels.update({name: function(plane) for name, plane in channels.items() if name.startswith(f"{buffer}.")})

    return change


def bytes_for_shares(channels, frames, number):
    for buffer in ("nov", "basecolor"):
        of(buffer, lambda plane: plane * 255)(channels, frames, number)


def new_numbers(channels, frames, number):
    channels["stencil.X"] = np.where(channels["stencil.X"] > 0, 10 * number + channels["stencil.X"], 0)


def far_plane(channels, frames, number):
    """A renderer that writes its camera's far plane for the background, nearer than the profile's value."""
    channels["depth.Z"] = np.minimum(channels["depth.Z"], 1e6)


def bright_lamp(channels, frames, number):
    channels.update({name: 100 * channels[name] + 2 for name in "RGB"})


def black(channels, frames, number):
    channels.update({name: 0 * plane for name, plane in channels.items() if name in "RGB" or name.startswith("basecolor")})


@pytest.mark.parametrize("change", [lambda channels, frames, number: None, bright])
def test_sound_frames(findings_of, change):
    warnings, notes = findings_of(change)
    assert not warnings
    assert any(text.startswith("motion: right to ") for text in notes)
    assert any(text.startswith("holes: ") for text in notes)


def test_a_file_upside_down_is_one_mistake(findings_of):
    """The signs of motion, and the background's, are wrong by the same cause."""
    warnings, notes = findings_of(upside_down)
    assert [text.startswith("motion: seems to be right if the file is upside down") for text in warnings] == [True], warnings
    assert not [text for text in notes if text.startswith("motion: ")]


def test_normals_from_0_to_1_are_one_mistake(findings_of):
    warnings, _ = findings_of(of("normal", lambda n: n / 2 + 0.5))
    assert [text for text in warnings if text.startswith("normal")] == [
        "normal: no negative component anywhere; expected -1..1, it looks like 0..1"
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((of_motion(lambda m: m + 0.5), encoded), ("motion: seems to be half a pixel too far to the lower right", ENCODED)),
        ((of_motion(lambda m: m * 2 / SIZE[1], lambda m: -m * 2 / SIZE[0]),), (f"{NDC}, with y up",)),
        ((of_motion(lambda m: m / SIZE[1], lambda m: m / SIZE[0]),), ("motion: seems to be in UV, where 1 is the frame's side",)),
        (
            (of_motion(lambda m: m * SIZE[1], lambda m: -m * SIZE[0]),),
            ("motion: seems to be in pixels, and taken for UV", ", with y up"),
        ),
        (
            (of_motion(lambda m: m * SIZE[1] / 2, lambda m: m * SIZE[0] / 2),),
            ("motion: seems to be in pixels, and taken for NDC",),
        ),
        ((of_motion(lambda m: m * 2),), ("motion: seems to be twice too long",)),
        ((of_motion(lambda m: m * 0),), ("motion: seems to be 0, though the camera moves",)),
        ((of_motion(lambda m: -m), of_depth(lambda z: 20 / z)), ("motion: seems to be from the previous frame", FALLS)),
        ((of_motion(lambda m: m / 3),), ("motion: ", "true x = 3")),
        ((upside_down,), ("motion: seems to be right if the file is upside down",)),
        ((rows_of_motion, normal_of_a_turned_camera), ("motion: ", "normal: rotated against positions")),
        ((gbuffer_upside_down,), ("it looks as if the G-buffer is upside down",)),
        ((late,), ("it looks as if the G-buffer is that of the previous frame",)),
        ((half_rate,), ("position: frames 1, ",)),
        ((of_depth(lambda z: 1 - 20 / z),), ("depth: ",)),
        ((without_numbers,), ("stencil: 0 on ", "of the surfaces, though their motion")),
        (
            (bytes_for_shares, new_numbers, bright_lamp),
            (
                "nov: ",
                "of the pixels outside 0 to 1",
                "have a number that the previous frame lacks",
                "lower the exposure",
            ),
        ),
        (
            (black, of("normal", lambda n: -n), of("stencil", lambda s: s - 1)),
            (
                "nothing above 0",
                "base_color: 0 everywhere",
                "nov: ",
                "of the pixels are negative; expected 0 for static geometry",
            ),
        ),
        (
            (of("position", lambda p: 0 * p), of("normal", lambda n: 0 * n), far_plane),
            ("position: the same at", "normal: 0 everywhere", "at the largest depth, 1e+06, and without a normal"),
        ),
    ],
)
def test_each_mistake_is_named(findings_of, changes, words):
    def change(*planes):
        for each in changes:
            each(*planes)

    warnings, _ = findings_of(change)
    for text in words:
        assert any(text in line for line in warnings), warnings
    assert not any(text.startswith(ENCODED) for text in warnings) or ENCODED in words


@pytest.mark.parametrize("scene", ["flythrough", "demo"])
def test_positions_relative_to_the_camera_are_named_and_motion_is_not(tmp_path, scene):
    """With a turning camera or a fixed one; if the camera really is at the origin, a wrong motion is still found."""
    for number in NUMBERS:
        channels = frame_channels(render(SCENES[scene], number, *SIZE), rendered=True)
        position = np.stack([channels[f"position.{axis}"] for axis in "XYZ"], axis=-1)
        solved = solve_camera(np.where(channels["depth.Z"] < 1e9, channels["depth.Z"], np.inf), position)
        channels |= {
            f"position.{axis}": (position[..., i] - solved.pose.position[i]).astype(np.float32) for i, axis in enumerate("XYZ")
        }
        write_channels(demo_path(tmp_path, number), channels)
    warnings = [f.text for f in check(tmp_path, SequenceOptions("stss")).findings if f.level == "warning"]
    assert any("relative to the camera" in text for text in warnings), warnings
    assert not any(text.startswith("motion") and "relative to the camera" not in text for text in warnings), warnings


def test_a_camera_at_the_origin_blames_no_position(tmp_path):
    for number in NUMBERS:
        channels = frame_channels(render(SCENES["pan"], number, *SIZE), rendered=True)
        position = np.stack([channels[f"position.{axis}"] for axis in "XYZ"], axis=-1)
        solved = solve_camera(np.where(channels["depth.Z"] < 1e9, channels["depth.Z"], np.inf), position)
        channels |= {
            f"position.{axis}": (position[..., i] - solved.pose.position[i]).astype(np.float32) for i, axis in enumerate("XYZ")
        }
        channels["motion.X"] = -channels["motion.X"]
        write_channels(demo_path(tmp_path, number), channels)
    warnings = [f.text for f in check(tmp_path, SequenceOptions("stss")).findings if f.level == "warning"]
    assert any(text.startswith("motion: seems to be ") for text in warnings)
    assert not any("relative to the camera" in text for text in warnings)
