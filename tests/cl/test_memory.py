"""Every kernel in Oclgrind, a simulator that sees each access: none is invalid, none races, and nothing is read before it is written.

Oclgrind's own search for uninitialised values does not serve: 21.10 ends the process at a shuffle that leaves a lane open, which
is what clang makes of ``(float8)(v.xyz, ...)``, and it takes for uninitialised what lies in the host's memory, what
``clEnqueueFillBuffer`` wrote, and open lanes that nobody reads. Instead each case runs twice, the second time with every new buffer
and private variable full of ones, which are NaN as floats, and must give the same bits.
"""

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest

ROOT = Path(__file__).parents[2]
LIBRARIES = (
    ("/usr/lib", "oclgrind/liboclgrind-rt-icd.so"),
    ("/usr/lib", "*/oclgrind/liboclgrind-rt-icd.so"),
    (str(ROOT / "build" / "portability"), "lib/python*/site-packages/pyopencl/.libs/liboclgrind-rt-icd*.so"),
)
ONES = "-ftrivial-auto-var-init=pattern"
"""Of clang: private variables start as NaN or as 0xaa."""

SIZES = ((1, 1), (3, 5), (8, 8), (9, 13))
STEPS = ((1, 3, 5), (0, 2, 4), (1, 1, 1))

NETWORK = {"pack_input", "pack_history", "downsample_8", "conv", "upsample_corners", "normalise", "attend"}
FRAME = {"chain_steps", "prepare_older", "prepare_newest", "splat_nearest", "splat_first", "fill_holes"}
STREAM = {
    *(NETWORK - {"pack_input", "pack_history"}), *FRAME, "finite", "differ", "differ_color", "tile_list",
}  # fmt: skip
KERNELS = {
    "network float32": NETWORK | {"winograd", "winograd_image"},
    "network float32-direct": NETWORK | {"image"},
    "network half": NETWORK | {"winograd", "winograd_image"},
    "network bfloat16": NETWORK - {"conv"} | {"conv_amx", "matrix_amx", "image"},
    "frame": FRAME | {"downsample_8"},
    "stream float32": {*STREAM, "winograd", "winograd_image"},
    "stream float32-direct": {*STREAM, "image"},
    "stream half": {*STREAM, "winograd", "winograd_image"},
    "gpu float32": {"conv_local", "attend_local", "arrive", "widen"},
    "gpu half": {"conv_mma", "matrix", "attend_local", "arrive", "widen"},
    "stages": {"motion_chain", "warp", "holes", "splat_clear", "splat_nearest", "splat_first", "occlusion_warp", "rrm"},
    "selftest": {"arithmetic", "vectors", "reduce_group", "nearest", "speed"},
}
"""The kernels that each case runs."""

REPORT = re.compile(r"^(?=Invalid|Uninitialized|Read-write|Write-write|Work-group|Error|\w+ data race)", re.MULTILINE)

LOOK = re.compile(r"load volatile (i32|<8 x i32>),")


def library():
    """Oclgrind's library, or skip."""
    named = os.environ.get("OCL_ICD_VENDORS", "")
    if named and "oclgrind" not in named:
        pytest.skip("OCL_ICD_VENDORS names another runtime than Oclgrind")
    for place, pattern in LIBRARIES:
        for path in sorted(Path(place).glob(pattern)):
            return path
    pytest.skip("Oclgrind is not installed: apt-get install oclgrind, or make portability")


def is_harmless(report):
    """Whether it is the splat's look at a key or eight before its atomic minimum: an old one is larger (kernels/occlusion_warp.clh)."""
    accesses = re.findall(r"entity:.*\n\s*(.*)", report)
    kinds = ["atomic" if "atomic_min" in access else "look" if LOOK.search(access) else "other" for access in accesses]
    return report.startswith("Read-write data race") and sorted(kinds) == ["atomic", "look"]


def simulated(case, tmp_path, **settings):
    """The digests that the case prints, the kernels that ran, what Oclgrind reported."""
    log = tmp_path / "log"
    env = {
        **os.environ,
        "OCL_ICD_VENDORS": str(library()),
        "OCLGRIND_LOG": str(log),
        "OCLGRIND_MAX_ERRORS": "100000",
        "OCLGRIND_INST_COUNTS": "1",
        "PYOPENCL_NO_CACHE": "1",  # binaries of other build options
        "PYTHONPATH": str(ROOT),
        **settings,
    }
    done = subprocess.run([sys.executable, __file__, case], env=env, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    reports = [report for report in REPORT.split(log.read_text()) if report.strip()]
    ran = set(re.findall(r"Instructions executed for kernel '(\w+)'", done.stdout))
    return re.findall(r"^digest (.*)", done.stdout, re.MULTILINE), ran, reports


CLASSES = [
    (case, device_class)
    for case in KERNELS
    for device_class in ("cpu", "gpu")
    if case not in ("stages", "selftest") and not case.startswith("gpu")
]


@pytest.mark.parametrize(
    ("case", "device_class"), [*CLASSES, *((case, "cpu") for case in ("gpu float32", "gpu half", "stages", "selftest"))]
)
def test_memory(case, device_class, tmp_path, monkeypatch):
    monkeypatch.setenv("STSS_DEVICE_CLASS", device_class)
    digests, ran, reports = simulated(case, tmp_path, OCLGRIND_DATA_RACES="1")
    harmful = [report for report in reports if not is_harmless(report)]
    assert not harmful, f"{len(harmful)} reports, the first: {harmful[0]}"
    assert digests
    if device_class == "cpu" or case.startswith("gpu"):
        assert ran == KERNELS[case]
    else:  # other kernels for the same
        assert not ran & {"winograd", "winograd_image"}
        assert any(name.startswith("conv") for name in ran) or case == "frame"
    again, _, reports = simulated(case, tmp_path, OCLGRIND_BUILD_OPTIONS=ONES, STSS_TEST_ONES="1")
    assert not reports, reports[0]
    assert again == digests


def test_no_kernel_is_left_out():
    written = {
        name
        for path in (ROOT / "kernels").glob("*.cl")
        for name in re.findall(r"^(?:kernel[^;{]*?)?void (\w+)\(", path.read_text(), re.MULTILINE)
    }
    assert set().union(*KERNELS.values()) == written


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("out[get_global_id(0) + 61] = 1.0f;", "Invalid write"),
        ("out[0] = in[get_global_id(0) + 61];", "Invalid read"),
        ("out[0] = (float)get_global_id(0);", "Write-write data race"),
        ("out[get_global_id(0)] = out[3 - get_global_id(0)];", "Read-write data race"),
        ("out[get_global_id(0)] = in[get_global_id(0)];", "digest"),
        ("float a[4]; a[get_global_id(0) / 4] = 0.0f; out[get_global_id(0)] = a[get_global_id(0) < 9 ? 1 : 0];", "digest"),
        ("out[get_global_id(0)] = (float)get_global_id(0);", None),
    ],
)
def test_a_fault_is_seen(body, found, tmp_path):
    """The comparison can fail."""
    digests, _, reports = simulated(f"fault {body}", tmp_path, OCLGRIND_DATA_RACES="1")
    again, _, _ = simulated(f"fault {body}", tmp_path, OCLGRIND_BUILD_OPTIONS=ONES, STSS_TEST_ONES="1")
    seen = [report.split(" at ")[0] for report in reports if not is_harmless(report)]
    if found in (None, "digest"):
        assert not seen
        assert (digests != again) == (found == "digest")
    else:
        assert any(report.startswith(found) for report in seen)


# What runs in the child


def show(name, array):
    print("digest", name, hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()[:16])  # noqa: T201


def fill_new_buffers(device, value):
    """New buffers hold ``value`` in every byte; and what is filled is copied, so that it counts as written."""
    buffer = cl.Buffer

    class Filled(buffer):
        def __init__(self, context, flags, size=0, hostbuf=None):
            super().__init__(context, flags, size, hostbuf)
            if hostbuf is None:
                cl.enqueue_copy(device.queue, self, np.full(self.size, value, np.uint8))

    cl.Buffer = Filled


def on_device(device, random, shape):
    return cla.to_device(device.queue, random.random(shape, dtype=np.float32))


def run_network(device, precision, height, width):
    from stss_cl.device import amx
    from stss_cl.network.network import Network
    from stss_ref.weights import random as random_weights

    if precision == "bfloat16":
        assert amx.product_is_right(device, emulate=True)
    random = np.random.default_rng(0)
    shapes = (height, width, 6), (height, width, 9), (height, width), (3, height, width, 4)
    network = Network(random_weights(5), device, precision)
    image = network(*(on_device(device, random, shape) for shape in shapes)).get()
    assert np.isfinite(image).all()
    show(f"{height} x {width}", image)


def run_layers(device, precision):
    """One convolution of either stride as GPUs have them, matrix units emulated: the whole network would take half an hour."""
    from stss_cl.device import matrix_units
    from stss_cl.device.buffers import padded, read, write
    from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
    from stss_cl.network.conv import conv
    from stss_cl.network.pack_weights import Packed

    dtype, random = np.dtype(np.float16 if precision == "half" else np.float32), np.random.default_rng(0)
    for stride, size in ((1, (5, 33)), (2, (3, 7))):
        direct, gate = (random.normal(size=(3, 3, 16, n)).astype(np.float32) for n in (24, 1))
        packed = Packed(direct, gate, np.ones(24, np.float32), 0.5, 16)
        inputs = [padded(device, stride * size[0], stride * size[1], 8, dtype) for _ in range(2)]
        for buffer in inputs:
            write(device, buffer, random.random((buffer.height, buffer.width, 8), np.float32))
        out = padded(device, *size, 24, dtype)
        with trial(built_in_rows(BUILT_IN)[0]["nvidia"]), matrix_units.trial(True):
            conv(device, "test", "layer", packed, *inputs, out, stride=stride).enqueue(device.queue)
        show(f"stride {stride}", read(device, out))
    run_attention(device, precision)
    run_arrival(device)
    run_planes(device)


def run_attention(device, precision):
    """At an eighth of 40 x 24, over random keys and values."""
    from stss_cl.network.layers import Layers
    from stss_ref.weights import random as random_weights

    random = np.random.default_rng(0)
    layers = Layers(device, random_weights(5), 40, 24, precision)
    attend = next(layer for layer in layers.launches if layer.name == "attend_local")
    dtype = np.float16 if precision == "half" else np.float32
    for name in ("key", "value", "eighth"):
        buffer = attend.arguments[name]
        cl.enqueue_copy(device.queue, buffer, random.random(buffer.size // np.dtype(dtype).itemsize).astype(dtype))
    attend.enqueue(device.queue)
    made = np.empty(attend.arguments["reshaded"].size, np.uint8)
    cl.enqueue_copy(device.queue, made, attend.arguments["reshaded"])
    show("attention", made)


def run_arrival(device):
    """A frame that differs from the one before it in one value."""
    from stss_cl.skip.arrival import ArrivalOnGpu

    random, size = np.random.default_rng(3), (6, 70)
    shapes = {"motion": 2, "gbuffer": 9, "nov": 1, "stencil": 1, "position": 3, "color": 3}
    before = {name: random.random((*size, n), dtype=np.float32) for name, n in shapes.items()}
    now = {name: array.copy() for name, array in before.items()}
    now["motion"][:] = 0
    now["nov"][5, 67] += 1
    now["color"][0, 3] += 1
    one, two = ({name: cla.to_device(device.queue, a).base_data for name, a in frame.items()} for frame in (before, now))
    colors = one.pop("color"), two.pop("color")
    arrival = ArrivalOnGpu(device, *size)
    bad, changed, recolored = arrival.look(two, colors[1], one, colors[0])
    assert bad is None
    assert (np.argwhere(changed).tolist(), np.argwhere(recolored).tolist()) == ([[1, 16]], [[0, 0]])
    show("arrival", np.stack([changed, recolored]))


def run_planes(device):
    """Planes of half: one whose values fill whole work-items, and one with a rest."""
    from stss_cl.skip.planes import Planes

    random, planes = np.random.default_rng(5), Planes(device)
    given = {"nov": random.random((6, 70)).astype(np.float16), "color": random.random((3, 5, 3)).astype(np.float16)}
    for name, buffer in planes.bring({name: (array, array.shape) for name, array in given.items()}).items():
        made = np.empty(given[name].shape, np.float32)
        cl.enqueue_copy(planes.queue, made, buffer)
        np.testing.assert_array_equal(made, given[name])
        show(name, made)


def run_frame(device, height, width):
    """Up to the network, whose buffers it writes, in strips of eight rows."""
    from stss_cl.device.buffers import inputs_for, read
    from stss_cl.image_space.prepare import Prepare

    size, columns = (height, width), -(-width // 8) * 8
    for steps, gather in zip(STEPS, ("longest", "nearest", "bilinear"), strict=True):
        random = np.random.default_rng(1)
        inputs = inputs_for(device, 8, columns, np.dtype(np.float16 if gather == "nearest" else np.float32))
        preparation = Prepare(device, *size, gather, inputs=inputs, tops=range(0, height, 8))
        shapes = (3, *size, 3), (*size, 9), size, (4, *size), (4, *size, 3), (4, *size, 3)
        speed = 0.2 if gather == "longest" else 2  # where all pixels stay in the frame, and where some leave it
        motions = cla.to_device(device.queue, random.normal(0, speed, (max(steps), *size, 2)).astype(np.float32))
        color, *others = (on_device(device, random, shape).base_data for shape in shapes)
        preparation.begin(color, steps, motions.base_data, *others)
        for top in range(0, height, 8):
            preparation.strip(top)
            for name in ("input", "earlier", "eighth"):
                show(f"{height} x {width} {gather} {top} {name}", read(device, getattr(inputs, name)))


def run_stream(device, precision):
    """Two extrapolated frames; before the second a corner of the picture changed, and something moves."""
    from stss.frames.display_frame import DisplayFrame
    from stss.frames.supersample import plan
    from stss_cl.skip.stream import Stream
    from stss_ref.weights import random as random_weights

    random, size = np.random.default_rng(4), (5, 18)
    stream, frames = Stream(random_weights(5), device, precision), []
    color, g = (random.random((*size, n), dtype=np.float32) for n in (3, 9))
    for number in range(12):
        motion, stencil = np.zeros((*size, 2), np.float32), np.zeros(size, np.float32)
        color = color.copy()
        if number == 10:
            color[:2, :3] = 0.5
        if number == 11:
            motion[2:4, 4:7] = 1.25
            stencil[2:4, 4:7] = 1
        shown = color if number % 2 == 0 else None
        frames.append(DisplayFrame(number, shown, motion, g.copy(), g[..., 0].copy(), stencil, 20 * g[..., :3]))
        if number in {9, 11}:
            window = frames[-6:]
            image, _ = stream(window, plan(window).steps)
            show(f"frame {number} {stream.report.network}", image)
    assert stream.report.network == "changed", stream.report


def run_stages(device, height, width):
    from stss_cl.image_space.stages import ImageStages

    random = np.random.default_rng(2)
    size = height, width
    channels = {"color": 3, "warped": 3, "motion": 2, "normal": 3, "normal_previous": 3, "position": 3, "position_previous": 3}
    flat = ("depth", "nov", "stencil", "stencil_previous", "valid")
    inputs = {name: random.normal(0, 2, (*size, count)).astype(np.float32) for name, count in channels.items()}
    inputs |= {name: random.integers(0, 2, size).astype(np.float32) for name in flat}
    inputs |= {"motions": random.normal(0, 2, (3, *size, 2)).astype(np.float32), "rectangle": np.array([0, 0, 1, 1])}
    for gather in ("longest", "nearest", "bilinear"):
        stages = ImageStages(device, gather)
        for stage in ("motion_chain", "warp", "holes", "occlusion_warp", "rrm") if gather == "longest" else ("motion_chain",):
            for name, array in stages.run_stage(stage, inputs).items():
                show(f"{height} x {width} {gather} {name}", array)


def run_selftest(device):
    from stss.devices import selftest
    from stss_cl.device.program import build

    selftest.COUNT = 37
    for check in (selftest.arithmetic, selftest.vectors, selftest.groups, selftest.nearest):
        check(device, np.random.default_rng(3))
    out = cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 4 * 32)
    weight = cl.Buffer(device.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=np.ones((2, 8), np.float32))
    cl.Kernel(build(device, "selftest.cl", flags="-cl-mad-enable"), "speed")(device.queue, (4,), None, weight, out, np.int32(2))
    got = np.empty(32, np.float32)
    cl.enqueue_copy(device.queue, got, out)
    show("speed", got)


def run_fault(device, body):
    text = f"kernel void fault(global const float *in, global float *out) {{ {body} }}"
    given, out = (cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 256) for _ in range(2))
    cl.Kernel(cl.Program(device.context, text).build(), "fault")(device.queue, (4,), None, given, out)
    got = np.empty(4, np.float32)
    cl.enqueue_copy(device.queue, got, out)
    show("fault", got)


def main(case):
    from stss_cl.device.discovery import open_device

    device = open_device("Oclgrind")
    fill_new_buffers(device, 255 if "STSS_TEST_ONES" in os.environ else 0)
    kind, _, how = case.partition(" ")
    if kind == "fault":
        run_fault(device, how)
    elif kind == "selftest":
        run_selftest(device)
    elif kind == "gpu":
        run_layers(open_device("Oclgrind", device_class="gpu"), how)
    elif kind == "stream":
        run_stream(device, how)
    else:
        for size in SIZES if how in ("", "float32") else (SIZES[0], SIZES[-1]):
            if kind == "network":
                run_network(device, how, *size)
            elif kind == "frame":
                run_frame(device, *size)
            else:
                run_stages(device, *size)


if __name__ == "__main__":
    main(sys.argv[1])
