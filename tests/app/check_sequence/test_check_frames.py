"""An engine's frames in memory are checked as its files would be."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import stss
from conformance.scenes import SCENES, render
from stss.check_sequence.motion_convention import judge_motion
from stss.check_sequence.report import check
from stss.check_sequence.value_statistics import Values
from stss.demo import demo_path, frame_channels
from stss.images.read_write import write_channels
from stss.sequence.conventions import normal_dot_view
from stss.sequence.reader import SequenceOptions, open_sequence
from stss_ground.errors import InputError

NUMBERS = range(4)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("frames")
    for number in NUMBERS:
        write_channels(
            demo_path(path, number), frame_channels(render(SCENES["flythrough"], number, 54, 96), rendered=number % 2 == 0)
        )
    return path


@pytest.fixture(scope="module")
def frames(folder):
    sequence = open_sequence(folder, "stss")
    return [sequence.load(number) for number in NUMBERS]


def test_the_lines_are_those_of_files(folder, frames):
    """All findings, except those that only files can have."""
    lines = stss.check_frames(frames)
    assert {level for level, _ in lines} == {"note"}
    of_files = [f.text.replace("profile stss", "its profile") for f in check(folder, SequenceOptions("stss")).findings]
    assert {text for _, text in lines} <= {*of_files}
    assert any(text.startswith("motion: right to ") for _, text in lines)


def test_a_frame_of_another_time_is_named(frames):
    """A farm's task that rendered an older version, or a cut that nobody named: the median over all frames is right."""
    lines = stss.check_frames([*frames[:3], replace(frames[0], number=3)])
    text = "motion: wrong in frame 3 alone, by positions: a cut there (--cuts), or a frame of another version?"
    assert ("warning", text) in lines


@pytest.mark.parametrize(("lights", "named"), [
    ({0: 1, 2: 0, 4: 1}, "frame 2"), ({0: 1, 40: 0, 80: 0, 120: 1}, "frames 40, 80"),  # a check looks at few frames
    ({0: 0, 1: 1, 2: 1}, "frame 0"), ({0: 1, 2: 1, 4: 0}, "frame 4"),  # an engine's first frame
    ({0: 1, 2: 0.7, 4: 0.5, 6: 0.2, 8: 0}, ""), ({0: 0, 2: 0.3, 4: 1}, ""), ({0: 1, 60: 0.1, 120: 0}, ""),  # fades
    ({0: 0, 2: 0}, ""), ({0: 1, 120: 0}, ""),
])  # fmt: skip
def test_a_colour_that_was_not_rendered_is_named(frames, lights, named):
    """Black over surfaces with a base colour. A fade gets there by steps; of frames far apart nobody knows."""
    values = Values()
    for number, light in lights.items():
        values.add_buffers(replace(frames[0], number=number, color=light * frames[0].color))
    text = f"colour: black in {named}, though surfaces are seen, unlike in frames beside: not rendered?"
    assert [line for _, line in values.buffer_lines() if "black" in line] == ([text] if named else [])


TURN = np.float32([[1, 0, 0], [0, np.cos(0.14), np.sin(0.14)], [0, -np.sin(0.14), np.cos(0.14)]])
"""Of a camera that looks down by 8 degrees."""
FIREFLY = np.zeros((54, 96, 3), np.float32)
FIREFLY[20, 30] = 1e20
MISTAKES = {
    "motion: seems to be from the previous frame": lambda f: replace(f, motion=-f.motion),
    "motion: seems to be in UV": lambda f: replace(f, motion=f.motion / np.float32([96, 54])),
    "stencil: 0 on ": lambda f: replace(f, stencil=0 * f.stencil),
    "normal: no negative component": lambda f: replace(f, normal=f.normal / 2 + 0.5),
    "normal: rotated against positions": lambda f: replace(f, normal=f.normal @ TURN),
    "nov: ": lambda f: replace(f, nov=normal_dot_view(f.normal, f.position, np.zeros(3))),  # of a matrix from camera to world
    "background: its motion is 0": lambda f: replace(f, motion=np.where(np.isfinite(f.depth)[..., None], f.motion, 0)),
    "base_color: looks encoded": lambda f: replace(f, base_color=f.base_color ** np.float32(1 / 2.2)),
    "colour: 100% of the surfaces' values above 1": lambda f: replace(f, color=None if f.color is None else 100 * f.color),
    "colour: up to 1e+20, beyond 65504": lambda f: replace(f, color=None if f.color is None else np.fmax(f.color, FIREFLY)),
    "motion: 100.0% of the pixels move by more than the frame, or non-finite": lambda f: replace(f, motion=np.nan * f.motion),
    "colour: looks encoded": lambda f: f if f.color is None else replace(f, color=f.color.clip(0, 1) ** np.float32(1 / 2.2)),
}


@pytest.mark.parametrize("said", MISTAKES)
def test_each_mistake_is_a_warning_and_comes_first(frames, said):
    lines = stss.check_frames(map(MISTAKES[said], frames))
    assert lines[0][0] == "warning"
    assert any(level == "warning" and text.startswith(said) for level, text in lines), lines


YAW = 0.12
"""Radians: the camera of `level` is nearly along an axis, as in many scenes."""
WORLD = np.float32([[np.cos(YAW), 0, np.sin(YAW)], [np.sin(YAW), 0, -np.cos(YAW)], [0, 1, 0]])
"""Takes (x right, y forward, z up) to a world with y up."""


@pytest.fixture(scope="module")
def level():
    """A level camera that moves sideways at a steady pace: floor and sky, of which most look alike in all frames. The world has y up."""
    rows = []
    for number in NUMBERS:
        view = render(SCENES["sky"], number, 90, 160)
        planes = {name: getattr(view, name) for name in view.__dataclass_fields__}
        hit = np.isfinite(view.depth)[..., None]
        planes |= {"position": np.where(hit, view.position @ WORLD, 1e7), "normal": view.normal @ WORLD}
        rows.append(stss.Buffers(number=number, **{name: np.float32(plane) for name, plane in planes.items()}))
    return rows


def warnings_of(frames):
    return [text for level, text in stss.check_frames(frames) if level == "warning"]


@pytest.mark.parametrize("plane", ["position", "depth", "normal", "stencil"])
@pytest.mark.parametrize("scene", ["frames", "level"])
def test_a_plane_of_the_frame_before_is_named_alone(request, plane, scene):
    """As a constant buffer that is updated after the draw leaves it. A floor that looks alike in both frames hides nothing."""
    mixed = [replace(now, **{plane: getattr(before, plane)}) for before, now in pairwise(request.getfixturevalue(scene))]
    other = "depth" if plane == "position" else "position"
    assert f"{plane}: that of the previous frame, by {other}; expected planes of one moment" in warnings_of(mixed)
    assert len([text for text in warnings_of(mixed) if "jitter" not in text]) == 1


@pytest.mark.parametrize("scene", ["object", "interface", "pan"])
def test_where_the_camera_rests_nothing_is_late(scene):
    """Most silhouettes are then those of both frames."""
    views = [render(SCENES[scene], number, 54, 96) for number in NUMBERS]
    rows = [stss.Buffers(n, **{of: np.float32(plane) for of, plane in vars(view).items()}) for n, view in enumerate(views)]
    assert not [text for text in warnings_of(rows) if "previous frame" in text]


def test_objects_with_an_outline_are_not_late(frames):
    """Numbers that reach a pixel too far have edges where the previous frame had them, on one side of each object."""

    def widen(stencil):
        return np.max([np.roll(stencil, shift, (0, 1)) for shift in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))], axis=0)

    assert not [text for text in warnings_of(replace(f, stencil=widen(f.stencil)) for f in frames) if "previous frame" in text]


def turned(degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.float32([[c, 0, s], [0, 1, 0], [-s, 0, c]])


NORMALS = {
    "normal: in the camera's space": lambda n: n @ WORLD.T @ np.float32([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "normal: rotated against positions, or mirrored, by 60 degrees": lambda n: n @ turned(60),
    "normal: rotated against positions, or mirrored, by 1": lambda n: n * np.float32([-1, 1, 1]),
}


@pytest.mark.parametrize("said", NORMALS)
def test_normals_of_walls_are_compared_as_well_as_those_of_the_floor(level, said):
    """The floor's normal is the same in all of these spaces."""
    texts = warnings_of(replace(f, normal=NORMALS[said](f.normal)) for f in level)
    assert [text.startswith(said) for text in texts if text.startswith("normal")] == [True], texts


def test_normals_that_maps_and_shading_bend_are_right(level):
    """By 20 degrees to all sides, in a pattern that is fixed to the surfaces, and on a wall by 4 degrees to one side."""

    def bend(frame):
        waves = np.sin(frame.position / 5 + np.roll(frame.position / 7, 1, axis=-1))
        normal = frame.normal + 0.35 * waves + 0.07 * (np.abs(frame.normal[..., 2:]) > 0.5) * np.float32([1, 0, 0])
        unit = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        return replace(frame, normal=np.float32(np.where(np.isfinite(frame.depth)[..., None], unit, 0)))

    assert not [text for text in warnings_of(map(bend, level)) if text.startswith("normal")]


@pytest.mark.parametrize("without", [0, 1])
def test_an_object_that_enters_or_leaves_is_no_new_number(frames, without):
    """In the only pair of a short sequence, too."""
    pair = [replace(f, stencil=0 * f.stencil) if i == without else f for i, f in enumerate(frames[:2])]
    assert not [text for _, text in stss.check_frames(pair) if "the previous frame lacks" in text]


def test_a_scene_may_show_no_side_with_a_negative_normal(frames):
    lines = stss.check_frames(replace(f, normal=np.abs(f.normal)) for f in frames)
    assert not [text for _, text in lines if "no negative component" in text]


def test_frames_that_tell_nothing_are_refused(frames):
    apart = [frames[0], frames[2]]
    cut = [frames[0], replace(frames[1], cut=True)]
    for row in ([], frames[:1], apart, cut):
        with pytest.raises(InputError, match="frames: expected two of successive numbers"):
            stss.check_frames(row)
    with pytest.raises(InputError, match="frame 1: depth: expected an array"):
        stss.check_frames([frames[0], replace(frames[1], depth=None)])


def test_a_motion_is_judged_where_each_choice_leads_into_the_frame():
    """Where one leads off it, the border's colour would speak against the choice."""
    height, width, far = 32, 40, 6
    random = np.random.default_rng(0)
    three, one = (random.random((height, width, *n), np.float32) for n in ((3,), ()))
    motion = np.broadcast_to(np.float32((far, 0)), (height, width, 2))
    frame = stss.Buffers(1, None, motion, three, one + 1, three, one, one, three, one, one)
    before = replace(frame, number=0, base_color=random.random(three.shape, np.float32))
    assert judge_motion([(before, frame)]).pixels == (height - 2 * far) * (width - 2 * far)


def orthographic(number, *, size=(48, 80)):
    """A field of hills below a camera without perspective that slides past it; a pixel covers 2 cm."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    u, v = x + 1.5 * number, y + 0.5 * number
    depth = 200 + 20 * np.sin(u / 9) + 15 * np.cos(v / 7)
    normal = np.stack([10 / 9 * np.cos(u / 9), -15 / 14 * np.sin(v / 7), -np.ones(size)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    base = 0.5 + 0.3 * np.sin(u / 3)[..., None] * [1, 0.5, 0.2] + 0.1 * np.cos(v / 2)[..., None]
    planes = {
        "color": base * (0.2 - 0.8 * normal[..., 2:]),
        "motion": np.full((*size, 2), (1.5, 0.5)),
        "normal": normal,
        "depth": depth,
    }
    planes |= {"position": np.stack([2 * u, 2 * v, depth], axis=-1), "nov": -normal[..., 2], "base_color": base}
    planes |= {"stencil": 0 * u, "roughness": 0.5 + 0 * u, "metallic": 0 * u}
    return stss.Buffers(number, **{name: np.float32(plane) for name, plane in planes.items()})


def test_an_orthographic_camera_has_right_depths():
    """Its positions show one distance for all; noise in it was taken for depths that fall."""
    rows = [orthographic(number) for number in NUMBERS]
    assert not warnings_of(rows)
    assert any("motion: seems" in text for text in warnings_of(replace(row, motion=-row.motion) for row in rows))
