"""Fixtures shared by all tests."""

import gc
import os
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings

# One test process runs on each core: threads of theirs would only wait for each other, and those of linear algebra do so busily.
os.environ |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# Hypothesis reads the constants of all our modules, and keeps them; each judge in a folder of its own would read them anew.
os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = str(Path(__file__).parents[1] / ".hypothesis")

# CI runs the same cases every time; a developer's machine looks for new ones.
settings.register_profile("ci", derandomize=True, deadline=None)
settings.register_profile("dev", deadline=None)
settings.register_profile("fuzz", deadline=None, max_examples=2500)
settings.load_profile("ci" if os.environ.get("CI") else "dev")


TESTS = Path(__file__).parent
COMPILE = {"test_memory.py", "test_numbers.py"}
"""Files elsewhere whose tests compile kernels without the fixture ``device``."""
GPU_TESTS = {"gpu", "device-gpu"}
"""Fixtures of tests that compile the kernels of GPUs, and the parameter of tests/cl/conftest.py."""


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Of two workers, one begins with what compiles the kernels of processors, the other with those of GPUs: each compiles them once.

    A worker begins with its half, and takes from the end of the other's when it is through: tests that compile nothing are last.
    """
    kinds = {"cpu": [], "gpu": [], "": []}
    for item in items:
        compiles = (
            item.path.relative_to(TESTS).parts[0] in ("cl", "app") or item.path.name in COMPILE or "device" in item.fixturenames
        )
        params = getattr(getattr(item, "callspec", None), "params", {})
        gpu = item.path.name == "test_conv_gpu.py" or GPU_TESTS & {*item.fixturenames, f"device-{params.get('device')}"}
        kinds["" if not compiles else "gpu" if gpu else "cpu"].append(item)
    first = max(0, len(items) // 2 - len(kinds["cpu"]))
    items[:] = [*kinds["cpu"], *kinds[""][:first], *kinds["gpu"], *kinds[""][first:]]


def pytest_collection_finish():
    """Collecting garbage skips what lives until the end: thousands of tests and all modules, 0.2 s each time."""
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter):
    """The last lines name the skipped tests, with reasons."""
    reasons = {
        (report.nodeid, report.longrepr[2].removeprefix("Skipped: ")) for report in terminalreporter.stats.get("skipped", [])
    }
    if reasons:
        terminalreporter.section("left out")
    for reason, count in Counter(reason for _, reason in reasons).most_common():
        terminalreporter.line(f"{count:4} {reason}")


@pytest.fixture(scope="session")
def reference_data() -> Path:
    """The folder of reference data, which is not part of the project."""
    places = [Path(__file__).parents[2] / "shared" / "reference"]
    if named := os.environ.get("STSS_REFERENCE_DATA"):
        places.insert(0, Path(named))
    for place in places:
        if place.is_dir():
            return place
    pytest.skip("no reference data: neither ../shared/reference nor $STSS_REFERENCE_DATA is there")


@pytest.fixture(scope="session")
def device():
    """The device that the OpenCL backend chooses by itself, or the one that ``$STSS_DEVICE`` names."""
    from stss_cl.device.discovery import open_device
    from stss_ground.errors import DeviceError

    try:
        return open_device()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def demo(tmp_path_factory) -> Path:
    """``frames/demo.NNNN.exr``, 0 to 3, and their truth. Nothing may be changed in it."""
    from stss.demo import write_demo_sequence

    out = tmp_path_factory.mktemp("demo")
    write_demo_sequence(out, 4, (18, 32))
    return out


@pytest.fixture(scope="session")
def weights(tmp_path_factory) -> Path:
    """A file of random weights. Nothing may be changed in it."""
    from stss.weights.file import save
    from stss_ref.weights import random

    path = tmp_path_factory.mktemp("weights") / "random.safetensors"
    save(path, random(3), {})
    return path
