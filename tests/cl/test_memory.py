"""Every kernel in Oclgrind, a simulator that sees each access: none is invalid, none races, and no value is read before it is written.

`make portability` runs it, since Oclgrind has to be the only runtime (``$OCL_ICD_VENDORS`` names its library). Oclgrind's own search
for uninitialised values does not serve: it ends the process at a shuffle that leaves a lane open, and takes for uninitialised what lies
in the host's memory. Instead each case runs twice, the second time with every new buffer and private variable full of ones, which are
NaN as floats, and must give the same bits.
"""

import os
import re
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

from stss.frames.carried_planes import WHITE
from stss_cl.device import amx, matrix_units, program
from stss_cl.device.buffers import pad, read, write
from stss_cl.device.conversion import conversions_are_right
from stss_cl.device.discovery import open_device
from stss_cl.device.tuning import BUILT_IN, built_in_rows, trial
from stss_cl.image_space.accumulate import Accumulate
from stss_cl.image_space.output import OutputKernels
from stss_cl.image_space.stages import STAGES, ImageStages
from stss_cl.network import conv_gpu
from stss_cl.network.conv import ConvSpec, conv
from stss_cl.network.network import Network
from stss_cl.network.pack_weights import PackedLayer
from stss_cl.skip.stream import Stream
from tests.cl.conftest import watch_launches
from tests.cl.films import WEIGHTS, calls_of, film, halve, network_inputs
from tests.meta.samples import samples

KERNELS = Path(__file__).parents[2] / "kernels"
REPORT = re.compile(r"^(?=Invalid|Uninitialized|Read-write|Write-write|Work-group|Error|\w+ data race)", re.MULTILINE)
LOOK = re.compile(r"load volatile (i32|<8 x i32>),")
FAULTS = {
    "out[get_global_id(0) + 61] = 1.0f;": "Invalid write",
    "out[0] = (float)get_global_id(0);": "Write-write data race",
    "out[get_global_id(0)] = in[get_global_id(0)];": "other bits",
    "out[get_global_id(0)] = (float)get_global_id(0);": "",
}


def is_harmless(report):
    """Whether it is the splat's look at a key or eight before its atomic minimum: an old one is larger (kernels/occlusion_warp.clh)."""
    accesses = re.findall(r"entity:.*\n\s*(.*)", report)
    kinds = ["atomic" if "atomic_min" in access else "look" if LOOK.search(access) else "other" for access in accesses]
    return report.startswith("Read-write data race") and sorted(kinds) == ["atomic", "look"]


@pytest.fixture
def simulated(tmp_path, monkeypatch):
    """``simulated(case, device_class)``: what Oclgrind reports, and the names of the kernels that ran; ``case(device)`` gives arrays."""
    if "oclgrind" not in os.environ.get("OCL_ICD_VENDORS", ""):
        pytest.skip("Oclgrind is not the only runtime: make portability")
    ran, log, buffer = set(), tmp_path / "log", cl.Buffer
    watch_launches(monkeypatch, lambda queue, kernel, group: ran.add(kernel.function_name))
    monkeypatch.setattr(program, "has_src_build_cache", lambda handle: True)  # no binaries of other build options
    for name, value in (("LOG", str(log)), ("MAX_ERRORS", "100000"), ("DATA_RACES", "1")):
        monkeypatch.setenv(f"OCLGRIND_{name}", value)

    def once(case, device_class, value):
        device = open_device(device_class=device_class)

        class Filled(buffer):
            """New buffers hold ``value`` in every byte; copied, so that it counts as written."""

            def __init__(self, context, flags, size=0, hostbuf=None):
                super().__init__(context, flags, size, hostbuf)
                if hostbuf is None:
                    cl.enqueue_copy(device.queue, self, np.full(self.size, value, np.uint8))

        monkeypatch.setattr(cl, "Buffer", Filled)
        outputs = [np.ascontiguousarray(array).tobytes() for array in case(device)]
        assert outputs
        return outputs, [report for report in REPORT.split(log.read_text()) if report.strip() and not is_harmless(report)]

    def simulate(case, device_class="cpu"):
        outputs, reports = once(case, device_class, 0)
        monkeypatch.setenv("OCLGRIND_BUILD_OPTIONS", "-ftrivial-auto-var-init=pattern")  # of clang: NaN or 0xaa
        again, more = once(case, device_class, 255)
        monkeypatch.delenv("OCLGRIND_BUILD_OPTIONS")
        return reports + more + ["other bits"] * (again != outputs), ran

    return simulate


def network(precision, sizes):
    def case(device):
        assert precision != "bfloat16" or amx.product_is_right(device, emulate=True)
        return [Network(WEIGHTS, device, precision)(*network_inputs(size)) for size in sizes]

    return case


def matrix(device):
    """One convolution, matrix units emulated: the whole network would take half an hour. Of either stride, a group's tiles one after the
    other, and channels in parts."""
    dtype, random = np.dtype(np.float16), np.random.default_rng(0)
    for stride, size, local in ((1, (5, 33), conv_gpu.LOCAL), (2, (3, 7), conv_gpu.LOCAL), (1, (5, 33), 0)):
        direct, gate = (random.normal(size=(3, 3, 16, n)).astype(np.float32) for n in (24, 1))
        packed = PackedLayer(direct, gate, np.ones(24, np.float32), 0.5, 16)
        inputs = [pad(device, stride * size[0], stride * size[1], 8, dtype) for _ in range(2)]
        for buffer in inputs:
            write(device, buffer, random.random((buffer.height, buffer.width, 8), np.float32))
        out = pad(device, *size, 24, dtype)
        with trial(built_in_rows(BUILT_IN).classes["nvidia"]), matrix_units.trial(True), pytest.MonkeyPatch.context() as patch:
            patch.setattr(conv_gpu, "GROUPS", 1)
            patch.setattr(conv_gpu, "LOCAL", local)
            conv(device, ConvSpec("test", "layer", packed, stride), *inputs, out).enqueue(device.queue)
        yield read(device, out)


def stream(precision):
    """Two extrapolated frames of which something moves in the second, which is computed in part; planes come as half."""

    def case(device):
        frames = [halve(frame) for frame in film(11 * ["nothing"], (5, 18))]
        frames[11].motion[2:4, 4:7], frames[11].stencil[2:4, 4:7] = 1.25, 1
        frame = Stream(WEIGHTS, device, precision)
        images = [frame(*call)[0] for call in calls_of(frames)[-3::2]]
        assert frame.cost.network == "changed"
        return images

    return case


def stages(device):
    """The stages of image space on a sample of each size; images mixed in turns, and delivered."""
    for stage in STAGES:
        for case in {next(iter(case.inputs.values())).shape: case for case in samples(stage)}.values():
            yield from ImageStages(device).run_stage(stage, case.inputs).values()
    random, output = np.random.default_rng(2), OutputKernels(device)
    for height, width in ((1, 1), (3, 5), (9, 13)):
        image, *earlier = random.random((3, 2 * height, 2 * width, 3), np.float32)
        color, motions = random.random((height, width, 3), np.float32), random.normal(0, 2, (2, height, width, 2))
        motions = motions.astype(np.float32)
        yield Accumulate(device)(image, earlier, motions)
        for motion, srgb, highlights in ((motions[0], True, "color"), (None, False, None)):
            delivered, carried = output.deliver(image, {"color": color}, motion, srgb=srgb, highlights=highlights, white=WHITE)
            yield from (delivered, *carried.values())


def conversions(device):
    """The kernels' own, since no instructions of Oclgrind's are tested."""
    yield np.array(conversions_are_right(device, None))


SIZES = (1, 1), (3, 5), (8, 8), (9, 13)
CASES = [
    (network("float32", SIZES), "cpu"),
    (network("float32-direct", SIZES), "cpu"),
    (network("half", SIZES[::3]), "cpu"),
    (network("bfloat16", SIZES[3:]), "cpu"),
    (network("half", SIZES[::3]), "gpu"),
    (stream("float32"), "cpu"),
    (stream("half"), "cpu"),
    (stream("float32"), "gpu"),
    (matrix, "gpu"),
    (stages, "cpu"),
    (conversions, "cpu"),
]


def test_memory(simulated):
    for number, (case, device_class) in enumerate(CASES):
        outputs, ran = simulated(case, device_class)
        assert not outputs, f"case {number}: {len(outputs)} reports, the first: {outputs[0]}"
    names = re.compile(r"^(?:kernel[^;{]*?)?void (\w+)\(", re.MULTILINE)
    assert ran >= {n for path in KERNELS.glob("*.cl") if path.name != "selftest.cl" for n in names.findall(path.read_text())}


@pytest.mark.parametrize("body", FAULTS)
def test_a_fault_is_seen(simulated, body):
    """The comparison can fail."""

    def case(device):
        text = f"kernel void fault(global const float *in, global float *out) {{ {body} }}"
        source, out = (cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 256) for _ in range(2))
        cl.Kernel(cl.Program(device.context, text).build(), "fault")(device.queue, (4,), None, source, out)
        cl.enqueue_copy(device.queue, got := np.empty(4, np.float32), out)
        return [got]

    outputs, _ = simulated(case)
    assert any(report.startswith(FAULTS[body]) for report in outputs) if FAULTS[body] else not outputs
