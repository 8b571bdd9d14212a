"""The wheels of program and judge: they contain all files that they read, and overwrite none of other packages."""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

from stss.images.read_write import read_rgb
from stss_ground.version import VERSION

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[3]
DATA = (
    *(f"stss_cl/kernels/{path.name}" for path in (ROOT / "kernels").iterdir()),
    *(f"stss/sequence/profile_tables/{path.name}" for path in (ROOT / "stss/sequence/profile_tables").iterdir()),
    "stss_cl/device/tuning.toml",
    "stss/weights/realtime.safetensors",
    "stss/weights/antialiased.safetensors",
    *(f"stss_judge/conformance/suite/{path.name}" for path in (ROOT / "conformance/suite").glob("*.py")),
    "stss_judge/conformance/examples/cpp/port.cpp",
)
ABSENT = ("pyopencl", "cv2", "OpenImageIO", "scipy", "torch", "matplotlib", "onnx")
"""Packages that the judge alone does not need."""
START = """
import site, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {absent!r}:
            raise ModuleNotFoundError(f"not installed here: {{name}}", name=name)
sys.meta_path.insert(0, Absent())
at = len(sys.path); site.addsitedir({site!r}); sys.path[:] = {path!r} + sys.path[at:] + sys.path[:at]
sys.argv = {words!r}
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


def build_wheel(project, folder):
    """The wheel of a project, a path below the root, as `pip` builds it, and a folder in which it is installed."""
    pytest.importorskip("hatchling", reason="hatchling is not installed: make test installs it")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT / project, check=True, capture_output=True)
    wheel = next(folder.glob("*.whl"))
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return wheel, folder / "site"


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    return build_wheel(".", tmp_path_factory.mktemp("program"))


@pytest.fixture(scope="module")
def judge(tmp_path_factory):
    return build_wheel("packaging/judge", tmp_path_factory.mktemp("judge"))


def python(site, cwd, code, *words, path=(), absent=()):
    """Python code where ``site`` is a site folder, after the folders of ``path`` and before the rest."""
    start = START.format(absent=absent, site=str(site), path=[*map(str, path)], words=["stss", *map(str, words)])
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-c", start + code]
    return subprocess.run(command, cwd=cwd, env=environment, check=False, capture_output=True, text=True)


def test_the_program_has_all_that_it_reads_and_overwrites_nothing_of_others(program):
    names = set(zipfile.ZipFile(program[0]).namelist())
    sources = {
        str(path.relative_to(ROOT)) for package in ("stss", "stss_cl", "stss_ref") for path in (ROOT / package).rglob("*.py")
    }
    assert not {*DATA, *sources} - names
    information = f"spacetime_supersampling-{VERSION}.dist-info"
    tops = {"stss", "stss_cl", "stss_ref", "stss_ground", "stss_lab", "stss_judge", "stss_judge.pth", information}
    assert {name.split("/")[0] for name in names} == tops


def test_the_laboratory_may_stay_out(program, tmp_path, monkeypatch):
    """Its commands then, and nothing else: the rest of the program does not need it."""
    monkeypatch.setenv("STSS_LAB", "0")
    wheel, site = build_wheel(".", tmp_path)
    left_out = {*zipfile.ZipFile(program[0]).namelist()} - {*zipfile.ZipFile(wheel).namelist()}
    assert left_out
    assert all(name.startswith("stss_lab/") for name in left_out)
    process = python(site, tmp_path, "from stss.__main__ import main; main()", "--help", path=[site], absent={"stss_lab"})
    assert process.returncode == 0, process.stderr
    assert " compare " in process.stdout
    assert " bench " not in process.stdout


def test_a_container_is_given_all_that_the_wheel_is_built_from(program, tmp_path):
    """The folder as a container's engine copies it, by ``.dockerignore``; no engine is needed."""
    first, *others = [line for line in (ROOT / ".dockerignore").read_text().splitlines() if not line.startswith("#")]
    assert first == "*"
    for name in (line.removeprefix("!") for line in others if line.startswith("!")):
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, tmp_path / name)
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path / "dist")]
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
    names = zipfile.ZipFile(next((tmp_path / "dist").glob("*.whl"))).namelist()
    assert sorted(names) == sorted(zipfile.ZipFile(program[0]).namelist())


def test_uv_sees_that_a_file_of_the_wheel_changed(program):
    """After a ``git pull``, ``uvx --from .`` ran what it had built before."""
    keys = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["uv"]["cache-keys"]
    seen = {path.relative_to(ROOT).as_posix() for key in keys for path in ROOT.glob(key["file"])}
    names = [name for name in zipfile.ZipFile(program[0]).namelist() if ".dist-info/" not in name]
    sources = {name.replace("stss_cl/kernels/", "kernels/").removeprefix("stss_judge/") for name in names}
    assert not {*sources, "pyproject.toml", "hatch_build.py", "README.md"} - seen


def test_another_package_of_the_judges_name_is_one_line(program, tmp_path):
    """Theirs is imported, ours is untouched, and the line says where both are and what to do."""
    site, command = program[1], "from stss.cli.main import main; main()"
    (tmp_path / "conformance").mkdir()
    (tmp_path / "conformance" / "__init__.py").write_text("")
    process = python(site, tmp_path, command, "conform", path=[tmp_path])
    assert process.returncode == 2
    assert re.fullmatch(r"stss: conformance: expected .*\n", process.stderr), process.stderr
    assert str(tmp_path / "conformance") in process.stderr
    process = python(site, tmp_path, command, "conform", path=[site / "stss_judge", tmp_path])
    assert "expected either --port" in process.stderr


def test_a_folder_of_pythonpath_is_enough(program, tmp_path):
    """No .pth file is read there; the self-test of a device is a process of its own, which imports the judge's table of bounds."""
    path = os.pathsep.join([str(program[1]), sysconfig.get_paths()["purelib"]])
    for words in (
        ["-m", "stss", "conform", "--help"],
        ["-c", "import stss.devices.selftest as s; print(s.ratio.__code__.co_filename)"],
    ):
        command = [sys.executable, "-S", *words]
        process = subprocess.run(
            command, cwd=tmp_path, env={**os.environ, "PYTHONPATH": path}, check=False, capture_output=True, text=True
        )
        assert process.returncode == 0, process.stderr
    assert process.stdout.strip() == str(program[1] / "stss_judge/conformance/tolerance.py")


def test_the_judge_has_the_files_of_the_program_and_needs_what_it_imports(judge):
    wheel = judge[0]
    names_in_wheel = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    assert {name.split("/")[0] for name in names_in_wheel} == {"stss_ground", "stss_ref", "stss_judge", "stss_judge.pth"}
    for name in names_in_wheel:
        assert (ROOT / name.removeprefix("stss_judge/")).is_file(), name
    assert not [name for name in names_in_wheel if "__pycache__" in name]
    text = zipfile.ZipFile(wheel).read(f"spacetime_supersampling_judge-{VERSION}.dist-info/METADATA").decode()
    requirements = [line for line in re.findall(r"^Requires-Dist: (.*)$", text, re.M) if "extra ==" not in line]
    packages = {re.match("[a-z]+", line).group() for line in requirements}
    assert packages == {"numpy", "safetensors", "click", "rich", "filelock", "pytest", "hypothesis"}
    whole = (ROOT / "pyproject.toml").read_text()
    for requirement in requirements:
        assert f'"{requirement}"' in whole, requirement
    assert wheel.stat().st_size < 1e6


def test_the_judge_alone_judges(judge, tmp_path):
    """Failures with pictures, mistakes to compare with, and replay; by the files of the wheel."""
    (tmp_path / "ours.py").write_text(PORT)

    def conform(*words):
        return python(judge[1], tmp_path, "from conformance.command import main; main()", "conform", *words, absent=ABSENT)

    process = conform("--port", "ours:Wrong", "--json", "f.json", "--report", "p.html")
    assert process.returncode == 1, process.stderr
    assert "looks like" in process.stdout
    assert json.loads((tmp_path / "f.json").read_text())["stages"]["rrm"]["cases"] > 0
    assert (tmp_path / "p.html").is_file()
    folder = tmp_path / "conform-failures" / "rrm.agrees_with_the_reference"
    assert "picture.png, from left to right: port, expected" in (folder / "README.txt").read_text()
    assert read_rgb(folder / "picture.png").shape[2] == 3
    assert conform("--port", "ours:Wrong", "--replay", folder).returncode == 1
    assert conform("--port", "ours:Port", "--replay", folder).returncode == 0
    places = python(judge[1], tmp_path, "import conformance, stss_ref; print(conformance.__file__, stss_ref.__file__)").stdout
    assert places.split() == [str(judge[1] / place / "__init__.py") for place in ("stss_judge/conformance", "stss_ref")]


TARGETS = [
    "x86_64-manylinux_2_28",
    "aarch64-manylinux_2_28",
    "aarch64-apple-darwin",
    "x86_64-apple-darwin",
    "x86_64-pc-windows-msvc",
]
LACKS = {"x86_64-unknown-linux-musl": "openimageio"}
"""Platform -> the requirement that has no wheel there."""


@pytest.mark.thorough
def test_all_that_stss_needs_has_wheels():
    """On every platform but those that lack one, which is named."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None or "CI" not in os.environ:
        pytest.skip("asks the package index for a minute, with uv, where CI is set")
    command = [uv, "pip", "compile", "--quiet", "--only-binary", ":all:", "--python-version", "3.12", "pyproject.toml"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    commands = {
        target: subprocess.Popen([*command, "--python-platform", target], cwd=ROOT, **pipes) for target in [*TARGETS, *LACKS]
    }
    answers = {target: (process.communicate(timeout=300), process.returncode) for target, process in commands.items()}
    if any("Failed to fetch" in text for (_, text), _ in answers.values()):
        pytest.skip("the package index is not reached")
    for target, ((out, text), status) in answers.items():
        assert bool(status) == (target in LACKS), text
        assert not status or f"{LACKS[target]}>=" in text
        assert status or ("pocl-binary-distribution" in out) == (target == "x86_64-manylinux_2_28")
