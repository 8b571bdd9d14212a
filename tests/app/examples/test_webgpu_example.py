"""The port in WGSL, on any WebGPU device: wgpu-py finds GPUs, lavapipe, or the software device of Chromium."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from conformance.protocol.stages import STAGES
from tests.meta.samples import AHEAD

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / "examples" / "webgpu"
SOFTWARE = Path("/usr/share/vulkan/icd.d"), Path("/usr/lib/chromium")
JUDGE = """
import json, sys
sys.path.insert(0, ".")
import gpu
try:
    gpu.device()
except RuntimeError as error:
    print(json.dumps({"skip": str(error)}))
    sys.exit()
from port import Port
from conformance.judging.judge import Judge, Tier
from conformance.suite.run_suite import run_suite
only, *stages = sys.argv[1:]
found = run_suite(Judge(Port(), Tier("some", 3, 1, 2), shrink=False), stages, only=only)
print(json.dumps({r.id: r.outcome for r in found}))
"""


def judged(folder, environment, only, stages):
    process = subprocess.run(
        [sys.executable, "-c", JUDGE, only, *stages], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}", **dict(environment)},
    )  # fmt: skip
    assert process.returncode == 0, process.stderr
    return json.loads(process.stdout.splitlines()[-1])


def software():
    """Mesa's software device, or Chromium's, if there is no other."""
    for folder in SOFTWARE:
        for driver in (*folder.glob("lvp_icd*.json"), *folder.glob("vk_swiftshader_icd.json")):
            return {"VK_ICD_FILENAMES": str(driver), "LD_LIBRARY_PATH": str(folder)}
    return {}


@pytest.fixture(scope="module")
def run():
    if importlib.util.find_spec("wgpu") is None:
        pytest.skip("wgpu is not installed: pip install 'spacetime-supersampling[webgpu]'")
    environment = software()

    def run(folder, only, stages):
        results = judged(folder, environment, only, stages)
        if "skip" in results:
            pytest.skip(f"no WebGPU device: {results['skip']}")
        return results

    return run


def test_the_port_passes(run):
    stages = set(STAGES) - AHEAD
    results = run(FOLDER, "agrees_with_the_reference or constants", stages)
    assert {name.split(".")[0] for name in results} == stages
    assert set(results.values()) == {"passed"}, results


@pytest.mark.thorough
def test_the_network_passes_on_more_rows_than_a_work_group(run):
    """Up to 2,080 rows or columns, and at 1/8 size 1,050."""
    results = run(FOLDER, "large_frames", ["history", "encoder", "erm", "decoder"])
    assert [*results.values()] == ["passed"] * 4, results
