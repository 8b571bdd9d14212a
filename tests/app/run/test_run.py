"""The main job: steps overlap, which must not change the result."""

import threading
import time
from collections import deque
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from stss.frames.backends import ReferenceBackend
from stss.images.encode import encode_exr
from stss.images.headers import read_header
from stss.images.read_write import read_channels, read_rgb
from stss.run.job import run
from stss.run.options import RunOptions
from stss.run.pipeline import FRAMES_AHEAD, overlap
from stss.sequence.profiles import load_profile
from stss.sequence.reader import open_sequence
from stss.sequence.sequence import Sequence
from stss.weights.file import BILINEAR, load
from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError
from tests.app.conftest import PLAIN
from tests.hostile.cases import call, refused

SOON = 30
"""Seconds after which something that should happen at once counts as not happening."""


@pytest.fixture(autouse=True)
def _no_thread_is_left():
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before  # a bar of the test before may still be ending


class Steps:
    """Steps that record their work, in order, and fail at a given item."""

    def __init__(self, fail=None):
        self.log, self._fail = [], fail or {}

    def step(self, name, pause=0.0):
        def do(item):
            self.log.append((name, item))
            time.sleep(pause)
            if error := self._fail.get((name, item)):
                raise error
            self.log.append((name + " end", item))
            return item

        return do

    def run(self, count, **pauses):
        *steps, end = [self.step(name, pauses.get(name, 0)) for name in ("read", "compute", "write", "done")]
        with closing(overlap(deque(range(count)), *steps)) as results:
            for item in results:
                end(item)


def test_neighbours_are_read_and_written_while_one_is_computed():
    """Three steps meet at three items; one step after the other would wait for ever."""
    meeting = threading.Barrier(3)

    def meet(at):
        return lambda item: (item == at and meeting.wait(SOON), item)[1]

    assert list(overlap(deque(range(6)), meet(4), meet(3), meet(2))) == list(range(6))


@pytest.mark.parametrize("slow", ["compute", "write"])
def test_the_look_ahead_is_bounded(slow):
    steps = Steps()
    steps.run(12, **{slow: 0.02})
    ahead = waiting = 0
    most_ahead = most_waiting = 0
    for name, _ in steps.log:
        ahead += (name == "read") - (name == "compute end")
        waiting += (name == "compute end") - (name == "write end")
        most_ahead, most_waiting = max(most_ahead, ahead), max(most_waiting, waiting)
    most = (most_ahead, FRAMES_AHEAD + 1), (most_waiting, FRAMES_AHEAD)  # with the one that is computed, or written
    assert all(value <= bound for value, bound in most)
    assert most[slow == "write"][0] == most[slow == "write"][1]


def test_an_interrupt_loses_nothing_that_was_computed():
    steps = Steps({("compute", 3): KeyboardInterrupt()})
    with pytest.raises(KeyboardInterrupt):
        steps.run(9, read=0.02, write=0.05)
    assert [item for step, item in steps.log if step == "done"] == [0, 1, 2]


class NotingBackend(ReferenceBackend):
    """Notes the thread of every call; ``spoil`` is given call and image."""

    def __init__(self, spoil=lambda call, image: image):
        super().__init__(load(BILINEAR).weights)
        self.threads, self._spoil = [], spoil

    def frame(self, inputs):
        image, valid = super().frame(inputs)
        self.threads.append(threading.get_ident())
        return self._spoil(len(self.threads) - 1, image), valid


@pytest.fixture
def sequence(write_frames):
    return open_sequence(write_frames(range(12), rendered=range(0, 12, 2), size=(16, 24)), "stss")


@pytest.fixture
def loads(monkeypatch):
    """The display frames whose pixels were read."""
    numbers, original = [], Sequence.load

    def noted(self, number, **options):
        numbers.append(number)
        return original(self, number, **options)

    monkeypatch.setattr(Sequence, "load", noted)
    return numbers


def numbers_in(out):
    return sorted(int(path.stem.split(".")[1]) for path in out.glob("frame.*"))


def test_a_frame_that_is_not_there_is_said_before_any_is_computed(write_frames, tmp_path):
    sequence = open_sequence(write_frames([0, 1, 2, 4, 6], size=(16, 24)), "stss")
    with pytest.raises(InputError, match=r"frame 3 and 1 more: not there"):
        run(sequence, tmp_path / "out", NotingBackend(), "w", RunOptions())
    assert not (tmp_path / "out").exists()


def test_frames_are_on_disk_when_they_are_reported_by_the_callers_thread(sequence, tmp_path, loads):
    out, backend, reports = tmp_path / "out", NotingBackend(), []

    def check(report):
        assert report.number in numbers_in(out)
        assert report.number % 2 == 0 or (out / "holes" / f"frame.{report.number:04d}.png").exists()
        reports.append(report)

    summary = run(sequence, out, backend, "w", RunOptions(), check)
    assert backend.threads == [threading.get_ident()] * 12
    assert loads == list(range(12))
    assert reports == summary.frames
    assert [report.number for report in reports] == list(range(12))


def test_resume_reads_only_what_is_computed(sequence, tmp_path, loads):
    out = tmp_path / "out"
    run(sequence, out, NotingBackend(), "w", RunOptions())
    whole = {path: path.read_bytes() for path in out.rglob("*.*")}
    loads.clear()
    summary = run(sequence, out, NotingBackend(), "w", RunOptions(resume=True))
    assert summary.count("kept") == 12
    assert not loads
    (out / "frame.0008.exr").unlink()
    summary = run(sequence, out, NotingBackend(), "w", RunOptions(resume=True))
    assert summary.count("kept") == 11
    assert loads == list(range(3, 9))
    assert {path: path.read_bytes() for path in out.rglob("*.*")} == whole


def test_an_error_of_the_writer_stops_the_run(sequence, tmp_path):
    """A network's NaN is found as the image is converted, in the writer."""
    backend = NotingBackend(lambda call, image: image * np.float32(np.nan) if call == 5 else image)
    with pytest.raises(ArrayError, match="image"):
        run(sequence, tmp_path / "out", backend, "w", RunOptions())
    assert numbers_in(tmp_path / "out") == list(range(5))
    assert numbers_in(tmp_path / "out" / "holes") == [1, 3]
    assert len(backend.threads) <= 5 + 1 + FRAMES_AHEAD
    assert not [path for path in (tmp_path / "out").rglob("*") if path.name.startswith(".")]


ORDER = tuple(map(float, range(16)))


def test_wrong_motion_is_seen_by_its_holes(write_frames, tmp_path):
    """More than two fifths of the static surfaces: whoever did not check the frames is told to."""
    for name, shift, advised in (("right", 0, False), ("wrong", 9, True)):
        lr = write_frames(
            range(4),
            change=lambda number, of, by=shift: of | {"motion.X": of["motion.X"] + by, "stencil.X": 0 * of["stencil.X"]},
            folder=name,
        )
        result = call("run", lr, "-o", tmp_path / f"{name}-out", *PLAIN)
        assert result.returncode == 0, result.stderr
        assert ("so many that motion or positions may be wrong: see stss check" in result.stderr) == advised, result.stderr


def test_a_cut_that_was_not_named_is_seen_by_its_holes(write_frames, tmp_path):
    """Other places from frame 5 on, which was not rendered: it is made of the shot before."""
    lr = write_frames(
        range(8),
        change=lambda number, of: of | {"position.X": of["position.X"] + 1e4 * (number > 4), "stencil.X": 0 * of["stencil.X"]},
        rendered=range(0, 8, 2),
    )
    result = call("run", lr, "-o", tmp_path / "out", *PLAIN)
    assert result.returncode == 0, result.stderr
    assert "static surfaces in frame 5 alone: a cut? Render it, and give --cuts 5\n" in result.stderr
    assert result.stderr.count("a cut?") == 1
    result = call("run", lr, "-o", tmp_path / "first", *PLAIN, "--frames", "0:4")
    assert "a cut?" not in result.stderr


def test_alpha_highlights_layers_and_metadata_come_out(write_frames, tmp_path):
    """A sequence with alpha, highlights of 10 and a light pass, a cut, and a compositor's metadata."""

    def change(number, channels):
        if "R" in channels:
            x = np.linspace(0, 1, 64) * np.ones((48, 1))
            return channels | {"A": x, "R": 10 * channels["R"], "light.R": x, "light.G": 0 * x}
        return None

    lr = write_frames(range(3, 9), change=change, rendered=(3, 5, 6, 8))
    given = {"framesPerSecond": (24000, 1001), "PixelAspectRatio": 2.0, "whiteLuminance": 80.0, "worldToNDC": ORDER}
    for path in lr.glob("*.exr"):
        give_metadata(path, given | {"adoptedNeutral": (0.25, 0.375)})
    result = call("run", lr, "-o", tmp_path / "out", *PLAIN, "--cuts", " 6", "--also", "light.R, light.G", "--metallic", "0")
    assert result.returncode == 0, result.stderr
    assert "metallic: the files have metallic.X; --metallic is not used" in result.stderr
    assert "roughness" not in result.stderr
    assert "highlights: up to" in result.stderr
    assert "4 SF, 2 EF written" in result.stderr
    shares = [read_header(path).attributes.get("stss:static-holes") for path in sorted((tmp_path / "out").glob("*.exr"))]
    ef = [float(share) for share in shares if share is not None]
    assert len(ef) == 2
    assert f"holes: {sum(ef) / 2:.1%} of the static surfaces, in 2 EF" in result.stderr
    for number in range(3, 9):
        header = read_header(tmp_path / "out" / f"frame.{number:04d}.exr")
        assert {*header.channels} == {"R", "G", "B", "A", "light.R", "light.G"}
        assert header.attributes["PixelAspectRatio"] == 2.0
        assert b"\0framesPerSecond\0rational\0" in header.path.read_bytes()  # as OpenEXR spells it
        assert header.attributes["framesPerSecond"] == (24000, 1001)
        assert header.attributes["whiteLuminance"] == 80
        assert header.attributes["adoptedNeutral"] == (0.25, 0.375)
        assert b"\0adoptedNeutral\0v2f\0" in header.path.read_bytes()
        assert header.attributes["worldToNDC"] == ORDER
        planes = read_channels(header.path, ["R", "A", "light.R", "light.G"])
        assert planes["R"].max() > 10
        assert 0 <= planes["A"].min() < planes["A"].max() <= 1
        assert np.array_equal(planes["A"], planes["light.R"])
        assert not planes["light.G"].any()


RESERVED = ("highlights", "color", "depth", "stencil", "position", "A.A", "Z")
"""Names of further channels that are those of buffers, or of planes of our own."""


def test_the_name_of_a_channel_takes_nobody_s_place(write_frames, tmp_path):
    """Passes with the names of our planes come out as they are, and the image is the one without them."""

    def change(number, channels):
        channels["R"] = 10 * channels["R"]
        ramp = np.linspace(0, 1, 64) * np.ones((48, 1))
        return channels | {name: (i + 1) * ramp for i, name in enumerate(RESERVED)}

    lr = write_frames(range(3), change=change)
    for out, also in (("plain", ()), ("out", ("--also", ",".join((*RESERVED, "R", "depth.Z"))))):
        result = call("run", lr, "-o", tmp_path / out, *PLAIN, *also)
        assert result.returncode == 0, result.stderr
    for path in sorted((tmp_path / "plain").glob("*.exr")):
        assert np.array_equal(read_rgb(path), read_rgb(tmp_path / "out" / path.name))
        planes = read_channels(tmp_path / "out" / path.name, (*RESERVED, "depth.Z"))
        assert [round(float(planes[name].max())) for name in RESERVED] == list(range(1, len(RESERVED) + 1))
        assert planes["depth.Z"].max() == 200


def test_two_channels_of_one_name_are_told_apart(write_frames, tmp_path):
    """Blender's alpha is written as A: another A beside it has no place."""
    folder = write_frames([1, 2], change=lambda _, c: c | {f"ViewLayer.Combined.{x}": c["R"] for x in "RGBA"} | {"A": c["R"]})
    text = Path(load_profile("stss").path).read_text().replace('["R", "G", "B"]', str([f"ViewLayer.Combined.{x}" for x in "RGB"]))
    (tmp_path / "other.toml").write_text(text)
    for also in "AR":
        result = call("run", folder, "-o", tmp_path / "out", *PLAIN, "--profile", tmp_path / "other.toml", "--also", also)
        refused(result, "seq.0001.exr", f"--also {also}", f"channel {also} would take the place of ViewLayer.Combined.{also}")


def linear_frames(write_frames, **metadata):
    """Frames with alpha, as Blender 5 tags them: scene-linear Rec. 709."""
    folder = write_frames(range(3), change=lambda _, c: c | {"A": 0.5 * np.ones((48, 64))}, rendered=(0, 2))
    for path in folder.glob("*.exr"):
        give_metadata(path, {"oiio:ColorSpace": "lin_rec709_scene", **metadata})
    return folder


WIDE = 0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329
"""Primaries of Rec. 2020."""


def test_an_output_is_tagged_as_the_colour_that_it_shows(write_frames, tmp_path):
    """Utility passes come without primaries, or with others: the film would change its colours at every second frame."""
    folder = write_frames(range(4), rendered=(1, 3))
    of_colour = {"chromaticities": WIDE, "adoptedNeutral": (0.25, 0.375), "PixelAspectRatio": 3.0}
    for number, path in enumerate(sorted(folder.glob("*.exr"))):
        give_metadata(path, of_colour if number % 2 else {"whiteLuminance": 80.0, "PixelAspectRatio": 2.0})
    result = call("run", folder, "-o", tmp_path / "png", *PLAIN, "--format", "png")
    assert "png: the colours' primaries are not sRGB's (0.708, 0.292, " in result.stderr
    assert call("run", folder, "-o", tmp_path / "out", *PLAIN).returncode == 0
    attributes = [read_header(path).attributes for path in sorted((tmp_path / "out").glob("*.exr"))]
    np.testing.assert_array_equal([each["chromaticities"] for each in attributes], np.float32([WIDE] * 3))
    assert [each["PixelAspectRatio"] for each in attributes] == [3.0, 2.0, 3.0]
    assert not any("whiteLuminance" in each for each in attributes)


@pytest.mark.parametrize(("rendered", "cuts", "missing", "status"), [
    ((1, 3, 5), (), [0], 0), ((0, 2, 5), (4,), [4], 0),  # nothing comes before the first rendered frame of a shot
    ((0, 3), (), [2, 5], 1), ((0,), (), [2, 3, 4, 5], 1), ((0, 3), (2,), [2, 5], 1),
])  # fmt: skip
def test_a_film_with_a_hole_is_a_finding(write_frames, tmp_path, rendered, cuts, missing, status):
    """As where every third frame was rendered: a farm would take status 0 for a whole film."""
    folder = write_frames(range(6), rendered=rendered, size=(16, 24))
    result = call("run", folder, "-o", tmp_path / "out", *PLAIN, *(["--cuts", str(cuts[0])] if cuts else []))
    made = {int(path.name.split(".")[1]) for path in (tmp_path / "out").glob("*.exr")}
    assert [n for n in range(6) if n not in made] == missing
    assert [f"left out: frame {n}: " in result.stderr for n in range(6)] == [n in missing for n in range(6)]
    assert result.returncode == status, result.stderr


@pytest.mark.parametrize("name", ["film.mp4", "out/f.####.exr", "a.PNG"])
def test_a_folder_is_not_named_like_a_file(write_frames, tmp_path, name):
    lr = write_frames([1, 2])
    result = call("run", lr, "-o", tmp_path / name, *PLAIN)
    file = name.rpartition("/")[2]
    assert (
        result.stderr
        == f"stss: Invalid value for '-o' / '--out': expected a folder for frames, found the name of a file, {file}\n"
    )
    assert result.returncode == 2
    assert list(tmp_path.iterdir()) == [lr]
    (tmp_path / "old.exr").mkdir()
    assert call("run", lr, "-o", tmp_path / "old.exr", *PLAIN).returncode == 0


def test_a_png_is_tagged_as_what_it_is(write_frames, tmp_path):
    """sRGB, for any colours of the input; the run says what a PNG lacks."""
    folder = linear_frames(write_frames, chromaticities=WIDE)
    result = call("run", folder, "-o", tmp_path / "out", *PLAIN, "--format", "png", "--also", "basecolor")
    assert result.returncode == 0, result.stderr
    assert "png: without A, basecolor.R, basecolor.G, basecolor.B; --format exr has them" in result.stderr
    assert "png: the colours' primaries are not sRGB's (0.708, 0.292, " in result.stderr
    for path in (*(tmp_path / "out").glob("*.png"), *(tmp_path / "out" / "holes").glob("*.png")):
        data = path.read_bytes()
        assert b"sRGB" in data
        assert b"gAMA" + (45455).to_bytes(4, "big") in data
    plain = call("run", linear_frames(write_frames), "-o", tmp_path / "exr", *PLAIN)
    assert "png:" not in plain.stderr


def test_a_browser_shows_the_pixels_of_each_picture(write_frames, tmp_path, ask):
    """Colour management leaves an image's levels as they are where its tags are right."""
    folder = linear_frames(write_frames)
    assert call("run", folder, "-o", tmp_path / "out", *PLAIN, "--format", "png").returncode == 0
    for name in ("frame.0000.png", "frame.0001.png", "holes/frame.0001.png"):
        page = tmp_path / "page.html"
        page.write_text(f'<img src="out/{name}">')
        script = """const image = page.querySelector("img"); await image.decode();
            const canvas = page.createElement("canvas"); canvas.width = image.naturalWidth; canvas.height = image.naturalHeight;
            const context = canvas.getContext("2d"); context.drawImage(image, 0, 0);
            return [canvas.height, canvas.width, [...context.getImageData(0, 0, canvas.width, canvas.height).data]];"""
        height, width, data = ask(page, script)
        pixels = np.array(data).reshape(height, width, 4)
        assert (pixels[..., 3] == 255).all()
        np.testing.assert_array_equal(pixels[..., :3], np.rint(255 * read_rgb(tmp_path / "out" / name)))


def give_metadata(path, metadata):
    channels = read_channels(path, read_header(path).channels)
    pixels = np.stack(list(channels.values()), axis=-1)
    path.write_bytes(encode_exr(path, tuple(channels), pixels, (), metadata))
