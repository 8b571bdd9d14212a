"""Kernels take their arguments by name: whatever order their source has, and with one line where a name or a type is wrong."""

import re
from weakref import WeakKeyDictionary

import numpy as np
import pyopencl as cl
import pytest

from stss_cl.device import program
from stss_cl.device.launch import Kernel, Launch
from stss_cl.image_space.prepare import Prepare
from tests.cl.films import frame_inputs

SCALE = """\
typedef struct {
    int first;  // of those that are scaled
    float by;
} Scale;

kernel void scale(ARGUMENTS)
{
    out[get_global_id(0)] = in[get_global_id(0)] * (get_global_id(0) >= scale.first ? scale.by : 1.0f) + (float)count;
}
"""
ORDERS = (
    "global const float *restrict in, global float *restrict out, const Scale scale, const ulong count",
    "const ulong count, const Scale scale, global float *restrict out, global const float *restrict in",
)


@pytest.fixture(params=ORDERS, ids=["one order", "another"])
def scale(request, processor, tmp_path, monkeypatch):
    """The program of a kernel with its arguments in one order or another."""
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    (tmp_path / "scale.cl").write_text(SCALE.replace("ARGUMENTS", request.param))
    monkeypatch.setattr(program, "_programs", WeakKeyDictionary())
    return program.build(processor, "scale.cl")


@pytest.fixture
def buffers(processor):
    given = np.arange(4, dtype=np.float32)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return {name: cl.Buffer(processor.context, flags, hostbuf=given) for name in ("in", "out")}


def scaled(device, kernel, out):
    kernel.enqueue(device.queue, (4,), (1,))
    got = np.empty(4, np.float32)
    cl.enqueue_copy(device.queue, got, out)
    return got.tolist()


def test_arguments_go_by_name(processor, scale, buffers):
    """Those of a struct, too; what is set later keeps the rest."""
    kernel = Kernel(scale, "scale", {"by": 3, "first": 2, **buffers, "count": 1})
    assert scaled(processor, kernel, buffers["out"]) == [1, 2, 7, 10]
    kernel.set(first=np.int64(1))
    assert scaled(processor, kernel, buffers["out"]) == [1, 4, 7, 10]


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("bias", 0, "it has no argument bias"),
        ("in", 5, "argument in is float*, got int"),
        ("count", 1.5, "argument count is ulong, got float"),
        ("first", 1.0, "argument first is int, got float"),
        ("by", None, "argument by is float, got NoneType"),
    ],
)
def test_a_wrong_argument_is_one_line(scale, buffers, name, value, message):
    with pytest.raises(TypeError, match=re.escape(f"kernel scale: {message}")):
        Kernel(scale, "scale", {**buffers, "first": 0, "by": 1.0, "count": 0, name: value})


@pytest.mark.parametrize("name", ["in", "first", "count"])
def test_a_missing_argument_is_one_line(processor, scale, buffers, name):
    """Also after the kernel was loaded without it."""
    arguments = {**buffers, "first": 0, "by": 1.0, "count": 0}
    arguments.pop(name)
    launch = Launch("scale", Kernel(scale, "scale", arguments), arguments, (1,), (1,))
    for _ in range(2):
        with pytest.raises(TypeError, match=f"kernel scale: argument {name} is missing"):
            launch.enqueue(processor.queue)
        if name != "in":  # of which the kernel reads
            launch.load(processor.queue)


def test_a_stored_binary_keeps_the_names(processor, buffers, tmp_path, monkeypatch):
    """It need not know them itself."""
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "scale.cl").write_text(SCALE.replace("ARGUMENTS", ORDERS[0]))
    asked, ask = [], program._signature
    monkeypatch.setattr(program, "_signature", lambda kernel: asked.append(kernel) or ask(kernel))
    for _ in range(2):
        monkeypatch.setattr(program, "_programs", WeakKeyDictionary())
        kernel = Kernel(program.build(processor, "scale.cl"), "scale", {**buffers, "first": 0, "by": 2, "count": 0})
        assert scaled(processor, kernel, buffers["out"]) == [0, 2, 4, 6]
    assert len(asked) == 1


def test_a_frames_kernels_may_take_their_arguments_in_any_order(gpu, unoptimised, tmp_path, monkeypatch):
    """The groups of `prepare_newest` and `fill_holes` are turned around, and the planes in them: every value stays."""
    size = 16, 24
    inputs = frame_inputs(size)
    first = _prepared(gpu, size, inputs)
    for path in program.KERNELS.iterdir():
        (tmp_path / path.name).write_text(path.read_text())
    frame, planes = tmp_path / "frame.cl", tmp_path / "prepare.clh"
    groups = "PLANES(ARGUMENT) OLDER(ARGUMENT) WRITTEN(ARGUMENT) NEWEST(ARGUMENT)"
    turned, count = re.subn(re.escape(groups), " ".join(groups.split()[::-1]), frame.read_text())
    frame.write_text(turned)
    turned, swapped = re.subn("(DO.const float, color.) (DO.const float2, motion.)", r"\2 \1", planes.read_text())
    planes.write_text(turned)
    assert count == swapped == 1
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    monkeypatch.setattr(program, "_programs", WeakKeyDictionary())
    np.testing.assert_array_equal(_prepared(gpu, size, inputs), first)


def _prepared(device, size, inputs):
    """What the network reads."""
    preparation = Prepare(device, *size)
    preparation.begin(**vars(inputs))
    preparation.strip()
    got = np.empty((preparation.rows + 2, preparation.columns + 2, 24), np.float32)
    cl.enqueue_copy(device.queue, got, preparation.inputs.input.data)
    return got
