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
NETWORK = {"downsample_8", "conv", "upsample_corners", "normalise", "attend"}
PACK = {"pack_input", "pack_history"}
FRAME = {"chain_steps", "prepare_older", "prepare_newest", "splat_nearest", "splat_first", "fill_holes"}
STREAM = {*NETWORK, *FRAME, "finite", "differ", "differ_color", "tile_list", "widen", "winograd", "winograd_image"}
KERNELS = {
    ("network float32", "cpu"): NETWORK | PACK | {"winograd", "winograd_image"},
    ("network float32-direct", "cpu"): NETWORK | PACK | {"image"},
    ("network half", "cpu"): NETWORK | PACK | {"winograd", "winograd_image"},
    ("network bfloat16", "cpu"): (NETWORK | PACK | {"conv_amx", "matrix_amx", "image"}) - {"conv"},
    ("network half", "gpu"): {"conv_local", "attend_local"},
    ("stream float32", "cpu"): STREAM,
    ("stream half", "cpu"): STREAM,
    ("stream float32", "gpu"): {"conv_local", "attend_local", "arrive", "widen"},
    ("matrix units", "gpu"): {"conv_mma", "matrix"},
    ("stages", "cpu"): {"motion_chain", "warp", "holes", "splat_clear", "occlusion_warp", "rrm"},
}
"""The kernels that each case runs, at least, on each class of device."""

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


@pytest.mark.parametrize(("case", "device_class"), KERNELS)
def test_memory(case, device_class, tmp_path, monkeypatch):
    monkeypatch.setenv("STSS_DEVICE_CLASS", device_class)
    digests, ran, reports = simulated(case, tmp_path, OCLGRIND_DATA_RACES="1")
    harmful = [report for report in reports if not is_harmless(report)]
    assert not harmful, f"{len(harmful)} reports, the first: {harmful[0]}"
    assert digests
    assert ran >= KERNELS[case, device_class]
    again, _, reports = simulated(case, tmp_path, OCLGRIND_BUILD_OPTIONS=ONES, STSS_TEST_ONES="1")
    assert not reports, reports[0]
    assert again == digests


def test_no_kernel_is_left_out():
    written = {
        name
        for path in (ROOT / "kernels").glob("*.cl")
        if path.name != "selftest.cl"
        for name in re.findall(r"^(?:kernel[^;{]*?)?void (\w+)\(", path.read_text(), re.MULTILINE)
    }
    assert set().union(*KERNELS.values()) == written


@pytest.mark.parametrize(
    ("body", "found"),
    [
        ("out[get_global_id(0) + 61] = 1.0f;", "Invalid write"),
        ("out[0] = (float)get_global_id(0);", "Write-write data race"),
        ("out[get_global_id(0)] = in[get_global_id(0)];", "digest"),
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


def run_matrix_units(device):
    """One convolution of either stride, matrix units emulated: the whole network would take half an hour."""
    from stss_cl.device import matrix_units
    from stss_cl.device.buffers import padded, read, write
    from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
    from stss_cl.network.conv import conv
    from stss_cl.network.pack_weights import Packed

    dtype, random = np.dtype(np.float16), np.random.default_rng(0)
    for stride, size in ((1, (5, 33)), (2, (3, 7))):
        direct, gate = (random.normal(size=(3, 3, 16, n)).astype(np.float32) for n in (24, 1))
        packed = Packed(direct, gate, np.ones(24, np.float32), 0.5, 16)
        inputs = [padded(device, stride * size[0], stride * size[1], 8, dtype) for _ in range(2)]
        for buffer in inputs:
            write(device, buffer, random.random((buffer.height, buffer.width, 8), np.float32))
        out = padded(device, *size, 24, dtype)
        with trial(built_in_rows(BUILT_IN).classes["nvidia"]), matrix_units.trial(True):
            conv(device, "test", "layer", packed, *inputs, out, stride=stride).enqueue(device.queue)
        show(f"stride {stride}", read(device, out))


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
        nov = g[..., 0].astype(np.float16 if number == 9 else np.float32)
        frames.append(DisplayFrame(number, shown, motion, g.copy(), nov, stencil, 20 * g[..., :3]))
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
    elif kind == "matrix":
        run_matrix_units(device)
    elif kind == "stream":
        run_stream(device, how)
    else:
        for size in SIZES if how in ("", "float32") else (SIZES[0], SIZES[-1]):
            if kind == "network":
                run_network(device, how, *size)
            else:
                run_stages(device, *size)


if __name__ == "__main__":
    main(sys.argv[1])
