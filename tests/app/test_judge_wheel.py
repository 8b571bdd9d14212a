"""The judge alone: a small wheel of the same sources that judges ports where OpenCL and image libraries are not installed."""

import json
import os
import re
import subprocess
import sys
import zipfile

import pytest

from stss.images.read_write import read_rgb
from stss_ground.version import VERSION
from tests.app.wheels import ROOT, build_wheel, unpack_wheel

ABSENT = ("pyopencl", "cv2", "OpenImageIO", "colour", "scipy", "torch", "matplotlib", "onnx")
START = """
import site, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"not installed here: {{name}}", name=name)
sys.meta_path.insert(0, Absent())
at = len(sys.path); site.addsitedir({site!r}); sys.path[:] = sys.path[at:] + sys.path[:at]
"""
PORT = """
import numpy as np
class Port:
    name, dtype = "ours", "float32"
    def stages(self): return frozenset({"rrm"})
    def run(self, stage, inputs, weights=None):
        y, x, h, w = (int(n) for n in inputs["rectangle"])
        valid = inputs["valid"].copy()
        valid[y:y + h, x:x + w] = 0
        return {"valid": valid}
class Wrong(Port):
    def run(self, stage, inputs, weights=None):
        return {"valid": 1 - inputs["valid"]}
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel("packaging/judge", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory):
    return unpack_wheel(wheel, tmp_path_factory.mktemp("site"))


@pytest.fixture
def stss(installed, tmp_path):
    """The command, in an empty folder with a port in it."""
    (tmp_path / "ours.py").write_text(PORT)
    start = START.format(absent=ABSENT, site=str(installed))

    def run(*words, code="from conformance.command import main; main()"):
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [sys.executable, "-c", f"{start}sys.argv = {['stss', *words]!r}\n{code}"]
        return subprocess.run(command, cwd=tmp_path, env=environment, check=False, capture_output=True, text=True)

    run.folder = tmp_path
    return run


def test_it_is_what_runs(stss, installed):
    code = "import stss_ground, conformance, stss_ref; print(stss_ground.__file__, conformance.__file__, stss_ref.__file__, sep='\\n')"
    places = stss(code=code).stdout.split()
    assert places == [str(installed / place / "__init__.py") for place in ("stss_ground", "stss_judge/conformance", "stss_ref")]


@pytest.mark.parametrize("words", [["--help"], ["conform", "--help"]])
def test_help(stss, words):
    done = stss(*words)
    assert done.returncode == 0, done.stderr
    assert "Usage: stss" in done.stdout


def test_a_right_port(stss):
    done = stss("conform", "--port", "ours:Port", "--json", "f.json", "--report", "p.html")
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads((stss.folder / "f.json").read_text())["stages"]["rrm"]["cases"] > 600


def test_a_wrong_port(stss):
    """Failures with pictures, mistakes to compare with, and replay."""
    done = stss("conform", "--port", "ours:Wrong", "--stages", "rrm", "--report", "p.html")
    assert done.returncode == 1, done.stderr
    assert "looks like" in done.stdout
    kept = stss.folder / "conform-failures" / "rrm.agrees_with_the_reference"
    assert "picture.png, from left to right: port, expected" in (kept / "README.txt").read_text()
    assert read_rgb(kept / "picture.png").shape[2] == 3
    assert stss("conform", "--port", "ours:Wrong", "--replay", str(kept)).returncode == 1
    assert stss("conform", "--port", "ours:Port", "--replay", str(kept)).returncode == 0


def test_a_program_and_golden_vectors(stss):
    """The reference answers an archive of cases as any port does."""
    assert stss("conform", "--write-cases", "cases", "--stages", "rrm").returncode == 0
    code = "import pathlib; from conformance.reference_port import *; answer_job(pathlib.Path('cases'), ReferencePort())"
    assert stss(code=code).returncode == 0
    assert (stss.folder / "cases" / "0000" / "out" / "valid.npy").is_file()


def test_what_it_is_made_of(wheel):
    """Both distributions have the same files at the same places, and the small one needs what it imports."""
    listed = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    assert {name.split("/")[0] for name in listed} == {"stss_ground", "stss_ref", "stss_judge", "stss_judge.pth"}
    for name in listed:
        assert (ROOT / name.removeprefix("stss_judge/")).is_file(), name
    assert not [name for name in listed if "__pycache__" in name]
    text = zipfile.ZipFile(wheel).read(f"spacetime_supersampling_judge-{VERSION}.dist-info/METADATA").decode()
    required = [line for line in re.findall(r"^Requires-Dist: (.*)$", text, re.M) if "extra ==" not in line]
    needed = {re.match("[a-z]+", line).group() for line in required}
    assert needed == {"numpy", "safetensors", "click", "rich", "filelock", "pytest", "hypothesis"}
    whole = (ROOT / "pyproject.toml").read_text()
    for requirement in required:
        assert f'"{requirement}"' in whole, requirement
    assert wheel.stat().st_size < 1e6
