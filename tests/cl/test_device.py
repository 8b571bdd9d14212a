"""Devices, their caches, and what happens to them after a fork."""

import gc
import linecache
import multiprocessing
import os
import subprocess
import sys
import weakref
from types import SimpleNamespace

import numpy as np
import pyopencl as cl
import pytest

from stss_cl.device import discovery as devices
from stss_cl.device import program
from stss_cl.device.discovery import matching, open_device
from stss_cl.device.launch import Kernel
from stss_cl.device.program import program_for
from stss_ground import machine as machine_of_this
from stss_ground.errors import DeviceError
from stss_ground.machine import available_threads, container_cores, container_memory

DEMO = "kernel void three(global float *out) { out[get_global_id(0)] = THREE; }\n"


@pytest.fixture
def kernels(tmp_path, monkeypatch):
    """A folder of kernels of our own."""
    monkeypatch.setattr(program, "KERNELS", tmp_path)
    (tmp_path / "demo.cl").write_text(DEMO)
    return tmp_path


def fake(platform, name, kind=cl.device_type.CPU, version="1"):
    return SimpleNamespace(platform=SimpleNamespace(name=platform, version=version), name=name, type=kind)


@pytest.fixture
def machine(monkeypatch):
    """Two GPUs of one name, two platforms on one CPU, and a simulator that calls itself everything."""
    handles = [
        fake("Maker", "GPU  X", cl.device_type.GPU),
        fake("Maker", "GPU X", cl.device_type.GPU),
        fake("Portable", "cpu", version="PoCL 3.1"),
        fake("Other", "cpu"),
        fake("Sim", "ulator", cl.device_type.CPU | cl.device_type.GPU),
    ]
    monkeypatch.setattr(devices, "find_devices", lambda: sorted(handles, key=devices.full_name))
    return handles


def write_groups(folder, groups, limits):
    """What Linux says of a process's control groups, and the files of these with a line each."""
    for name, text in {"mine": groups, **limits}.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text + "\n")


@pytest.mark.parametrize(
    ("groups", "limits", "least"),
    [
        ("0::/", {"memory.max": "max"}, None),
        ("0::/", {"memory.max": "5"}, 5),
        ("0::/a/b", {"memory.max": "9", "a/memory.max": "4", "a/b/memory.max": "max"}, 4),
        ("9:name=systemd:/\n4:memory:/docker/x", {"memory/memory.limit_in_bytes": "6", "memory.max": "1"}, 6),  # without its path
        ("0::/../../other", {}, None),
        ("", {}, None),
    ],
)
def test_a_container_limits_a_processors_memory(tmp_path, monkeypatch, groups, limits, least):
    """As the kernel's files of both versions say it: OpenCL reports the machine's, and more would end the process."""
    write_groups(tmp_path, groups, limits)
    monkeypatch.setattr(devices, "container_memory", lambda: container_memory(tmp_path / "mine", tmp_path))
    for kind in (cl.device_type.CPU, cl.device_type.GPU):
        handle = fake("Some", "device", kind)
        handle.global_mem_size = 8
        limit = 8 if kind == cl.device_type.GPU else least
        assert devices.Properties(handle).memory == min(8, 8 if limit is None else limit)


@pytest.mark.parametrize(
    ("groups", "limits", "least"),
    [
        ("0::/", {"cpu.max": "max 100000"}, None),
        ("0::/", {"cpu.max": "150000 100000"}, 2),
        ("0::/a/b", {"a/cpu.max": "50000 100000", "a/b/cpu.max": "max 100000"}, 1),
        ("4:cpu,cpuacct:/x", {"cpu/x/cpu.cfs_quota_us": "300000", "cpu/x/cpu.cfs_period_us": "100000", "cpu.max": "1 1"}, 3),
        ("4:cpu,cpuacct:/", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, None),
        ("", {}, None),
    ],
)
def test_a_container_limits_the_threads(tmp_path, monkeypatch, groups, limits, least):
    """More would use up its time at once, and all wait for the next."""
    write_groups(tmp_path, groups, limits)
    assert container_cores(tmp_path / "mine", tmp_path) == least
    for cores in (1, 64):
        monkeypatch.setattr(machine_of_this, "container_cores", lambda: least)
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, cores=cores: range(cores), raising=False)
        assert available_threads() == min(cores, least or cores)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity") or (os.cpu_count() or 1) < 2, reason="needs two processors, and Linux")
def test_a_process_on_some_processors_has_no_more_threads(processor):
    """PoCL counts the machine's."""
    if not processor.is_pocl_processor:
        pytest.skip("the device is not PoCL's processor")
    text = (
        "import os; os.sched_setaffinity(0, list(os.sched_getaffinity(0))[:1])\n"
        f"from stss_cl.device.discovery import open_device; print(open_device({processor.name!r}).compute_units)"
    )
    environment = {name: value for name, value in os.environ.items() if name not in ("POCL_AFFINITY", "POCL_MAX_PTHREAD_COUNT")}
    answer = subprocess.run([sys.executable, "-c", text], env=environment, capture_output=True, text=True, check=True)
    assert answer.stdout.split() == ["1"]


def run_three(device):
    out = np.zeros(5, np.float32)
    buffer = cl.Buffer(device.context, cl.mem_flags.WRITE_ONLY, out.nbytes)
    Kernel(program_for(device, "demo.cl", {"THREE": 3}), "three", {"out": buffer}).enqueue(device.queue, out.shape, None)
    cl.enqueue_copy(device.queue, out, buffer)
    assert (out == 3).all()


def test_a_compilers_warnings_do_not_reach_the_terminal(kernels, device, capfd, monkeypatch):
    """PoCL's compiler counts them there itself; they show where ``PYOPENCL_COMPILER_OUTPUT`` asks for them."""
    monkeypatch.delenv("PYOPENCL_COMPILER_OUTPUT", raising=False)
    (kernels / "demo.cl").write_text("#warning of no interest\n" + DEMO)
    run_three(device)
    assert capfd.readouterr() == ("", "")


def test_build_options_of_others_reach_no_kernel(kernels, device, monkeypatch):
    """PyOpenCL adds those of the environment to every program: with -cl-fast-relaxed-math a third of the holes went."""
    monkeypatch.setenv("PYOPENCL_BUILD_OPTIONS", "-D THREE_AND_A_HALF -Dthree=four")
    run_three(device)
    assert os.environ["PYOPENCL_BUILD_OPTIONS"] == "-D THREE_AND_A_HALF -Dthree=four"


def test_programs_go_with_their_device(kernels, device):
    """A process that opens a device for each film grew by all that PyOpenCL and the driver know of its programs."""
    opened = open_device()
    built = program_for(opened, "demo.cl", {"THREE": 3})
    assert built.handle
    program = weakref.ref(built)
    del opened, built
    gc.collect()
    assert program() is None


def test_a_second_kernel_of_a_kind_costs_no_generated_code(kernels, device):
    """PyOpenCL writes a Python module for each kernel object, and keeps it: a process that opened many streams grew and slowed."""
    run_three(device)
    modules = len(linecache.cache)
    for _ in range(3):
        run_three(device)
    assert len(linecache.cache) == modules


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        (None, ["Maker: GPU X", "Maker: GPU X #2", "Other: cpu", "Portable: cpu", "Sim: ulator"]),
        ("CPU", ["Other: cpu", "Portable: cpu"]),
        ("maker:  gpu x", ["Maker: GPU X"]),
        ("#2", ["Maker: GPU X #2"]),
        ("pocl", ["Portable: cpu"]),
    ],
)
def test_a_part_of_the_name_will_do(machine, name, expected):
    assert list(matching(name)) == expected


def test_a_graphics_processor_comes_first_and_a_simulator_is_none(machine, monkeypatch):
    monkeypatch.delenv("STSS_DEVICE", raising=False)
    monkeypatch.setattr(devices, "open_handle", lambda handle, *_, **__: handle)
    assert open_device() is machine[0]
    assert open_device("ulator") is machine[4]
    assert not devices.is_gpu(machine[4])
    monkeypatch.setenv("STSS_DEVICE", "other")
    assert open_device() is machine[3]


def test_a_kernel_that_does_not_build_shows_its_line(device, kernels):
    (kernels / "broken.cl").write_text("kernel void f(global float *a)\n{\n    a[0] = nowhere;\n}\n")
    with pytest.raises(DeviceError, match="nowhere") as error:
        _ = program_for(device, "broken.cl", {"COUNT": 1, "FLAG": True, "NONE": None, "NO": False}).handle
    assert "\n" not in str(error.value)
    options = " ".join(filter(None, ["-cl-std=CL1.2 -D COUNT=1 -D FLAG", device.compiler_options, "-cl-denorms-are-zero"]))
    assert f"kernels/broken.cl ({options})" in str(error.value)
    assert "nowhere" in error.value.log


# Processes


def forked(action):
    """What ``action`` returns or raises in a fork of this process."""
    queue = multiprocessing.get_context("fork").SimpleQueue()

    def call():
        try:
            queue.put(str(action()))
        except BaseException as error:
            queue.put(f"{type(error).__name__}: {error}")

    child = multiprocessing.get_context("fork").Process(target=call)
    child.start()
    child.join(20)
    hangs = child.is_alive()
    child.kill()
    assert not hangs
    return queue.get()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize("use", ["queue", "build", "open"])
def test_a_fork_is_refused(device, kernels, use):
    """Instead of hanging: the threads of the driver are not there."""
    run_three(device)
    actions = {
        "queue": lambda: device.queue,
        "build": lambda: program_for(device, "demo.cl", {"THREE": 3}).handle,
        "open": open_device,
    }
    words = forked(actions[use])
    assert words.startswith(f"DeviceError: OpenCL was opened in process {os.getpid()}, this is ")
    assert "does not survive a fork; use multiprocessing's spawn" in words
    run_three(device)


def test_the_class_is_what_the_device_is_unless_named(monkeypatch):
    """A GPU's host code and tuning row on any device, by the environment or by argument; another word is refused."""
    monkeypatch.delenv("STSS_DEVICE_CLASS", raising=False)
    plain = open_device()
    assert plain.device_class == ("cpu" if plain.kind == "CPU" else "gpu")
    assert open_device(device_class="gpu").device_class == "gpu"
    monkeypatch.setenv("STSS_DEVICE_CLASS", "gpu")
    forced = open_device()
    assert (forced.device_class, forced.is_cpu, forced.kind) == ("gpu", False, plain.kind)
    assert open_device(device_class="cpu").is_cpu
    monkeypatch.setenv("STSS_DEVICE_CLASS", "tpu")
    with pytest.raises(DeviceError, match="STSS_DEVICE_CLASS: expected one of cpu, gpu, got 'tpu'"):
        open_device()
    with pytest.raises(DeviceError, match="device_class: expected one of"):
        open_device(device_class="")
