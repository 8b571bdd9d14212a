"""Every test of the backend runs on its device twice: treated as a processor, and as a GPU."""

from functools import cache

import pyopencl as cl
import pytest

from stss_cl.device import discovery
from stss_cl.device.discovery import CLASSES, open_device
from stss_cl.options import PRECISIONS
from stss_ground.errors import DeviceError
from tests.tiers import thorough

QUICK = tuple(precision for precision in PRECISIONS if precision != "bfloat16")
"""Precisions that no device must emulate: frames of bfloat16 run only in tests that need them."""
OFTEN = [precision if precision == "float32" else thorough(precision) for precision in PRECISIONS]
"""Parameters: a network in half takes a processor a minute to compile. test_conv_gpu.py has its kernels, test_network.py direct ones,
test_amx.py those of bfloat16."""
ALL_LAYERS = pytest.mark.parametrize("device", ["cpu", thorough("gpu")], indirect=True)
"""For tests of frames that need more than the layers of `films.weights_for`; test_layers.py has all layers of GPUs on every commit."""
UNOPTIMISED = "-cl-opt-disable"
UNITS = 1024
"""Compute units of a processor that is treated as a GPU: more than a test's frame has tiles, as on a GPU. Layers with few tiles for
the units have smaller ones; so frames of all sizes have the same kernels, and each is compiled once."""


class LikeGpu(discovery.Device):
    """A processor that is treated as a GPU."""

    compute_units = UNITS


@pytest.fixture(scope="session", params=CLASSES)
def device(request):
    """The device that is chosen, or that ``$STSS_DEVICE`` names, with the host code, work-groups and tuning row of a class."""
    return opened_as(request.param)


@pytest.fixture(scope="session")
def processor():
    """The same, treated as a processor, for features of the kernels of processors alone: tile sizes of Winograd, vectors."""
    return opened_as("cpu")


@pytest.fixture(scope="session")
def gpu():
    """The same, treated as a GPU."""
    return opened_as("gpu")


@cache
def opened_as(device_class):
    """Opened once: its programs stay built."""
    try:
        device = open_device(device_class=device_class)
    except DeviceError as error:
        pytest.skip(str(error))
    if device_class == "cpu" and device.kind != "CPU":
        pytest.skip(f"{device.name} is no processor")
    if device_class == "gpu" and device.kind == "CPU":
        return LikeGpu(device.handle, device.context, device.queue, "gpu")
    return device


def anew(device):
    """The same device, for which nothing is built or proved yet."""
    context = cl.Context([device.handle])
    return type(device)(device.handle, context, cl.CommandQueue(context), device.device_class)


@pytest.fixture
def opened(device, monkeypatch):
    """`device`, also for the code that opens a device by itself: it then builds no program again."""
    monkeypatch.setattr(discovery, "open_device", lambda name="": device)
    return device


@pytest.fixture
def unoptimised(monkeypatch):
    """Programs for a processor are built without optimisation: a fifth of the time, for tests of logic whose programs no other test has."""
    monkeypatch.setattr(discovery.Properties, "compiler_options", UNOPTIMISED)


@pytest.fixture
def launched(monkeypatch):
    """The names of the kernels that are launched from now on, in order."""
    return launch_nothing(monkeypatch)


def launch_nothing(patch):
    """From now on build kernels without running them, where their results do not matter: processors take minutes for those of GPUs."""
    names = []
    watch_launches(patch, lambda queue, kernel, group: names.append(kernel.function_name) or cl.enqueue_marker(queue))
    return names


def watch_launches(patch, launches):
    """From now on call ``seen(queue, kernel, group)`` before each launch; an event that it gives stands for the launch."""
    launch = cl.enqueue_nd_range_kernel

    def launched(queue, kernel, size, group, *more, **options):
        return launches(queue, kernel, group) or launch(queue, kernel, size, group, *more, **options)

    patch.setattr(cl, "enqueue_nd_range_kernel", launched)
