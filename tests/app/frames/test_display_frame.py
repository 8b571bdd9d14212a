"""Checks and conversion of a display frame: the fast ways against the plain rule, for every kind of array."""

import threading
import time
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

import stss
from stss.frames import display_frame
from stss.frames import static_holes as module_of_holes
from stss.frames.carried_planes import HIGHLIGHTS, highlights
from stss.frames.display_frame import make_display_frame
from stss.images import color as colors
from stss.images.color import transfer
from stss.sequence import conventions
from stss.sequence.camera import CameraPose
from stss_ground import cores
from stss_ground.cores import for_blocks
from stss_ground.errors import InputError
from stss_ref.arrays import ArrayError
from stss_ref.depth import normalise_depth

VALUES = [0, -0.0, 1, -1, np.nan, np.inf, -np.inf, 65504, 1e-6, 0.0031308, 1.003, -0.003, 1.005, -0.005, 2, 2.01, -2.01]


def read_only(array):
    array.setflags(write=False)
    return array


LAYOUTS = {
    "C": np.ascontiguousarray,
    "F": np.asfortranarray,
    "backwards": lambda a: a[::-1, ::-1].copy()[::-1, ::-1],
    "a part": lambda a: np.repeat(np.repeat(a, 2, 0), 3, 1)[::2, ::3],
    "channel by channel": lambda a: np.moveaxis(np.ascontiguousarray(np.moveaxis(a, -1, 0)), 0, -1),
    "read-only": read_only,
    "without a hidden value": lambda a: np.ma.array(a, mask=False),
}


def buffers_of(size, kind="float32", layout="C", values=(), seed=0):
    """A frame of random numbers in [0, 1] with ``values`` among them."""
    rng = np.random.default_rng(seed)

    def plane(*channels):
        numbers = rng.uniform(0.1, 1, (*size, *channels))
        if len(values):
            numbers = np.where(rng.random(numbers.shape) < 0.3, rng.choice(values, numbers.shape), numbers)
        return LAYOUTS[layout](numbers.astype(kind))

    depth = plane().astype(np.promote_types(kind, np.float32))
    planes = {"color": 3, "motion": 2, "normal": 3, "position": 3, "base_color": 3, "stencil": 0, "nov": 0, "roughness": 0}
    arrays = {name: plane(n) if n else plane() for name, n in planes.items()}
    return stss.Buffers(number=0, depth=depth, metallic=plane(), carried={"A": plane(1)}, **arrays)


def same_bits(got, want):
    """The same numbers, NaN at the same places, and the same signs of zeros, in a plain float32 array."""
    want = want.astype(np.float32)
    assert type(got) is np.ndarray
    assert got.flags.c_contiguous
    assert got.dtype == np.float32
    np.testing.assert_array_equal(got, want)
    assert ((np.signbit(got) == np.signbit(want)) | np.isnan(want)).all()


def displayed(color, name):
    """The formula of spec 9, on the whole image."""
    color = color.astype(np.float64)
    c = np.where(color >= 0, np.where(color < 1, color, 1), 0)  # np.clip loses the sign of -0 in NumPy 2.0; NaN compares as False
    return c if name == "none" else np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of a few rows, and threads on a machine with one core too."""
    for module in (display_frame, colors):
        monkeypatch.setattr(module, "BLOCK", 64)
    monkeypatch.setattr(cores, "available_threads", lambda: 3)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["float32", "float16", "float64", ">f4"])
def test_a_display_frame_has_the_bits_of_the_plain_formula(kind, layout):
    """In many blocks as in one, for all sizes and layouts, and whatever numbers are in them."""
    for size in [(1, 1), (1, 7), (37, 5), (16, 24), (3, 131)]:
        for name, values in (("srgb", ()), ("srgb", VALUES), ("none", VALUES)):
            buffers = buffers_of(size, kind, layout, values)
            plain = {name: np.array(plane) for name, plane in vars(buffers).items() if isinstance(plane, np.ndarray)}
            color = plain["color"]
            with np.errstate(all="ignore"):
                frame = make_display_frame(buffers, transfer(name), "scale")
                same_bits(frame.color, displayed(color, name))
                depth, unit = normalise_depth(plain["depth"], "scale"), (plain["roughness"], plain["metallic"])
                channels = [*np.moveaxis(plain["normal"], -1, 0), depth, *unit, *np.moveaxis(plain["base_color"], -1, 0)]
                same_bits(frame.gbuffer, np.stack([channel.astype(np.float32) for channel in channels], axis=-1))
                for plane in ("motion", "nov", "stencil", "position"):
                    same_bits(getattr(frame, plane), plain[plane])
                same_bits(frame.carried["A"], np.array(buffers.carried["A"]))
                given = buffers.color  # NumPy subtracts from a masked array of half in float64
                above = np.where(given > 1, np.minimum(given, 65504) - 1, 0)
            assert (HIGHLIGHTS in frame.carried) == (name == "srgb" and bool(above.any()))
            if HIGHLIGHTS in frame.carried:
                same_bits(frame.carried[HIGHLIGHTS], above)


@pytest.mark.usefixtures("small_blocks")
def test_one_bright_pixel_is_a_highlight():
    """In whichever block it lies; all other pixels have none."""
    for row in range(16):
        buffers = buffers_of((16, 24))
        buffers.color[row, 3, 1] = 4
        expected = np.zeros_like(buffers.color)
        expected[row, 3, 1] = 3
        np.testing.assert_array_equal(make_display_frame(buffers, transfer("srgb"), "scale").carried[HIGHLIGHTS], expected)
        assert HIGHLIGHTS not in make_display_frame(buffers, transfer("none"), "scale").carried
        assert not make_display_frame(replace(buffers, color=None), transfer("srgb"), "scale").carried


@pytest.mark.parametrize("copy", [True, False])
def test_planes_are_shared_only_without_copies(copy):
    """And only those that are float32 and contiguous already."""
    buffers = buffers_of((16, 24))
    buffers = replace(buffers, nov=buffers.nov.astype(np.float64), stencil=np.asfortranarray(buffers.stencil))
    frame = make_display_frame(buffers, transfer("srgb"), "scale", copy=copy)
    given = [plane for plane in (*vars(buffers).values(), *buffers.carried.values()) if isinstance(plane, np.ndarray)]
    made = {name: plane for name, plane in (*vars(frame).items(), *frame.carried.items()) if isinstance(plane, np.ndarray)}
    shared = {name for name, plane in made.items() if any(np.shares_memory(plane, other) for other in given)}
    assert shared == (set() if copy else {"motion", "position"})


@pytest.mark.parametrize("in_place", [True, False])
def test_blocks_of_a_conversion_do_not_show(monkeypatch, in_place):
    """With pixels that are in no data window, motion as a share of the frame, and NoV from a camera."""
    buffers, random = buffers_of((16, 24)), np.random.default_rng(1)
    outside, camera = random.random((16, 24)) < 0.3, CameraPose(np.zeros(3))
    profile = stss.load_profile("stss", motion={"unit": "uv"})
    done = []
    for block in (1 << 15, 3 * 24):
        monkeypatch.setattr(conventions, "BLOCK", block)
        names = ("motion", "normal", "depth", "position", "stencil", "base_color", "roughness", "metallic")
        planes = {name: np.array(getattr(buffers, name)).reshape(16, 24, -1) for name in names}
        depth = conventions.to_specification(planes, profile, camera, outside=outside, in_place=in_place)
        done.append({**planes, "depth": depth})
    assert (done[0]["depth"][outside] == np.inf).all()
    for name, plane in done[0].items():
        np.testing.assert_array_equal(plane, done[1][name])


@pytest.mark.usefixtures("small_blocks")
def test_static_holes_are_counted_in_every_block(monkeypatch):
    monkeypatch.setattr(module_of_holes, "BLOCK", 3 * 24)
    buffers, random = buffers_of((16, 24)), np.random.default_rng(1)
    stencil, valid = np.float32(random.random((16, 24)) < 0.5), random.random((16, 24)) < 0.9
    static = stencil == 0
    assert module_of_holes.static_holes(stencil, buffers.normal, valid) == (static & ~valid).sum() / static.sum()
    assert module_of_holes.static_holes(np.ones_like(stencil), buffers.normal, valid) is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_an_engines_planes_stay_as_they_are(monkeypatch, dtype):
    """They may be read-only, and the frame does not change with them; where nothing was hit it differs from them."""
    monkeypatch.setattr(conventions, "BLOCK", 5 * 24)
    names = ("color", "motion", "normal", "depth", "position", "stencil", "base_color", "roughness", "metallic")
    buffers = buffers_of((16, 24))
    given = {name: np.array(getattr(buffers, name), dtype) for name in names}
    given["depth"][3:9] = np.inf
    before = {name: plane.copy() for name, plane in given.items()}
    for plane in given.values():
        read_only(plane)
    frame = stss.convert(1, given, camera=np.zeros(3))
    whole = stss.convert(1, {name: np.float32(plane) for name, plane in given.items()}, camera=np.zeros(3))
    assert not frame.base_color[3:9].any()
    for name, plane in before.items():
        np.testing.assert_array_equal(given[name], plane)
        assert not np.shares_memory(getattr(frame, name), given[name])
        assert getattr(frame, name).dtype == np.float32
        np.testing.assert_array_equal(getattr(frame, name), getattr(whole, name))


@pytest.mark.parametrize(
    "name", ["motion", "normal", "position", "stencil", "nov", "base_color", "roughness", "metallic", "color"]
)
def test_a_plane_that_was_not_checked_is_neither_cut_nor_repeated(name):
    """A larger one would lose rows without a word, one of a single row would stand for all."""
    buffers = buffers_of((16, 24))
    plane = getattr(buffers, name)
    for wrong in (plane[:1], plane[:, :1], np.concatenate([plane, plane]), plane[..., :1, None]):
        with pytest.raises(ArrayError, match=f"{name}: expected shape"):
            make_display_frame(replace(buffers, **{name: wrong}), transfer("srgb"), "scale", copy=False)


SLACK = 2.0**-8
RANGES = {
    "normal": (-2, 2),
    "nov": (-2, 2),
    "base_color": (-SLACK, 1 + SLACK),
    "roughness": (-SLACK, 1 + SLACK),
    "stencil": (0, None),
}


@pytest.mark.parametrize("layout", ["C", "F", "a part", "without a hidden value"])
@pytest.mark.parametrize("kind", ["float32", "float16", "float64"])
def test_a_plane_is_refused_for_each_value_that_does_not_fit(kind, layout):
    """One value among good ones, against the rule for one number."""
    for value in (np.dtype(kind).type(v) for v in VALUES):
        finite = {name: bool(np.isfinite(value)) for name in ("color", "A")}
        fits = {
            name: bool(np.isfinite(value) and value >= low and (high is None or value <= high))
            for name, (low, high) in RANGES.items()
        }
        for name, fit in {**finite, **fits, "depth": bool(value > 0), "motion": True, "position": True}.items():
            buffers = buffers_of((5, 7), kind, layout)
            plane = buffers.carried["A"] if name == "A" else getattr(buffers, name)
            plane[3, 2] = value
            message = rf"frame 0: {name}: expected .*, found {value:g} at \(3, 2"
            with nullcontext() if fit else pytest.raises(InputError, match=message):
                stss.check(buffers)


@pytest.mark.parametrize("kind", ["bool", "uint8", "int32", "uint64"])
def test_object_numbers_may_be_whole_numbers(kind):
    buffers = buffers_of((5, 7))
    stss.check(replace(buffers, stencil=np.ones((5, 7), kind)))
    if kind == "int32":
        with pytest.raises(InputError, match=r"stencil: expected values >= 0, found -1 at \(0, 0\) and 34 more"):
            stss.check(replace(buffers, stencil=-np.ones((5, 7), kind)))


def test_a_carried_plane_may_have_no_channels():
    stss.check(replace(buffers_of((5, 7)), carried={"A": np.zeros((5, 7, 0), np.float32)}))


def test_highlights_of_all_numbers():
    """By hand: NaN and what is not above 1 have none, an infinite one is half's largest number."""
    color = np.float32([[[np.nan, 1, -np.inf], [2.5, np.inf, 70000]]])
    np.testing.assert_array_equal(highlights(color), np.float32([[[0, 0, 0], [1.5, 65503, 65503]]]))
    assert highlights(np.float32([[[np.nan, 1, -np.inf]]])) is None


def test_blocks_cover_all_and_results_come_in_order(monkeypatch):
    """However long each takes; the first error by the order of blocks is the one that is raised."""
    monkeypatch.setattr(cores, "available_threads", lambda: 3)

    def work(part):
        time.sleep(0.002 * (9 - part.start) % 0.006)
        return range(part.start, part.stop)

    def fail(part):
        work(part)
        raise LookupError(f"no {part.start}")

    for length in (0, 1, 3, 4, 10):
        assert [i for part in for_blocks(length, 3, work) for i in part] == list(range(length))
    with pytest.raises(LookupError, match="no 4"):
        for_blocks(9, 1, lambda part: part.start < 4 or fail(part))


def test_threads_have_the_callers_handling_of_numbers(monkeypatch):
    """NumPy's errstate is the caller's; a single block starts no thread."""
    monkeypatch.setattr(cores, "available_threads", lambda: 3)
    for over in ("ignore", "raise"):
        with np.errstate(over=over):
            assert {state["over"] for state in for_blocks(8, 2, lambda part: np.geterr())} == {over}
    assert for_blocks(8, 8, lambda part: threading.current_thread()) == [threading.current_thread()]
    assert threading.current_thread() not in for_blocks(8, 2, lambda part: threading.current_thread())
