"""The port in WGSL, on whatever WebGPU device there is: wgpu-py finds GPUs, lavapipe, or the software device of Chromium."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "examples" / "webgpu"
CHROMIUM = Path("/usr/lib/chromium")
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
judge = Judge(Port(), Tier("some", 20, 3, 1), shrink=False)
print(json.dumps({r.id: r.outcome for r in run_suite(judge, sys.argv[1:] or Port().stages())}))
"""


def judged(folder, environment, stages):
    done = subprocess.run(
        [sys.executable, "-c", JUDGE, *stages], cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}", **dict(environment)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def software():
    """Chromium's software device for whoever has no other."""
    driver = CHROMIUM / "vk_swiftshader_icd.json"
    return {"VK_ICD_FILENAMES": str(driver), "LD_LIBRARY_PATH": str(CHROMIUM)} if driver.is_file() else {}


@pytest.fixture(scope="module")
def run():
    if importlib.util.find_spec("wgpu") is None:
        pytest.skip("wgpu is not installed: pip install 'spacetime-supersampling[webgpu]'")
    environment = software()

    def run(folder, *stages):
        found = judged(folder, environment, stages)
        if "skip" in found:
            pytest.skip(f"no WebGPU device: {found['skip']}")
        return found

    return run


def test_the_port_passes(run):
    found = run(FOLDER)
    assert {name.split(".")[0] for name in found} == {"warp", "holes", "history"}
    assert set(found.values()) == {"passed"}, found


@pytest.mark.parametrize(
    ("file", "right", "wrong", "stage"),
    [
        ("follow.wgsl", "let at = p + vec2", "let at = p - vec2", "warp"),
        ("holes.wgsl", "(length + 1e-5)", "length", "holes"),
        ("conv.wgsl", "layer.stride + v - 1", "layer.stride + v", "history"),
    ],
)
def test_a_mistake_in_a_shader_is_found(run, tmp_path, file, right, wrong, stage):
    shutil.copytree(FOLDER, tmp_path / "port", ignore=shutil.ignore_patterns(".hypothesis"))
    text = (FOLDER / file).read_text()
    assert text.count(right) == 1
    (tmp_path / "port" / file).write_text(text.replace(right, wrong))
    assert "failed" in run(tmp_path / "port", stage).values()


def test_the_page_names_every_file():
    page = (FOLDER / "README.md").read_text()
    for path in (*FOLDER.glob("*.wgsl"), *FOLDER.glob("*.py")):
        assert f"`{path.name}`" in page, path.name
