"""Data windows: cropped renders, overscan, and windows that move; in, through a run, and out again."""

import numpy as np
import OpenImageIO as oiio  # noqa: N813
import pytest
from hypothesis import given
from hypothesis import strategies as st

from conformance.scenes import SCENES, render
from stss.check_sequence.report import check
from stss.demo import frame_channels
from stss.images.headers import read_header
from stss.images.read_write import encode_rgb, read_channels, read_rgb, write_rgb
from stss.images.windows import PixelWindow, union
from stss.sequence.profiles import load_profile
from stss.sequence.reader import SequenceOptions, open_sequence
from stss_ground.errors import InputError
from tests.app.conftest import PLAIN
from tests.hostile.cases import call

SIZE = (20, 32)
FRAMES = 4
windows = st.builds(PixelWindow, st.integers(-9, 9), st.integers(-9, 9), st.integers(1, 7), st.integers(1, 7))


def move(plane, window, to):
    """An array (H, W) of a window as an array of another, 0 outside the first."""
    result = np.zeros(to.size, plane.dtype)
    result[window.within(to)] = plane[to.within(window)]
    return result


@given(window=windows, to=windows)
def test_pixels_keep_their_place(tmp_path_factory, window, to):
    """Against a dictionary of places; of the whole image, and as a file is read, in blocks of 16 lines."""
    window = window._replace(height=3 * window.height)
    plane = np.arange(1, window.width * window.height + 1).reshape(window.size)
    there = {(window.x + x, window.y + y): plane[y, x] for y in range(window.height) for x in range(window.width)}
    got, path = move(plane, window, to), tmp_path_factory.getbasetemp() / "place.exr"
    write(path, [({"R": plane}, window)], union([window, to]))
    assert np.array_equal(read_channels(path, ["R"], to)["R"], got)
    assert got.shape == to.size
    assert all(got[y, x] == there.get((to.x + x, to.y + y), 0) for y in range(to.height) for x in range(to.width))
    assert np.array_equal(window.mask(to), got > 0)
    both = union([window, to])
    assert window.mask(both).sum() == plane.size
    assert (both.x, both.y) == (min(window.x, to.x), min(window.y, to.y))
    assert window.doubled.size == (2 * window.height, 2 * window.width)


def write(path, parts, display):
    """Parts of (channels, data window), each channel (H, W)."""
    path.parent.mkdir(exist_ok=True)
    specs = []
    for i, (channels, data) in enumerate(parts):
        spec = oiio.ImageSpec(data.width, data.height, len(channels), "float")
        spec.channelnames = tuple(channels)
        spec.x, spec.y = data.x, data.y
        spec.full_x, spec.full_y, spec.full_width, spec.full_height = display
        spec.attribute("oiio:subimagename", f"part{i}")
        specs.append(spec)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), tuple(specs)), output.geterror()
    for i, (channels, _) in enumerate(parts):
        assert i == 0 or output.open(str(path), specs[i], "AppendSubimage")
        assert output.write_image(np.ascontiguousarray(np.stack([*channels.values()], axis=-1), np.float32))
    output.close()


def frame(number, hit=None):
    """Channels of a frame of the scene ``pan``; outside ``hit`` nothing was hit, and nothing moves."""
    view = render(SCENES["pan"], number, *SIZE)
    channels = {n: np.asarray(p, np.float32) for n, p in frame_channels(view, rendered=number % 2 == 0).items()}
    if "R" in channels:
        channels["A"] = np.ones(SIZE, np.float32)
    if hit is not None:
        channels = {name: np.where(hit, plane, np.float32(0)) for name, plane in channels.items()}
    return channels


def cut(channels, canvas, data):
    return {name: move(plane, canvas, data) for name, plane in channels.items()}


CANVAS = PixelWindow(0, 0, *SIZE[::-1])


def ran(folder, out, *options):
    result = call("run", folder, "-o", out, *PLAIN, *options)
    assert result.returncode == 0, result.stderr
    return out


def pixels(path):
    planes = read_channels(path, ("R", "G", "B", "A"))
    return np.stack([*planes.values()], axis=-1)


@pytest.mark.parametrize("several", [False, True], ids=["one part", "parts"])
def test_a_cropped_frame_is_the_whole_one_with_nothing_around(tmp_path, several):
    """Its window moves, parts may have windows of their own, and one frame has none of its pixels in the picture."""
    for number in range(FRAMES):
        data = PixelWindow(2 + 3 * number, 4 - number, 17, 11 + number)
        if number == 3:
            data = PixelWindow(40, 2, 3, 3)
        inside = data.mask(CANVAS)
        whole = frame(number, inside)
        write(tmp_path / "whole" / f"a.{number:04d}.exr", [(whole, CANVAS)], CANVAS)
        color = {name: plane for name, plane in whole.items() if name in "RGBA"}
        rest = {name: plane for name, plane in whole.items() if name not in color}
        parts = [(of, data) for of in ((color, rest) if several else (whole,)) if of]
        if several and color:
            wide = PixelWindow(data.x - 1, data.y - 1, data.width + 3, data.height + 1)
            parts[0] = (color, wide)
        write(tmp_path / "cut" / f"a.{number:04d}.exr", [(cut(of, CANVAS, w), w) for of, w in parts], CANVAS)
    sequence = open_sequence(tmp_path / "cut", "stss")
    assert sequence.display == CANVAS
    for out in ("whole", "cut"):
        ran(tmp_path / out, tmp_path / f"{out}-out")
    for number in range(FRAMES):
        a, b = (tmp_path / f"{out}-out" / f"frame.{number:04d}.exr" for out in ("whole", "cut"))
        assert read_header(b).display == CANVAS.doubled
        np.testing.assert_array_equal(pixels(a), pixels(b))
    (note,) = (f.text for f in check(tmp_path / "cut", SequenceOptions("stss")).findings if f.text.startswith("data windows"))
    assert note == "data windows: cropped in frames 0, 1, 2, 3; nothing was hit outside"


@pytest.fixture(scope="module")
def overscan(tmp_path_factory):
    """The same pixels as a plain frame, and as a frame that is 4 and 3 pixels wider than the picture; frame 1 has its own window."""
    root = tmp_path_factory.mktemp("overscan")
    data, display = PixelWindow(6, -3, *SIZE[::-1]), PixelWindow(10, 0, SIZE[1] - 8, SIZE[0] - 6)
    for number in range(FRAMES):
        channels = frame(number)
        write(root / "plain" / f"a.{number:04d}.exr", [(channels, CANVAS)], CANVAS)
        write(root / "wide" / f"a.{number:04d}.exr", [(channels, data)], display)
    return root, data, display


def test_overscan_is_read_and_made_whole(overscan, tmp_path):
    root, data, display = overscan
    assert open_sequence(root / "wide", "stss").canvas == data
    for kind in ("plain", "wide"):
        ran(root / kind, tmp_path / kind)
        ran(root / kind, tmp_path / f"{kind}-png", "--format", "png")
    part = display.doubled.within(data.doubled)
    for number in range(FRAMES):
        name = f"frame.{number:04d}"
        header = read_header(tmp_path / "wide" / f"{name}.exr")
        assert set(header.windows.values()) == {data.doubled}
        assert header.display == display.doubled
        whole = read_channels(tmp_path / "wide" / f"{name}.exr", ("R",), data.doubled)["R"]
        np.testing.assert_array_equal(whole, read_channels(tmp_path / "plain" / f"{name}.exr", ("R",))["R"])
        np.testing.assert_array_equal(
            read_rgb(tmp_path / "wide-png" / f"{name}.png"), read_rgb(tmp_path / "plain-png" / f"{name}.png")[part]
        )
    for kind in ("wide", "wide-png"):
        hole, plain = (read_rgb(tmp_path / k / "holes" / "frame.0001.png") for k in (kind, "plain"))
        np.testing.assert_array_equal(hole, plain[display.within(data)])
    result = call("run", root / "wide", "-o", tmp_path / "wide", *PLAIN, "--resume")
    assert f"{FRAMES} kept" in result.stderr
    notes = [f.text for f in check(root / "wide", SequenceOptions("stss")).findings]
    assert "overscan: 4 pixels left, 4 right, 3 above, 3 below; it is read and computed, too" in notes


def test_the_picture_alone_is_compared(overscan, tmp_path):
    """With a truth that has the overscan too, and one that has not; flicker and page take the picture's inputs."""
    root, data, display = overscan
    ran(root / "wide", tmp_path / "out")
    for number in range(FRAMES):
        path = tmp_path / "out" / f"frame.{number:04d}.exr"
        image = read_rgb(path)
        assert image.shape[:2] == display.doubled.size
        for folder in ("picture", "wide"):
            (tmp_path / folder).mkdir(exist_ok=True)
        write_rgb(tmp_path / "picture" / path.name, image)
        whole = np.stack([*read_channels(path, tuple("RGB"), data.doubled).values()], axis=-1)
        wide = tmp_path / "wide" / path.name
        wide.write_bytes(encode_rgb(wide, whole, windows=(data.doubled, display.doubled)))
    for truth in ("picture", "wide"):
        page = tmp_path / f"{truth}.html"
        result = call("compare", tmp_path / "out", tmp_path / truth, "--sequence", root / "wide", "--html", page)
        assert result.returncode == 0, result.stderr
        assert " inf" in result.stdout
        assert page.exists()


def test_windows_that_lie_too_far_apart_are_refused(tmp_path):
    """Before memory is taken for the space between, in one file and in several."""
    far = PixelWindow(16380, 16380, 8, 8)
    for number in (0, 1):
        channels = {name: plane[:8, :8] for name, plane in frame(0).items()}
        write(
            tmp_path / "far" / f"a.{number:04d}.exr",
            [(channels, PixelWindow(0, 0, 8, 8) if number else far)],
            PixelWindow(0, 0, 8, 8),
        )
    with pytest.raises(InputError, match=r"data windows and display window \(0, 0\) - \(7, 7\) lie too far apart: together"):
        open_sequence(tmp_path / "far", "stss")
    write(tmp_path / "other" / "a.0000.exr", [(frame(0), CANVAS)], CANVAS)
    write(tmp_path / "other" / "a.0001.exr", [(frame(0), CANVAS)], CANVAS._replace(x=1))
    with pytest.raises(
        InputError, match=r"a\.0001\.exr: display window \(1, 0\) - \(32, 19\); expected display window \(0, 0\) - "
    ):
        open_sequence(tmp_path / "other", "stss")


def test_a_motion_in_shares_of_the_frame_is_one_of_the_picture(overscan):
    root, _, display = overscan
    shares = load_profile("stss", motion={"unit": "uv"})
    a, b = (open_sequence(root / "wide", profile).load(1) for profile in ("stss", shares))
    np.testing.assert_array_equal(b.motion, (a.motion.astype(np.float64) * display.size[::-1]).astype(np.float32))
