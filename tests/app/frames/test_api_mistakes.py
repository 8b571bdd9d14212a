"""A value of a wrong type for `stss` gives one line of one of the four errors; the host program's settings do no harm."""

import copy
import datetime
import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from inspect import signature
from types import SimpleNamespace

import numpy as np
import pytest

import stss
from stss.frames.compute_options import ComputeOptions
from stss_cl import Frame, Network, Stream
from stss_cl.skip.display_frame import PLANES
from stss_ground.errors import DeviceError, InputError
from stss_ref.arrays import ArrayError
from stss_ref.weights import Weights, WeightsError, random
from stss_ref.weights import check as check_weights
from tests.app.frames.test_engine_loop import SIZE, engine, frames
from tests.tiers import every

ERRORS = (InputError, DeviceError, ArrayError, WeightsError)
WRONG = [5, 0.5, None, True, "x\0y", b"x", [], {}, object(), datetime.date(2026, 1, 1), np.zeros((2, 2)), np.array(["x"])]
"""Values of many types; an argument's test leaves out those that the argument accepts."""


def buffers(**changes):
    return replace(next(frames(1)), **changes)


def planes(**changes):
    frame = buffers()
    return {
        name: getattr(frame, name) for name in frame.__dataclass_fields__ if name not in ("number", "cut", "carried")
    } | changes


@cache
def stream():
    return Stream(random(0))


CALLS = {  # the call with a value -> the types of `WRONG` that it accepts
    "Supersampler(weights)": (lambda v: stss.Supersampler(v, backend="ref"), ()),
    "Supersampler(backend)": (lambda v: stss.Supersampler("bilinear", backend=v), ()),
    "Supersampler(device)": (lambda v: engine(device=v), (type(None),)),
    "Supersampler(precision)": (lambda v: engine(precision=v), ()),
    "Supersampler(memory_limit)": (lambda v: engine(memory_limit=v), (int, type(None))),
    "Supersampler(skip)": (lambda v: engine(skip=v), ()),
    "Supersampler(transfer)": (lambda v: engine(transfer=v), ()),
    "Supersampler(depth)": (lambda v: engine(depth=v), ()),
    "Supersampler(accumulate)": (lambda v: engine(accumulate=v), (bool, type(None))),
    "Supersampler(copy)": (lambda v: engine(copy=v), (bool,)),
    "Supersampler(check)": (lambda v: engine(check=v), (bool,)),
    "Supersampler(tell)": (lambda v: engine(tell=v), ()),
    "push": (lambda v: engine().push(v), ()),
    "loop": (lambda v: list(engine()(v)), (list, dict)),
    "warm_up": (lambda v: engine().warm_up(v), ()),
    "warm_up side": (lambda v: engine().warm_up((v, 4)), (int,)),
    "check": (stss.check, ()),
    "check number": (lambda v: stss.check(buffers(number=v)), (int,)),
    "check carried": (lambda v: stss.check(buffers(carried=v)), (dict,)),
    "check carried plane": (lambda v: stss.check(buffers(carried={"x": v})), ()),
    "check_frames": (stss.check_frames, ()),
    "check_frames frame": (lambda v: stss.check_frames([v]), ()),
    "convert number": (lambda v: stss.convert(v, planes()), (int,)),
    "convert planes": (lambda v: stss.convert(0, v), ()),
    "convert profile": (lambda v: stss.convert(0, planes(), v), ()),
    "convert camera": (lambda v: stss.convert(0, planes(), camera=v), (type(None),)),
    "convert carried": (lambda v: stss.convert(0, planes(mine=v)), (int, float, bool, list, np.ndarray)),
    "load_profile": (stss.load_profile, ()),
    "load_profile change": (lambda v: stss.load_profile("stss", units_per_cm=v), (int, float)),
    "load_profile table": (lambda v: stss.load_profile("stss", motion=v), (dict,)),
    "load_weights": (stss.load_weights, ()),
    "open_backend name": (lambda v: stss.open_backend(v, "bilinear"), ()),
    "open_backend weights": (lambda v: stss.open_backend("ref", v), ()),
    "open_backend options": (lambda v: stss.open_backend("ref", "bilinear", v), ()),
    "open_sequence": (stss.open_sequence, ()),
    "open_sequence profile": (lambda v: stss.open_sequence("no", v), ()),
    "open_sequence camera": (lambda v: stss.open_sequence("no", "stss", camera=v), ()),
    "open_sequence non_finite": (lambda v: stss.open_sequence("no", "stss", non_finite=v), ()),
    "supersample": (lambda v: list(stss.supersample(v, stss.open_backend("ref", "bilinear"))), (list, dict)),
    "supersample backend": (lambda v: list(stss.supersample([], v)), ()),
    "weights.check": (check_weights, ()),
}
CALLS |= {
    f"{call} {name}": ((lambda v, name=name, make=make: make(name, v)), ())
    for call, make in (
        ("check", lambda name, v: stss.check(buffers(**{name: v}))),
        ("convert", lambda name, v: stss.convert(0, planes(**{name: v}))),
    )
    for name in ("motion", "stencil", "base_color", "depth")
}
CALLS |= {
    f"{opened.__name__}({name})": (lambda v, opened=opened, name=name: opened(**{"weights": random(0), name: v}), kinds)
    for opened in (Network, Frame, Stream)
    for name, kinds in {"weights": (dict,), "precision": (), "device": (type(None),), "memory_limit": (int, type(None))}.items()
}
ONE_FRAME = SimpleNamespace(**dict.fromkeys(PLANES, np.zeros((8, 8), np.float32)))
CALLS |= {
    "Stream window": (lambda v: stream()(v, (0, 1, 2)), ()),
    "Stream frame": (lambda v: stream()([v], (0, 0, 0)), ()),
    "Stream steps": (lambda v: stream()([ONE_FRAME], v), ()),
    "Stream nov": (lambda v: stream()([SimpleNamespace(**{**vars(ONE_FRAME), "nov": v})], (0, 0, 0)), (np.ndarray,)),
}
CALLS["Stream(skip)"] = (lambda v: Stream(random(0), skip=v), ())
ALLOWED_KINDS = {"convert stencil": (int, float, bool)}


@pytest.mark.parametrize("name", every(3, CALLS))
def test_a_value_of_a_wrong_kind_is_one_line(name):
    call, takes = CALLS[name]
    for value in WRONG:
        if isinstance(value, ALLOWED_KINDS.get(name, takes)):
            continue
        with pytest.raises(ERRORS) as error:
            call(value)
        assert len(str(error.value).splitlines()) == 1, (name, value)


def test_every_argument_of_a_supersampler_is_tried():
    assert {f"Supersampler({name})" for name in signature(stss.Supersampler).parameters} <= CALLS.keys()


@pytest.mark.parametrize("kind", ["O", "U4", "M8[s]", "c16"])
def test_object_numbers_that_are_no_numbers_are_refused(kind):
    stencil = np.zeros(SIZE, np.int64).astype(kind)
    with pytest.raises(InputError, match="stencil: expected numbers, found"):
        engine().push(buffers(stencil=stencil))
    with pytest.raises(InputError, match="stencil: expected numbers, found"):
        stss.convert(0, planes(stencil=stencil))


def test_a_plane_of_another_spelling_is_told():
    """A colour that is not found would be a frame that was not rendered, and no output, without a word."""
    color = planes()["color"]
    without = {name: plane for name, plane in planes().items() if name != "color"}
    for name in ("Color", "colour", "rgb"):
        with pytest.raises(InputError, match=f"frame 0: no color; expected an array, or None if .*; found {name}"):
            stss.convert(0, without | {name: color})
    assert stss.convert(0, without | {"colour": color, "color": None}).color is None
    assert stss.convert(0, without | {"sky_color": color}).color is None
    with pytest.raises(InputError, match=r"frame 0: no base_color; expected an array; did you mean basecolor\?"):
        stss.convert(0, {"basecolor" if n == "base_color" else n: plane for n, plane in planes().items()})


@pytest.mark.parametrize("backend", ["ref", "cl"])
def test_an_outputs_arrays_are_the_callers(backend, device):
    """Written to, they change no later output; that of another push has others."""
    loop = stss.Supersampler("bilinear", backend=backend, transfer="none", device=device.name if backend == "cl" else None)
    want = [(o.image.copy(), o.valid.copy()) for o in loop(frames(4))]
    loop.reset()
    for output, (image, valid) in zip(loop(frames(4)), want, strict=True):
        np.testing.assert_array_equal(output.image, image)
        np.testing.assert_array_equal(output.valid, valid)
        assert output.valid.dtype == bool
        output.image[:] = 7
        output.valid[:] = ~output.valid


def test_a_supersampler_is_neither_pickled_nor_copied():
    for make in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(InputError, match="Supersampler: cannot be pickled or copied; expected one for each process"):
            make(engine())


def test_threads_within_one_supersampler_are_told_and_threads_in_turn_are_not():
    want = [output.image for output in engine()(frames(2))]
    loop, entered, leave = engine(), threading.Event(), threading.Event()
    compute = loop.backend.compute

    def wait(*arguments):
        entered.set()
        assert leave.wait(60)
        return compute(*arguments)

    loop.backend.compute = wait
    buffers = list(frames(2))
    with ThreadPoolExecutor(1) as pool:
        first = pool.submit(loop.push, buffers[0])
        assert entered.wait(60)
        with pytest.raises(InputError, match="another thread is within push"):
            loop.push(buffers[1])
        leave.set()
        np.testing.assert_array_equal(first.result().image, want[0])
        np.testing.assert_array_equal(pool.submit(loop.push, buffers[1]).result().image, want[1])


def test_numpy_that_raises_in_the_program_around_does_not_break_the_reference():
    """Its arithmetic rounds small numbers to 0 on purpose."""
    weights = Weights({name: tensor * np.float32(30) for name, tensor in random(0).items()})  # exp of far below 0
    buffers = [replace(b, roughness=np.full(SIZE, 1e-50)) for b in frames(2)]
    want = [output.image for output in stss.Supersampler(weights, backend="ref")(buffers)]
    before = np.seterr(all="raise")
    try:
        got = [output.image for output in stss.Supersampler(weights, backend="ref")(buffers)]
        assert np.geterr()["under"] == "raise"
    finally:
        np.seterr(**before)
    np.testing.assert_array_equal(got, want)


def test_options_of_a_wrong_kind_are_refused_without_a_backend():
    for options in ({"memory_limit": "x"}, {"memory_limit": True}, {"device": 5}, {"precision": []}, {"skip": None}):
        with pytest.raises(InputError):
            ComputeOptions(**options)


MISTAKES = {  # planes that are not as expected -> what the error says
    "depth of another size": ({"depth": lambda p: p[:-1]}, "depth: expected shape"),
    "motion of the display's size": ({"motion": lambda p: np.repeat(p, 2, 0)}, "motion: expected shape"),
    "depth that is a number": ({"depth": lambda p: 1.0}, r"depth: expected an array \(H, W\), found shape \(\)"),
    "no pixels": (dict.fromkeys(planes(), lambda p: p[:0]), "depth: expected an array"),
    "depth of 24 bits": (
        {"depth": lambda p: np.nan_to_num(p, posinf=0).astype(np.uint32)},
        "divide values by the one that means 1",
    ),
    "roughness of 16 bits": ({"roughness": lambda p: p.astype(np.uint16)}, "divide 16-bit values by 65535"),
    "roughness of 8 bits": ({"roughness": lambda p: p.astype(np.uint8)}, "divide 8-bit values by 255"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_the_plane_that_is_wrong_is_the_one_that_is_named(name):
    changes, words = MISTAKES[name]
    with pytest.raises(InputError, match=words):
        stss.convert(0, planes(**{plane: change(planes()[plane]) for plane, change in changes.items()}))


DEVICE = {"kind": "device", "near": 0.1, "far": np.inf, "reversed": True}


@pytest.mark.parametrize("value", [2.0, -0.5, 1.01])
def test_linear_depth_is_no_depth_buffer(value):
    """A depth of 20 m would count as the near plane, and -1 as the sky."""
    depth = np.full(SIZE, 0.5, np.float32)
    depth[1, 2] = value
    with pytest.raises(
        InputError, match=rf"depth buffer's values, from 0 to 1, found 1 others, the first {value:g} at \(y=1, x=2\)"
    ):
        stss.convert(0, planes(depth=depth), stss.load_profile("stss", depth=DEVICE))


@pytest.mark.parametrize("reverse", [True, False])
def test_a_depth_buffers_value_that_is_not_finite_is_nothing_hit(reverse):
    depth = np.full(SIZE, 0.5, np.float32)
    depth[0, :3] = np.inf, -np.inf, np.nan
    depth_back = stss.convert(0, planes(depth=depth), stss.load_profile("stss", depth={**DEVICE, "reversed": reverse})).depth
    assert np.isinf(depth_back[0, :3]).all()
    assert np.isfinite(depth_back[1:]).all()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.int32])
def test_object_numbers_of_each_kind_cause_no_warning(kind):
    stencil = np.full(SIZE, 300).astype(kind)
    stss.check(buffers(stencil=stencil))
    stss.convert(0, planes(stencil=stencil))


@pytest.mark.parametrize("kind", ["planar", "ray"])
def test_a_view_space_that_looks_backwards_is_told(kind):
    """OpenGL's z is negative before the camera, and so it would be all background. One negative value means that nothing was hit."""
    rules = stss.load_profile("stss", depth={"kind": kind, "background": 1e9})
    depth = -np.arange(1, SIZE[0] * SIZE[1] + 1, dtype=np.float32).reshape(SIZE)
    with pytest.raises(
        InputError, match=r"frame 0: depth: expected distances .*, found \d+ negative ones and no other, -\d+ to -1; neg"
    ):
        stss.convert(0, planes(depth=depth), rules)
    for sky in (-1, -np.inf, np.nan):
        depth = np.full(SIZE, sky, np.float32)
        assert np.isinf(stss.convert(0, planes(depth=depth), rules).depth).all()
        depth[0, :2] = 5, -2
        assert stss.convert(0, planes(depth=depth), rules).depth[0, 0] == 5


class Tensor:
    """An array that another library does not give away."""

    def __array__(self, *_, **__):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead.")


@pytest.mark.parametrize("name", ["color", "alpha"])
@pytest.mark.parametrize(
    ("value", "words"), [(Tensor(), "Tensor: Can't call numpy"), ([[1.0], [1.0, 2.0]], "list: setting an array")]
)
def test_a_plane_that_does_not_become_an_array_is_named(name, value, words):
    with pytest.raises(InputError, match=f"^frame 0: {name}: expected an array, found {words}"):
        stss.convert(0, planes(**{name: value}))


@pytest.mark.parametrize("dtype", ["<f2", ">f4", "<f8"])
def test_planes_and_numbers_may_have_any_width(dtype):
    """A depth may be half, or come from a file of the other byte order; a number of 8 bits has no successor behind 127."""
    images = []
    for numbers, last in (((126, 127, 128), "<f4"), ((np.int8(126), np.int8(127), 128), dtype)):
        loop = stss.Supersampler("bilinear", backend="ref")
        for number, frame in zip(numbers, frames(3, first=1), strict=True):
            output = loop.push(replace(frame, number=number, depth=frame.depth.astype(dtype).astype(last)))
        assert output is not None
        images.append(output.image)
    np.testing.assert_array_equal(*images)
