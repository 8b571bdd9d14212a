"""Kernels take their arguments by name, in any order of their source, and with one line if a name or a type is wrong."""

import re

import numpy as np
import pyopencl as cl
import pytest

from stss_cl.device import program, signatures
from stss_cl.device.launch import Kernel, Launch
from stss_cl.image_space.prepare import Prepare
from stss_cl.image_space.stages import hole_options
from tests.cl.conftest import anew
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
AMX = {"STRIDE": 1, "A": 24, "B": 0, "OUT": 24, "STORED": "BFLOAT16", "EMULATE": True, "RELU": True, "GATED": False}
ORDERS = (
    "global const float *restrict in, global float *restrict out, const Scale scale, const ulong count",
    "const ulong count, const Scale scale, global float *restrict out, global const float *restrict in",
)


@pytest.fixture
def processor(processor):
    """One that has no programs yet."""
    return anew(processor)


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """The folder of the kernels, empty."""
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    return tmp_path


@pytest.fixture(params=ORDERS, ids=["one order", "another"])
def scale(request, processor, kernels):
    """The program of a kernel with its arguments in one order or another."""
    (kernels / "scale.cl").write_text(SCALE.replace("ARGUMENTS", request.param))
    return program.program_for(processor, "scale.cl")


@pytest.fixture
def buffers(processor):
    values = np.arange(4, dtype=np.float32)
    flags = cl.mem_flags.READ_WRITE | cl.mem_flags.COPY_HOST_PTR
    return {name: cl.Buffer(processor.context, flags, hostbuf=values) for name in ("in", "out")}


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


@pytest.mark.parametrize("stored", [False, True], ids=["built", "from a binary"])
def test_a_driver_need_not_know_the_names(processor, kernels, buffers, monkeypatch, stored):
    """OpenCL lets a driver forget them where a program was built without an option, or from a binary."""

    def unknown(kernel, place, what):
        raise cl.RuntimeError("clGetKernelArgInfo failed: KERNEL_ARG_INFO_NOT_AVAILABLE")

    monkeypatch.setattr(cl.Kernel, "get_arg_info", unknown)
    if stored:
        monkeypatch.setattr(program, "has_src_build_cache", lambda handle: None)
        monkeypatch.setenv("XDG_CACHE_HOME", str(kernels / "cache"))
    (kernels / "scale.cl").write_text(SCALE.replace("ARGUMENTS", ORDERS[0]))
    for device in (processor, anew(processor)):
        values = {name: cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 16) for name in buffers}
        cl.enqueue_copy(device.queue, values["in"], np.arange(4, dtype=np.float32))
        kernel = Kernel(program.program_for(device, "scale.cl"), "scale", {**values, "first": 0, "by": 2, "count": 0})
        assert scaled(device, kernel, values["out"]) == [0, 2, 4, 6]
    assert len(list(kernels.glob("cache/stss/binaries/*"))) == stored


@pytest.mark.parametrize(
    ("file", "options"),
    [
        ("frame.cl", hole_options("footprint")),
        ("frame.cl", {**hole_options("footprint"), "DETAIL": True}),
        ("conv_amx.cl", AMX),
        ("conv_amx.cl", {**AMX, "IMAGE": True}),
    ],
    ids=lambda value: value if isinstance(value, str) else value.get("DETAIL", False) or value.get("IMAGE", False),
)
def test_names_are_those_of_the_compiler(processor, tmp_path, monkeypatch, file, options):
    """Of the files whose arguments stand in groups or depend on options; numbers and structs have the same type."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # Intel's runtime forgets the names in a stored binary
    handle = program.program_for(processor, file, options, "-cl-kernel-arg-info -cl-opt-disable").handle
    for kernel in handle.all_kernels():
        queries = cl.kernel_arg_info.NAME, cl.kernel_arg_info.TYPE_NAME
        compiled = [[kernel.get_arg_info(i, what).strip("\0") for what in queries] for i in range(kernel.num_args)]
        from_source = signatures.arguments(program.source(file), kernel.function_name, options.keys())
        assert [name for name, _ in from_source] == [name for name, _ in compiled]
        for (_, kind), (_, type_name) in zip(from_source, compiled, strict=True):
            assert kind == type_name if "*" not in kind else type_name.endswith("*")


def test_no_buffer_is_no_none(processor, kernels, monkeypatch):
    """Which PyOpenCL before 2026.1.4 refuses; before the first launch and behind it."""
    set_arg = cl.Kernel.set_arg

    def refuse_none(kernel, place, value):
        if value is None:
            raise TypeError("set_arg(): incompatible function arguments")
        set_arg(kernel, place, value)

    monkeypatch.setattr(cl.Kernel, "set_arg", refuse_none)
    (kernels / "there.cl").write_text("kernel void there(global const int *in, global int *out) { *out = in ? *in : 7; }\n")
    out, got = cl.Buffer(processor.context, cl.mem_flags.READ_WRITE, 4), np.empty(1, np.int32)
    kernel = Kernel(program.program_for(processor, "there.cl"), "there", {"in": None, "out": out})
    given = cl.Buffer(processor.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=np.int32([5]))
    for value, want in ((None, 7), (given, 5), (None, 7)):
        kernel.set(**{"in": value})
        kernel.enqueue(processor.queue, (1,), (1,))
        cl.enqueue_copy(processor.queue, got, out)
        assert got == [want]


def test_a_declaration_that_is_not_understood_is_one_line(processor, kernels):
    (kernels / "f.cl").write_text("#define TWO global float *a, global float *b\nkernel void f(TWO, const int c) {}\n")
    with pytest.raises(TypeError, match="kernel f: it takes 3 arguments, read 2 in its source"):
        Kernel(program.program_for(processor, "f.cl"), "f").enqueue(processor.queue, (1,), (1,))


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
    turned, swapped = re.subn("(DO.const float, color.) (DO.const float2, motions.)", r"\2 \1", planes.read_text())
    planes.write_text(turned)
    assert count == swapped == 1
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    np.testing.assert_array_equal(_prepared(anew(gpu), size, inputs), first)


def _prepared(device, size, inputs):
    """What the network reads."""
    preparation = Prepare(device, *size)
    preparation.begin(**vars(inputs))
    preparation.strip()
    got = np.empty((preparation.rows + 2, preparation.columns + 2, 24), np.float32)
    cl.enqueue_copy(device.queue, got, preparation.inputs.input.data)
    return got
