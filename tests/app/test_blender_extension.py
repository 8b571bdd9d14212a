"""The Blender extension: its zip, and a scene from nothing to supersampled frames where a Python with bpy is there."""

import ast
import importlib
import json
import os
import shutil
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import pytest

from stss.images.read_write import read_channels, read_header
from stss_ground.version import VERSION

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]


def test_one_command_builds_the_extension(tmp_path):
    (tmp_path / "wheels").mkdir()
    for name in ("b-1-py3-none-any.whl", "a-1-py3-none-any.whl"):
        (tmp_path / "wheels" / name).write_bytes(name.encode())
    command = [
        sys.executable,
        ROOT / "blender/build.py",
        "-o",
        tmp_path / "x.zip",
        "--wheels",
        tmp_path / "wheels",
        "--platform",
        "windows-x64",
    ]
    subprocess.run(command, check=True)
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        names = set(archive.namelist())
    assert manifest["wheels"] == ["./wheels/a-1-py3-none-any.whl", "./wheels/b-1-py3-none-any.whl"]
    assert {wheel.removeprefix("./") for wheel in manifest["wheels"]} < names
    assert {"__init__.py", "film.py", "passes.py", "LICENSE"} < names
    assert manifest["platforms"] == ["windows-x64"]
    assert manifest["blender_version_min"] == "4.2.0"
    assert manifest["version"] == VERSION
    assert manifest["permissions"].keys() == {"files"}
    modules = {alias for name in names if name.endswith(".py") for alias in imported(ROOT / "blender" / name)}
    assert modules <= {"bpy", *sys.stdlib_module_names}


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module.split(".")[0]


@pytest.fixture
def film(monkeypatch):
    """The module ``film`` of the extension, with a stand-in for bpy."""
    monkeypatch.setitem(sys.modules, "bpy", types.ModuleType("bpy"))
    package = types.ModuleType("stss_blender")
    package.__path__ = [str(ROOT / "blender")]
    monkeypatch.setitem(sys.modules, "stss_blender", package)
    for name in ("passes", "film"):
        monkeypatch.delitem(sys.modules, f"stss_blender.{name}", raising=False)
    return importlib.import_module("stss_blender.film")


def test_a_scene_of_a_stranger_runs_no_program_and_names_no_file(film):
    """The command is a preference: no property of the scene. Options that read or write further files are refused."""
    assert film.harmless("--format png --weights bilinear --skip=off") == [
        "--format",
        "png",
        "--weights",
        "bilinear",
        "--skip=off",
    ]
    for options in (
        "-o x",
        "--camera x.csv",
        "--cluster tcp://x:1",
        "--weights a.safetensors",
        "--weights /x",
        "--profile x",
        "'",
    ):
        with pytest.raises(film.FilmError, match="Options: "):
            film.harmless(options)
    tree = ast.parse((ROOT / "blender" / "__init__.py").read_text())
    stored = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Settings")
    assert [line.target.id for line in stored.body if isinstance(line, ast.AnnAssign)] == ["folder", "options"]


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Blender's Python is 3.11 or newer, and knows -P")
def test_no_module_beside_the_scene_is_imported(film, tmp_path, monkeypatch):
    (tmp_path / "stss.py").write_text("raise SystemExit('a stranger ran')")
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger ran')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    with pytest.raises(film.FilmError, match=r"camera\.csv|lr") as caught:
        film.supersample(tmp_path / "film", 0)
    assert "stranger" not in str(caught.value)


def test_a_folder_with_files_of_others_is_not_rendered_to(film, tmp_path):
    film.take(tmp_path / "new")
    (tmp_path / "new" / "lr").mkdir()
    film.take(tmp_path / "new")
    with pytest.raises(film.FilmError, match="expected an empty folder"):
        film.take(tmp_path)


@pytest.fixture
def bpy_python():
    """A Python that has bpy: ``$STSS_BPY_PYTHON``, or this one."""
    named = os.environ.get("STSS_BPY_PYTHON", sys.executable)
    asked = [named, "-c", "import importlib.util, sys; sys.exit(importlib.util.find_spec('bpy') is None)"]
    if shutil.which(named) is None or subprocess.run(asked, check=False).returncode:
        pytest.skip("no bpy: name a Python that has it in $STSS_BPY_PYTHON (pip install bpy==4.5.*)")
    return named


def test_a_scene_becomes_supersampled_frames_without_a_hand_on_it(bpy_python, tmp_path):
    command = f"{sys.executable} -m stss"
    words = [bpy_python, ROOT / "tests/app/blender_film.py", ROOT / "blender", tmp_path / "film", command]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
    assert (tmp_path / "film" / "found.json").exists(), done.stdout[-2000:] + done.stderr[-2000:]
    found = json.loads((tmp_path / "film" / "found.json").read_text())
    assert found["state"] == ["FINISHED"]
    assert found["kept"], "settings of the scene were changed for good"
    assert found["image"] == "SEQUENCE"
    assert found["index"][0] == 0 < found["index"][1]
    for number in range(1, 5):
        header = read_header(tmp_path / "film" / "lr" / f"frame.{number:04d}.exr")
        assert header.size == (32, 48)
        red = [name for name in header.channels if name.endswith(".basecolor.R")]
        assert float(read_channels(header.path, red)[red[0]].max()) > 0.5  # the monkey's
        out = read_header(tmp_path / "film" / "out" / f"frame.{number:04d}.exr")
        assert out.size == (64, 96)
        assert out.attributes["stss:kind"] == ("SF" if number % 2 else "EF")
    assert len((tmp_path / "film" / "camera.csv").read_text().splitlines()) == 5
