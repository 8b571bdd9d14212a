"""The loop of an engine: arrays that are filled again, cuts, highlights, conventions, and arrays that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import stss
from conformance.scenes import SCENES, render
from stss.frames.backends import ReferenceBackend
from stss.frames.output import choose_rendered
from stss_ground.errors import DeviceError, InputError

SIZE = 16, 24


def frames(count, *, scale=1.0, first=0):
    """Display frames of an analytic scene; the even ones are rendered."""
    scene = next(iter(SCENES.values()))
    for number in range(first, first + count):
        view = render(scene, number, *SIZE)
        planes = {name: getattr(view, name).astype(np.float32) for name in view.__dataclass_fields__}
        planes["position"] = np.where(np.isfinite(planes["depth"])[..., None], planes["position"], np.float32(1e7))
        color = planes.pop("color") * np.float32(scale)
        yield stss.Buffers(number, color if number % 2 == 0 else None, **planes)


def engine(**options):
    return stss.Supersampler("bilinear", backend="ref", **options)


@pytest.mark.parametrize("copy", [True, False])
def test_arrays_may_be_filled_again(copy):
    """The same arrays for every frame give the images of new arrays; without copies they do not, so the test can fail."""
    expected = [output.image for output in engine()(frames(6))]
    arrays, images, loop = {}, [], engine(copy=copy)
    for buffers in frames(6):
        planes = {
            name: getattr(buffers, name) for name in buffers.__dataclass_fields__ if name not in ("number", "cut", "carried")
        }
        for name, plane in planes.items():
            if plane is not None:
                arrays.setdefault(name, np.empty_like(plane))[...] = plane
        planes_kept = {name: arrays[name] if plane is not None else None for name, plane in planes.items()}
        images.append(loop.push(stss.Buffers(buffers.number, **planes_kept)).image)
    assert all(np.array_equal(*pair) for pair in zip(images, expected, strict=True)) == copy


def with_value(name, value):
    def change(buffers):
        plane = getattr(buffers, name).copy()
        plane[2, 3] = value
        return replace(buffers, **{name: plane})

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda b: replace(b, color=(b.color * 255).astype(np.uint8)),
            "color: expected floating-point numbers, found uint8; divide",
        ),
        (with_value("color", np.nan), r"color: expected finite numbers, found nan at \(2, 3, 0\) and 2 more"),
        (with_value("depth", np.nan), "depth: expected numbers, found nan"),
        (with_value("depth", -4), "depth: expected values > 0, found -4"),
        (with_value("base_color", -0.7), r"base_color: expected values >= 0, found -0\.7 at \(2, 3, 0\) and 2 more$"),
        (with_value("base_color", 200), "base_color: expected values <= 1, found 200"),
        (with_value("normal", 127), "normal: expected values <= 2, found 127"),
        (lambda b: replace(b, motion=b.motion[..., :1]), r"motion: expected shape \(16, 24, 2\), found \(16, 24, 1\)"),
        (lambda b: replace(b, nov=None), r"nov: expected an array \(16, 24\), found NoneType"),
    ],
)
def test_wrong_arrays_are_refused_before_anything_is_computed(change, message):
    buffers, loop = change(next(frames(1))), engine()
    with pytest.raises(InputError, match=f"frame 0: {message}"):
        loop.push(buffers)
    with pytest.raises(InputError, match=message):
        stss.check(buffers)
    assert loop.push(next(frames(1))) is not None


@pytest.mark.parametrize("option", [{"depth": "foo"}, {"transfer": "foo"}, {"backend": "foo"}, {"memory_limit": -5}])
def test_wrong_options_are_refused(option):
    with pytest.raises(InputError, match=str(*option.values())):
        stss.Supersampler(**{"weights": "bilinear", "backend": "ref", **option})


def test_an_output_sees_six_frames():
    """The network reads three rendered frames; the third of an extrapolated one lies five frames back."""
    seen = []

    class Backend(ReferenceBackend):
        def compute(self, window, steps):
            seen.append(([frame.number for frame in window], steps))
            return super().compute(window, steps)

    list(stss.Supersampler(backend=Backend(stss.load_weights("bilinear").weights))(frames(8)))
    assert seen[-2:] == [([1, 2, 3, 4, 5, 6], (0, 2, 4)), ([2, 3, 4, 5, 6, 7], (1, 3, 5))]


def test_nothing_crosses_a_cut():
    """After a cut the outputs are those of a loop that begins there; a first frame that was not rendered has none."""
    shots = [*frames(5), *(replace(b, cut=b.number == 5) for b in frames(4, first=5))]
    outputs = list(engine()(shots))
    fresh = list(engine()(frames(4, first=5)))
    assert [o.number for o in outputs] == [0, 1, 2, 3, 4, 6, 7, 8]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(outputs[-3:], fresh, strict=True))
    loop = engine()
    list(loop(frames(5)))
    loop.reset()
    assert loop.push(next(frames(1, first=5))) is None


@pytest.mark.parametrize(("number", "follows"), [(3, True), (2, False), (1, False), (-5, False), (9, False)])
def test_numbers_that_jump_or_go_back_begin_a_shot(number, follows):
    """As after a pause of the window's, or in a game that goes back in time: nothing is made of the frames before."""
    loop = engine()
    list(loop(frames(3)))
    frame = replace(next(frames(1, first=3)), number=number)
    assert (loop.push(frame) is not None) == follows


def test_a_frame_that_is_refused_was_never_pushed():
    loop, (first, second, third, fourth) = engine(), frames(4)
    list(loop([first, second]))
    wrong = replace(third, color=third.color * np.float32(np.nan))
    with pytest.raises(InputError, match="frame 2: color: expected finite numbers, found nan at"):
        loop.push(wrong)
    assert loop.push(fourth) is None
    loop = engine()
    list(loop([first, second]))
    with pytest.raises(InputError):
        loop.push(wrong)
    assert [output.number for output in loop([third, fourth])] == [2, 3]


def test_no_masked_array_is_read_under_its_mask():
    buffers = next(frames(1))
    hidden = np.zeros(SIZE, bool)
    hidden[2, 3] = True
    masked = {name: np.ma.array(getattr(buffers, name), mask=hidden) for name in ("depth", "stencil")}
    for name, plane in masked.items():
        with pytest.raises(InputError, match=f"frame 0: {name}: expected an array without a mask, .*; fill it first"):
            engine().push(replace(buffers, **{name: plane}))
    planes = {
        name: getattr(buffers, name) for name in ("motion", "normal", "position", "base_color", "roughness", "metallic", "nov")
    }
    for planes_given in ({"stencil": 0, **masked}, {"depth": buffers.depth, "stencil": 0, "light": masked["depth"]}):
        with pytest.raises(InputError, match="expected an array without a mask"):
            stss.convert(0, planes | planes_given)
    engine().push(replace(buffers, depth=np.ma.array(buffers.depth, mask=False)))


@pytest.mark.parametrize("kind", [np.int32, np.int64, np.uint32, np.float64])
def test_object_numbers_that_run_together_are_refused(kind):
    buffers = next(frames(1))
    numbers = np.full(SIZE, 2**24, kind)
    engine().push(replace(buffers, stencil=numbers))
    numbers[2, 3] += 1
    planes = {name: getattr(buffers, name) for name in ("motion", "normal", "depth", "position", "base_color", "nov")}
    message = r"frame 0: stencil: expected whole numbers up to 16777216, .* found 1\.67772e\+07 at \(2, 3\)"
    with pytest.raises(InputError, match=message):
        engine().push(replace(buffers, stencil=numbers))
    with pytest.raises(InputError, match=message):
        stss.convert(0, planes | {"stencil": numbers, "roughness": 1.0, "metallic": 0.0})


def test_highlights_survive_and_nothing_else_changes():
    """Light above 1 comes out; without such light, and where the image is not white, not a bit differs."""
    plain = list(engine()(frames(4, scale=0.5)))
    assert all(output.image.max() <= 1 for output in plain)
    bright = list(engine()(frames(4, scale=8)))
    for buffers, output in zip(frames(4, scale=8), bright, strict=True):
        if buffers.color is not None:
            top = buffers.color.max()
        assert 0.5 * top < output.image.max() <= top, output.kind
        assert not output.carried
    clipped = engine()(replace(b, color=None if b.color is None else np.minimum(b.color, 1)) for b in frames(4, scale=8))
    for output, other in zip(bright, clipped, strict=True):
        white = other.image > 0.692  # 0.85 display-referred
        assert np.array_equal(output.image[~white], other.image[~white])
        assert 0.05 < (output.image > other.image).mean() < white.mean()


def test_other_planes_are_carried():
    """A plane that holds the colour's own values comes out as the bilinear image of that colour."""
    for output in engine(transfer="none")(
        replace(b, carried={} if b.color is None else {"again": np.clip(b.color, 0, 1)}) for b in frames(3)
    ):
        there = output.valid if output.kind.value == "EF" else np.ones(SIZE, bool)
        there = np.repeat(np.repeat(binary_erosion(there, np.ones((3, 3)), border_value=1), 2, 0), 2, 1)
        difference = np.abs(output.carried["again"] - output.image)[there]
        assert difference.max() <= 2**-21, output.kind  # roundings of two bilinear means


def test_a_frame_is_shown_in_one_line():
    """In a debugger, a log or an assertion; not its millions of numbers."""
    of = next(frames(1))
    assert repr(replace(of, carried={"alpha": of.depth}, cut=True)) == f"Buffers(0, {SIZE}, rendered, cut, alpha)"
    assert repr(engine().push(of)) == f"Output(0, SF, {SIZE[0] * 2, SIZE[1] * 2})"


def test_supersample_is_the_loop_over_an_open_backend():
    backend = stss.open_backend("ref", "bilinear")
    outputs, looped = (
        list(run(frames(3))) for run in (lambda f: stss.supersample(f, backend), stss.Supersampler(backend=backend))
    )
    assert [(a.image == b.image).all() for a, b in zip(outputs, looped, strict=True)] == [True] * 3


def test_conventions_of_an_engine():
    """Motion in NDC with y up and positions in metres give the same as pixels and centimetres."""
    buffers = next(frames(1))
    rules = stss.load_profile("stss", units_per_cm=0.01, motion={"unit": "ndc", "y": "up"})
    names = ("color", "normal", "depth", "stencil", "nov", "base_color", "roughness", "metallic")
    planes = {name: getattr(buffers, name).astype(np.float64) for name in names}
    planes["motion"] = buffers.motion.astype(np.float64) * (2 / SIZE[1], -2 / SIZE[0])
    planes["position"] = buffers.position.astype(np.float64) / 100
    converted = stss.convert(0, planes, rules)
    with pytest.raises(InputError, match="frame 0: color: expected floating-point numbers, found uint8"):
        stss.convert(0, {**planes, "color": (planes["color"] * 255).astype(np.uint8)}, rules)
    stss.check(converted)
    for name in (*names, "motion", "position"):
        a, b = getattr(converted, name), getattr(buffers, name)
        assert np.array_equal(a, b) if name not in ("motion", "position") else (np.abs(a - b) <= 2**-22 * np.abs(b)).all(), name
    with pytest.raises(InputError, match=r"motion\.unit: expected one of pixels, uv, ndc, found 'px'"):
        stss.load_profile("stss", motion={"unit": "px"})
    with pytest.raises(InputError, match="no depth"):
        stss.convert(0, {name: plane for name, plane in planes.items() if name != "depth"})


@pytest.mark.parametrize(
    ("has_color", "cuts", "expected"),
    [
        (range(3, 9), (), {3, 5, 7}),
        (range(3, 9), (6,), {3, 5, 6, 8}),
        ({3, 5, 6, 8}, (), {3, 5, 6, 8}),
    ],
)
def test_which_frames_count_as_rendered(has_color, cuts, expected):
    """The parity is that of the first frame of each shot; an extra frame at a cut is used."""
    assert choose_rendered(range(3, 9), frozenset(has_color), None, cuts) == expected


@pytest.mark.parametrize("at", [1, 5, 8])
@pytest.mark.parametrize("error", [KeyboardInterrupt, DeviceError])
def test_a_call_that_failed_may_be_made_again(monkeypatch, at, error):
    """Ctrl-C in a notebook, or a device that is out of memory for a moment: the history stays, and the frame is not in it twice."""
    expected = [output.image for output in engine(accumulate=True)(frames(9))]
    loop, images, right = engine(accumulate=True), [], ReferenceBackend.frame
    failing = []

    def fail(*arguments):
        if failing:
            raise failing.pop()
        return right(*arguments)

    monkeypatch.setattr(ReferenceBackend, "frame", fail)
    for buffers in frames(9):
        if buffers.number == at:
            failing.append(error("now"))
            with pytest.raises(error, match="now"):
                loop.push(buffers)
        images.append(loop.push(buffers).image)
    np.testing.assert_array_equal(images, expected)
