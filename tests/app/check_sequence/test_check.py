"""The check names the faults of a sequence, the most likely one first."""

import io
import json
import re

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from rich.console import Console

from stss.check_sequence.motion_convention import CHOICES
from stss.check_sequence.report import CheckReport, check, missing_buffers, print_report
from stss.images.headers import read_header
from stss.images.read_write import read_channels, write_channels
from stss.sequence import raw_frame
from stss.sequence.profiles import load_profile
from stss.sequence.reader import SequenceOptions, open_sequence
from stss.sequence.sequence import Sequence
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN, frame_channels, write_parts
from tests.hostile.cases import call


def texts(report, level):
    return [finding.text for finding in report.findings if finding.level == level]


def test_a_sound_sequence(write_frames):
    report = check(write_frames([1, 2, 3, 4, 5], rendered={1, 3, 5}), SequenceOptions("stss"))
    assert report.status == 0
    assert not texts(report, "warning")
    assert any("every second frame from 1 on" in text for text in texts(report, "note"))
    assert any("motion: fits as profile stss says" in text for text in texts(report, "note"))
    assert report.tables["channels"]["motion"]["channels"] == ["motion.X", "motion.Y"]
    assert report.tables["frames"]["2"] == {"files": ["seq.0002.exr"], "color": False, "missing": []}
    assert json.loads(report.to_json())["status"] == 0
    ratios = report.tables["reprojection"]["ratios"]
    assert set(ratios) == set(list(CHOICES)[1:])
    assert min(ratios.values()) > 2  # the right choice beats all others
    output = io.StringIO()
    print_report(report, Console(width=100, file=output))
    assert "motion: fits as profile stss says" in output.getvalue()
    assert "basecolor.G" in output.getvalue()


def test_frames_and_buffers_that_are_missing(write_frames):
    def change(number, channels):
        return {k: v for k, v in channels.items() if number % 2 or not k.startswith("motion")}

    report = check(write_frames([1, 2, 4, 7], change=change), SequenceOptions("stss"))
    lines = [finding.text for finding in report.findings]
    assert lines[0].startswith("display frames 3, 5, 6 are not there")
    assert any(text.startswith("motion: not there in frames 2, 4; every display frame needs it") for text in lines)
    assert report.status == 2


def test_one_missing_frame_and_buffers_of_the_same_frames_are_one_line_each(write_frames):
    """And no time is promised for a run that cannot begin."""

    def change(number, channels):
        return {k: v for k, v in channels.items() if number % 2 or k in ("R", "G", "B", "motion.X", "motion.Y")}

    report = check(write_frames([1, 2, 4, 5], change=change), SequenceOptions("stss"))
    first, second = texts(report, "error")
    assert first == "display frame 3 is not there: every one needs its G-buffer and motion"
    assert second.startswith(
        "normal, depth, position, stencil, nov, base_color, roughness, metallic: not there in frames 2, 4; every"
    )
    output = io.StringIO()
    print_report(report, Console(width=100, file=output))
    assert output.getvalue().splitlines()[-1] == "cannot be run: see the errors"


def test_how_many_frames_were_looked_at_is_said_and_all_may_be(write_frames):
    """A run refuses frame 13, which is none of those that are looked at."""

    def change(number, channels):
        if number == 13:
            channels["normal.X"][2, 3] = np.nan

    folder = write_frames(range(16), change=change, size=(16, 24))
    some, every = (check(folder, SequenceOptions("stss"), all_values=of) for of in (False, True))
    text = "looked at: values, motion and positions of 6 of 16 frames (0, 1, 5, 6, 10, 11); a run may refuse values of the others: --all"
    assert some.status < 2
    assert [line.startswith(text) for line in texts(some, "note") if "looked at" in line] == [True]
    assert texts(every, "error") == [
        "normal: 1 non-finite values, first in frame 13; a run refuses them; --non-finite mask takes them as 0"
    ]
    assert any(line.startswith("looked at: values of all frames") for line in texts(every, "note"))


def test_the_time_grows_as_the_number_of_frames(write_frames, monkeypatch):
    """20,000 frames took ten minutes: each asked which of all frames were rendered."""
    calls, rendered, found = [], Sequence.rendered, []
    monkeypatch.setattr(Sequence, "rendered", property(lambda self: calls.append(0) or rendered.fget(self)))
    for count in (12, 24):
        calls.clear()
        check(write_frames(range(count), folder=str(count), size=(8, 8)), SequenceOptions("stss"))
        found.append(len(calls))
    assert found[0] == found[1]


def test_no_frame_is_read_twice(write_frames, monkeypatch):
    """But the first, whose camera is judged without its colour; with no room in memory each look reads its frames anew."""
    loads, load = [], raw_frame.read_stored
    monkeypatch.setattr("stss.sequence.sequence.read_stored", lambda frame, *more, color: (
        loads.append((frame.files, color)) or load(frame, *more, color=color)
    ))  # fmt: skip
    folder = write_frames(range(8))
    report = check(folder, SequenceOptions("stss"))
    assert sorted({*loads}) == sorted(loads)
    count = len(loads)
    monkeypatch.setattr("stss.check_sequence.report.KEPT_BYTES", 0)
    assert check(folder, SequenceOptions("stss")).findings == report.findings
    assert len(loads) > 3 * count


def test_half_rate_g_buffers_are_said_first(write_frames):
    """The likeliest mistake: everything was rendered at half rate."""
    folder = write_frames([1, 3, 5, 7], change=lambda _, c: {k: v for k, v in c.items() if k != "nov.X"})
    report = check(folder, SequenceOptions("stss"))
    assert report.status == 2
    assert report.findings[0].text.startswith("frames step by 2 (1, 3, 5, ...): the display frames between are not there")
    assert "no nov and no camera" in report.findings[1].text


@pytest.mark.parametrize(
    ("rendered", "own"), [((1, 2, 4), ""), ((1, 2, 3, 5), ""), ((1, 2), ""), ((1, 2, 3), "1, 3, 5"), ((4, 5, 6, 7), "1, 3, 5")]
)
def test_colour_at_odd_frames(write_frames, rendered, own):
    """A recorder at half rate counts the frames that it writes: the first half of all numbers."""
    report = check(write_frames(range(1, 8), rendered=rendered, size=(16, 24)), SequenceOptions("stss"))
    warnings = [text for text in texts(report, "warning") if text.startswith("colour: expected every frame or every second")]
    assert len(warnings) == 1
    said = f"; if they are numbered one by one at half rate, give each the number of its display frame: {own}, ..."
    assert warnings[0].partition("; if")[1:] == (("; if", said[4:]) if own else ("", ""))


@pytest.mark.parametrize(
    ("samples", "level", "words"),
    [
        ((64, 4), "note", "every second frame from 2 on; the others are G-buffer frames, of 4 samples in place of 64"),
        (
            (4, 64),
            "warning",
            "half of the frames are G-buffer frames, of 4 samples in place of 64, 2 among them; say --rendered odd",
        ),
        ((64, 64), "note", "in every frame; a half-rate run uses every second one"),
        ((None, 4), "note", "in every frame; a half-rate run uses every second one"),
        ((64, 4, 4, 4), "warning", r"frames of different numbers of samples \(4, 64\), not every second one"),
    ],
)
def test_colours_of_few_samples_are_of_g_buffer_frames(tmp_path, samples, level, words):
    """As the extension for Blender renders them, by the metadata that Cycles writes."""
    for i in range(4):
        count = samples[i % len(samples)]
        metadata = {} if count is None else {"cycles.ViewLayer.samples": str(count)}
        write_channels(tmp_path / f"a.{i + 2:04d}.exr", frame_channels(i), metadata=metadata)
    findings = missing_buffers(open_sequence(tmp_path, "stss"), [2, 3, 4, 5])
    assert [finding.level for finding in findings] == [level]
    assert re.fullmatch(f"colour: {words}", findings[0].text)


@pytest.mark.parametrize("choice", list(CHOICES)[1::3])
def test_a_wrong_choice_of_motion_is_told(write_frames, choice):
    """Motion stored wrongly, in three of the seven ways; the report names the right convention, also where positions prove nothing."""
    swap, x, y = CHOICES[choice]
    rng = np.random.default_rng(7)

    def change(number, channels):
        motion = np.stack([channels["motion.X"], channels["motion.Y"]], axis=-1) * (x, y)
        channels["motion.X"], channels["motion.Y"] = np.moveaxis(motion[..., ::-1] if swap else motion, -1, 0)
        channels["position.X"] = rng.permuted(channels["position.X"])

    report = check(write_frames([1, 2, 3], change=change), SequenceOptions("stss"))
    (text,) = (text for text in texts(report, "warning") if text.startswith("motion: fits"))
    assert report.status == 1
    assert f"with {choice}, so profile stss seems wrong (base colour and normal of the previous frame" in text


def test_a_still_scene_tells_nothing(write_frames):
    def change(number, channels):
        channels["motion.X"] = channels["motion.Y"] = 0 * channels["nov.X"] + 0.1
        channels["position.Y"], channels["position.X"] = np.indices(channels["nov.X"].shape) + 0.1 * number

    report = check(write_frames([1, 2, 3], change=change), SequenceOptions("stss"))
    assert report.status == 0
    assert any("cannot tell whether its signs are right" in text for text in texts(report, "note"))


def planted(**changes):
    """A change for `write_frames`: of each channel, all by ``(factor, offset)``, or one pixel to a value."""

    def change(number, channels):
        for name, how in changes.items():
            plane = channels[name.replace("_", ".")]
            if isinstance(how, tuple):
                plane[...] = plane * how[0] + how[1]
            else:
                plane[2, 3] = how

    return change


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"normal_Z": (0.7, 0), "stencil_X": (0.5, 0), "nov_X": (-1, 0), "R": (-1, 0), "depth_Z": 1e10},
            [
                ("warning", "normal: 100.0% of the pixels not of unit length"),
                ("warning", "stencil: 87.5% of the pixels are not whole numbers"),
                ("warning", "nov: 100.0% of the pixels face away from the camera"),
                ("warning", "colour: 33.33% of the values negative"),
                ("note", "depth: 0.0% background, stored as: 3 far"),
            ],
        ),
        (
            {"normal_Z": (0.4, 0.5), "stencil_X": (0, 3), "motion_X": (1000, 0), "R": (100, 0), "depth_Z": 0},
            [
                ("warning", "normal: no negative component anywhere; expected -1..1"),
                ("warning", "stencil: 3 everywhere, so everything counts as moving"),
                ("warning", "motion: 100.0% of the pixels move by more than the frame"),
                ("note", "colour: largest value 180"),
                ("note", "depth: 0.0% background, stored as: 3 0 or less"),
            ],
        ),
        (
            {"stencil_X": (1, 1), "R": np.nan, "motion_X": np.nan, "position_X": np.inf},
            [
                ("warning", "stencil: 0 nowhere"),
                ("error", "color: 3 non-finite values, first in frame 1; a run refuses them; --non-finite mask"),
                ("note", "motion: 3 non-finite values, first in frame 1; taken as off screen"),
                ("note", "position: 3 non-finite values, first in frame 1; taken as a hole"),
            ],
        ),
        ({"depth_Z": (0, 0)}, [("warning", "depth: nothing was hit anywhere")]),
    ],
    ids=["directions", "ranges", "non-finite", "empty"],
)
def test_values(write_frames, changes, expected):
    report = check(write_frames([1, 2, 3], change=planted(**changes)), SequenceOptions("stss"))
    for level, text in expected:
        assert any(line.startswith(text) for line in texts(report, level)), (text, report.findings)
    assert report.status == (2 if any(level == "error" for level, _ in expected) else 1)


def test_json_has_no_infinity():
    """A background's motion may be off by one; programs that read strict JSON would stop."""
    text = CheckReport((), {"background": {"error": float("inf")}, "ratios": [1.5, float("nan")]}).to_json()
    table = json.loads(text, parse_constant=pytest.fail)
    assert (table["background"], table["ratios"]) == ({"error": "inf"}, [1.5, "nan"])


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_positions_that_are_no_numbers_are_a_warning(write_frames, value):
    """Motion too; nothing on the way prints a warning of NumPy's."""

    def change(number, channels):
        return channels | {name: value * np.ones((48, 64)) for name in ("motion.X", "motion.Y", "position.X")}

    report = check(write_frames([1, 2, 3], change=change), SequenceOptions("stss"))
    assert any(
        line.startswith("position: 9216 non-finite values, first in frame 1; taken as") for line in texts(report, "warning")
    )


def test_a_frame_that_a_farm_left_black_is_named(write_frames):
    """All channels are 0. A night without light, or a sky alone, is none."""

    def change(number, channels):
        for name, plane in channels.items():
            if number == 2 or (number == 1 and name in "RGB") or (number == 3 and name == "depth.Z"):
                plane[:] = 0

    report = check(write_frames([1, 2, 3], change=change), SequenceOptions("stss"))
    assert [line for line in texts(report, "warning") if "black" in line] == [
        "colour: black in frame 2, in which nothing was hit, unlike in others: not rendered?"
    ]


@pytest.mark.parametrize(
    ("black", "named"),
    [((1, 3, 5), ""), ((1, 2, 3, 5), "frame 2"), ((0, 2, 4), "frames 0, 2, 4"), ((1, 4), "frames 1, 4")],
)
def test_frames_that_were_rendered_for_their_g_buffer_may_be_black(write_frames, black, named):
    """Where no run takes their colour: it takes every second one, from the first on."""

    def change(number, channels):
        return channels | {name: 0 * channels[name] for name in "RGB"} if number in black else None

    found = texts(check(write_frames(range(6), change=change, size=(16, 24)), SequenceOptions("stss")), "warning")
    assert [line.partition("though")[0] for line in found if "black" in line] == (
        [f"colour: black in {named}, "] if named else []
    )


@pytest.mark.parametrize(("pace", "level"), [(3, "warning"), (0, "note")])
def test_an_object_that_moves_shows_that_motion_was_not_rendered(write_frames, pace, level):
    """As Cycles with motion blur: the Vector pass is 0, and the camera rests."""

    def change(number, channels):
        for name in ("motion.X", "motion.Y"):
            channels[name][:] = 0
        channels["stencil.X"][:] = 0
        channels["stencil.X"][10:20, 10 + pace * number : 20 + pace * number] = 3

    found = [f for f in check(write_frames([1, 2, 3], change=change), SequenceOptions("stss")).findings if "motion: 0" in f.text]
    assert [f.level for f in found] == [level]
    assert ("though an object moves by 3.0 pixels" in found[0].text) == bool(pace)


def test_what_is_no_number_in_the_background_does_not_matter(write_frames, tmp_path):
    """A run replaces it there, and a check must not say that the run refuses it."""
    channels = ("normal_X", "basecolor_R", "roughness_X", "metallic_X", "nov_X", "stencil_X", "position_X")
    folder = write_frames([1, 2, 3], change=planted(depth_Z=1e10, **dict.fromkeys(channels, np.nan)))
    assert not texts(check(folder, SequenceOptions("stss")), "error")
    assert call("run", folder, "-o", tmp_path / "out", *PLAIN).returncode == 0


def test_masked_values_are_a_warning(write_frames):
    report = check(write_frames([1, 2], change=planted(R=np.nan)), SequenceOptions("stss", non_finite="mask"))
    assert "color: 2 non-finite values, first in frame 1; masked" in texts(report, "warning")


@pytest.mark.parametrize(
    ("far", "half", "words"),
    [
        (1, True, [("note", "half precision, in steps of 0.12 cm; a pixel covers")]),
        (200, True, [("warning", "half precision, in steps of 32 cm; a pixel covers")]),
        (1, False, []),
        (2e5, False, [("warning", "single precision")]),
    ],
)
def test_steps_of_positions(write_frames, far, half, words):
    """Steps of half are 1/8 from 128 to 256, 32 from 32768 on; from 2**24 cm on those of float32 are an eighth of the smallest offset of
    a hole."""

    def change(number, channels):
        channels["position.Z"] = channels["position.Z"] * far
        channels["depth.Z"][:4] = 1e10  # the place of the sky is no position

    folder = write_frames([1, 2], change=change, half=("position.X", "position.Y", "position.Z") if half else ())
    findings = [
        f for f in check(folder, SequenceOptions("stss")).findings if f.text.startswith("position: ") and "precision" in f.text
    ]
    assert len(findings) == len(words)
    assert all(
        f.level == level and f.text.startswith(f"position: {text}") for f, (level, text) in zip(findings, words, strict=True)
    )


def test_half_positions_far_away_are_coarse_and_not_missing(write_frames):
    """So far that their steps, of 32 cm, merge neighbours."""

    def change(number, channels):
        for axis in "XYZ":
            channels[f"position.{axis}"] = channels[f"position.{axis}"] / 100 + 6e4

    warnings = texts(
        check(write_frames([1, 2], change=change, half=[f"position.{axis}" for axis in "XYZ"]), SequenceOptions("stss")),
        "warning",
    )
    assert any(text.startswith("position: half precision, in steps of 32 cm") for text in warnings), warnings


def test_lossy_compression(write_frames, monkeypatch):
    from stss.images import encode as images

    spec = images.oiio.ImageSpec

    class Lossy(spec):
        def attribute(self, name, *value):
            super().attribute(name, *(("dwaa",) if name == "compression" else value))

    monkeypatch.setattr(images.oiio, "ImageSpec", Lossy)
    monkeypatch.setattr(images, "is_whole_exr", lambda data, rows: True)  # which knows our own compression
    folder = write_frames([1, 2])
    monkeypatch.undo()
    (text,) = (t for t in texts(check(folder, SequenceOptions("stss")), "warning") if "compression" in t)
    assert text.startswith("dwaa")
    assert "motion" in text
    assert "color" not in text.replace("base_color", "")


@pytest.mark.parametrize(
    ("least", "half", "limit"), [(2046, True, 0), (4097, True, 2048), (4097, False, 0), (2**24, False, 16777216)]
)
def test_object_numbers_that_run_together_are_named(write_frames, least, half, limit):
    def change(number, channels):
        channels["stencil.X"] = channels["stencil.X"] * (least + np.arange(64) // 32)

    folder = write_frames([1, 2], change=change, half=("stencil.X",) if half else ())
    warnings = [text for text in texts(check(folder, SequenceOptions("stss")), "warning") if "run together" in text]
    assert len(warnings) == (limit > 0)
    assert all(text.startswith("stencil: up to ") and f"above {limit} run together" in text for text in warnings)


def test_the_other_eye_is_named(write_frames, tmp_path):
    """One view is read, of views in parts and of views in names, and both commands say so; a profile reads the other."""
    folder = write_frames([1, 2], size=(16, 24))
    for kind in ("parts", "names"):
        (tmp_path / kind).mkdir()
        for number in (1, 2):
            channels = read_channels(folder / f"seq.{number:04d}.exr", read_header(folder / f"seq.{number:04d}.exr").channels)
            pixels, names = np.stack([*channels.values()], axis=-1), (*channels,)
            path = tmp_path / kind / f"seq.{number:04d}.exr"
            other = np.where(np.array(names) == "R", 0.25, 1) * pixels
            if kind == "parts":
                eyes = {"left": pixels, "right": other.astype(np.float32)}
                parts = [(of, names, {"view": (eye,), "oiio:subimagename": (eye,)}) for eye, of in eyes.items()]
            else:
                twice = (*names, *(f"right.{name}" for name in names))
                attribute = oiio.TypeDesc("string[2]"), ("left", "right")
                parts = [(np.concatenate([pixels, other], axis=-1, dtype=np.float32), twice, {"multiView": attribute})]
            write_parts(path, *parts)
        note = 'views: the files have left, right; only left is read: a profile with a base and view = "right" reads another'
        output = call("run", tmp_path / kind, "-o", tmp_path / "out", *PLAIN, "--overwrite").stderr.splitlines()
        for lines in (texts(check(tmp_path / kind, SequenceOptions("stss")), "warning"), output):
            (text,) = (line for line in lines if "views" in line)
            assert text == note
        left, right = (open_sequence(tmp_path / kind, load_profile("stss", view=eye)) for eye in ("left", "right"))
        assert left.notes == right.notes == ()
        np.testing.assert_array_equal(right.load(1).color[..., 0], 0.25 * left.load(1).color[..., 0])
        np.testing.assert_array_equal(right.load(1).position, left.load(1).position)
        assert all(name.startswith("right.") for source in right.frames[1].sources.values() for name in source.names)
        with pytest.raises(InputError, match=r"seq\.0001\.exr: no view middle; expected one of left, right"):
            open_sequence(tmp_path / kind, load_profile("stss", view="middle"))
    assert not [text for text in texts(check(folder, SequenceOptions("stss")), "warning") if "views" in text]


def test_a_copy_that_was_stopped_is_named_though_few_frames_are_read(write_frames):
    folder = write_frames(range(1, 33), size=(128, 128))
    for number in (5, 20):
        path = folder / f"seq.{number:04d}.exr"
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    lines = " ".join(texts(check(folder, SequenceOptions("stss")), "error"))
    for name in ("seq.0005.exr", "seq.0020.exr"):
        assert f"{name}: truncated or corrupt: pixels are missing behind its" in lines


def test_frames_and_files_that_do_not_fit(write_frames, tmp_path):
    folder = write_frames([1, 2, 3])
    assert (
        f"--frames 8:9: expected frames of {folder}, 1 to 3"
        in texts(check(folder, SequenceOptions("stss"), frames=(8, 9)), "error")[0]
    )
    assert list(check(folder, SequenceOptions("stss"), frames=(2, 3)).tables["frames"]) == ["2", "3"]
    (folder / "seq.0002.exr").write_bytes((folder / "seq.0002.exr").read_bytes()[:-100])
    assert "truncated or corrupt" in texts(check(folder, SequenceOptions("stss")), "error")[0]
    assert check(tmp_path / "no", SequenceOptions("stss")).status == 2
    with pytest.raises(InputError, match="profile no: expected one of"):
        check(folder, SequenceOptions("no"))


def test_blender_reference(reference_data, blender_camera):
    """On real renders the check agrees with the right convention."""
    report = check(reference_data / "blender" / "lr", SequenceOptions("blender", camera=blender_camera), frames=(1, 3))
    assert report.status == 0
    assert any("motion: fits as profile blender says" in text for text in texts(report, "note"))
