"""The Blender extension: its zip, and a scene from nothing to supersampled frames where a Python with bpy is there."""

import ast
import importlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest

from stss.cli.run import run
from stss.images.headers import read_header
from stss.images.read_write import read_channels, read_rgb
from stss_ground.version import VERSION

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[3]


def load_build():
    spec = importlib.util.spec_from_file_location("stss_blender_build", ROOT / "blender/build.py")
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    return build


@pytest.mark.parametrize(("python", "versions"), [("3.11", ("4.2.0", "5.1.0")), ("3.13", ("5.1.0", None))])
def test_the_zip_has_its_packages_apart_from_those_of_blender(tmp_path, python, versions):
    """A list of wheels in the manifest would put our NumPy before Blender's, for every add-on."""
    build = load_build()
    (tmp_path / "packages" / "a").mkdir(parents=True)
    (tmp_path / "packages" / "a" / "b.py").write_text("")
    (tmp_path / "packages" / "c.py").write_text("")
    parts = [*build.pack(tmp_path / "x.zip", tmp_path / "packages", build.manifest("windows-x64", python))]
    assert [name for name, _ in parts] == ["a", "c.py"]
    with zipfile.ZipFile(tmp_path / "x.zip") as archive:
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        names = set(archive.namelist())
    assert "wheels" not in manifest
    assert {"__init__.py", "film.py", "passes.py", "LICENSE", "packages/a/b.py", "packages/c.py"} < names
    assert manifest["platforms"] == ["windows-x64"]
    assert (manifest["blender_version_min"], manifest.get("blender_version_max")) == versions
    assert manifest["version"] == VERSION
    assert manifest["permissions"].keys() == {"files"}
    assert max(map(len, [manifest["tagline"], *manifest["permissions"].values()])) <= 64  # Blender's limit
    modules = {alias for name in names if name.endswith(".py") and "/" not in name for alias in imported(ROOT / "blender" / name)}
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
    with pytest.raises(film.FilmError, match=r"^Options: --frmat: a scene may give only --accumulate, .*, --weights$"):
        film.harmless("--frmat=png")
    with pytest.raises(film.FilmError, match=r"^Options: a\.safetensors: names a path, which a scene may not: it may"):
        film.harmless("--weights a.safetensors")
    tree = ast.parse((ROOT / "blender" / "__init__.py").read_text())
    settings = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == "Settings")
    assert [line.target.id for line in settings.body if isinstance(line, ast.AnnAssign)] == ["folder", "options"]


def test_a_command_of_the_preferences_keeps_the_backslashes_of_windows(film, monkeypatch):
    assert film.split_words("'my stss' run\\ it # 1") == ["my stss", "run it", "#", "1"]
    monkeypatch.setattr(film, "os", types.SimpleNamespace(name="nt"))
    assert film.split_words(r'"C:\Program Files\stss.exe" -m C:\a') == [r"C:\Program Files\stss.exe", "-m", r"C:\a"]


def test_each_option_of_a_run_is_harmless_or_has_a_reason_not_to_be(film):
    """A new one is among the first, or here."""
    with_a_path_or_an_address = {"--camera", "--cluster", "--out", "--profile"}
    of_the_extension = {"--background", "--overwrite", "--rendered", "--resume"}
    names = {name for each in run.params for name in (*each.opts, *each.secondary_opts) if name.startswith("--")}
    assert names == film.HARMLESS | with_a_path_or_an_address | of_the_extension


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Blender's Python is 3.11 or newer, and knows -P")
def test_no_module_beside_the_scene_is_imported(film, tmp_path, monkeypatch):
    (tmp_path / "stss.py").write_text("raise SystemExit('a stranger ran')")
    (tmp_path / "numpy.py").write_text("raise SystemExit('a stranger ran')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    monkeypatch.setattr(film, "PACKAGES", ROOT)
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "camera.csv").touch()
    with pytest.raises(film.FilmError, match=r"camera\.csv|lr") as error:
        for _ in film.supersample(tmp_path / "film", 0):
            pass
    assert "stranger" not in str(error.value)


def test_cuts_among_the_options_are_those_of_the_render_too(film):
    assert film.cuts_of(["--format", "png", "--cuts", "3,9", "--skip=off"]) == ([3, 9], ["--format", "png", "--skip=off"])
    assert film.cuts_of(["--cuts=4"]) == ([4], [])
    for words in (["--cuts"], ["--cuts", "a"], ["--cuts", "--skip"]):
        with pytest.raises(film.FilmError, match="--cuts: expected numbers of frames"):
            film.cuts_of(words)


@pytest.mark.parametrize(("written", "free", "said"), [
    (b"exr", 10, ""),
    (b"ex", 1, "the disk is full"),  # cut short; Blender finishes without an error
    (b"", 0, "the disk is full"),
    (None, 10, "frame 7: Blender wrote no file"),
])  # fmt: skip
def test_a_frame_is_whole_or_not_there(film, tmp_path, monkeypatch, written, free, said):
    scene = types.SimpleNamespace(render=types.SimpleNamespace(), cycles=None, frame_set=lambda number: None, name="s")

    def render(**more):
        if written is not None:
            Path(scene.render.filepath).write_bytes(written)

    film.bpy.ops = types.SimpleNamespace(render=types.SimpleNamespace(render=render))
    monkeypatch.setattr(shutil, "disk_usage", lambda path: types.SimpleNamespace(free=free))
    if not said:
        film.render_frame(scene, None, 7, tmp_path / "frame.0007.exr", colour=True)
        assert [path.name for path in tmp_path.iterdir()] == ["frame.0007.exr"]
        return
    with pytest.raises(film.FilmError, match=said):
        film.render_frame(scene, None, 7, tmp_path / "frame.0007.exr", colour=True)
    assert not [*tmp_path.iterdir()]


def test_the_program_ends_with_the_operator(film, tmp_path):
    """Esc closes the generator."""
    (tmp_path / "camera.csv").touch()
    steps = film.supersample(tmp_path, 0, [sys.executable, "-c", f"""
import pathlib, time
pathlib.Path({str(tmp_path / "started")!r}).touch()
time.sleep(5)
pathlib.Path({str(tmp_path / "ended")!r}).touch()
"""])  # fmt: skip
    assert next(steps).startswith("stss starts")
    while not (tmp_path / "started").exists():
        next(steps)
    start = time.monotonic()
    steps.close()
    assert time.monotonic() - start < 4
    assert not (tmp_path / "ended").exists()


def test_another_engine_is_refused_before_anything_is_rendered(film):
    scene = types.SimpleNamespace(render=types.SimpleNamespace(engine="BLENDER_EEVEE"))
    with pytest.raises(
        film.FilmError, match="expected the engine Cycles, found BLENDER_EEVEE: only Cycles writes the pass Object"
    ):
        film.require(scene)


def test_a_zip_for_no_folder_is_refused_before_packages_are_fetched(tmp_path):
    words = [sys.executable, ROOT / "blender" / "build.py", "-o", tmp_path / "no" / "x.zip"]
    process = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (process.returncode, process.stdout) == (2, "")
    assert "no/x.zip: expected a folder that is there" in process.stderr


def test_an_extension_without_packages_says_so(film, tmp_path):
    with pytest.raises(film.FilmError, match="no stss: install the zip"):
        next(film.supersample(tmp_path, 0))


def test_a_folder_with_files_of_others_is_not_rendered_to(film, tmp_path):
    film.take(tmp_path / "new")
    (tmp_path / "new" / "lr").mkdir()
    film.take(tmp_path / "new")
    with pytest.raises(film.FilmError, match="expected an empty folder"):
        film.take(tmp_path)


@pytest.fixture(scope="module")
def bpy_python():
    """A Python that has bpy: ``$STSS_BPY_PYTHON``, or this one; and its version, as 3.11."""
    interpreter = os.environ.get("STSS_BPY_PYTHON", sys.executable)
    code = "import importlib.util, sys; print(*sys.version_info[:2], sep='.'); sys.exit(importlib.util.find_spec('bpy') is None)"
    process = (
        subprocess.run([interpreter, "-c", code], capture_output=True, text=True, check=False)
        if shutil.which(interpreter)
        else None
    )
    if process is None or process.returncode:
        pytest.skip("no bpy: make test-blender installs it")
    return interpreter, process.stdout.strip()


@pytest.fixture(scope="module")
def packed(bpy_python, tmp_path_factory):
    """The zip, built as the page says."""
    out = tmp_path_factory.mktemp("built") / "stss-blender.zip"
    command = [sys.executable, "blender/build.py", "-o", out, "--python", bpy_python[1]]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert re.search(r"^ *\d+\.\d MB  pyopencl$", process.stdout, re.M)
    return out


def test_blender_takes_the_manifest_and_the_licences_go_together(bpy_python, packed):
    """By the program behind ``blender --command extension validate``; add-ons are under the GPL 3, with which these licences go."""
    find = "import importlib.util, pathlib; print(pathlib.Path(importlib.util.find_spec('bpy').origin).parent)"
    home = Path(subprocess.run([bpy_python[0], "-c", find], capture_output=True, text=True, check=True).stdout.strip())
    program, tags = next(home.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py")), next(home.rglob("extensions/tags.py"))
    process = subprocess.run(
        [bpy_python[0], program, "validate", "--valid-tags", tags, packed], capture_output=True, text=True, check=False
    )
    assert "Success" in process.stdout, process.stdout + process.stderr
    with zipfile.ZipFile(packed) as archive:
        every = [name for name in archive.namelist() if re.fullmatch(r"packages/[^/]+\.dist-info/METADATA", name)]
        texts = [archive.read(name).decode().partition("\n\n")[0] for name in every]
    assert len(texts) > 10
    for text in texts:
        if text.splitlines()[1] == "Name: pocl-binary-distribution":
            continue  # names none; the texts of PoCL (MIT), LLVM (Apache) and hwloc (BSD) lie beside its libraries
        licences = [line for line in text.splitlines() if line.startswith(("License", "Classifier: License"))]
        assert re.search(r"MIT|BSD|Apache|PSF", " ".join(licences)), text
    assert not re.search("opencv|scipy|torch", " ".join(every))


def test_a_scene_becomes_supersampled_frames_without_a_hand_on_it(bpy_python, packed, tmp_path):
    """The zip is installed as Blender installs it, and the operator of the button called."""
    words = [bpy_python[0], ROOT / "tests/app/blender/blender_film.py", packed, tmp_path]
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    environment["BLENDER_USER_RESOURCES"] = str(tmp_path / "blender")
    process = subprocess.run(words, env=environment, capture_output=True, text=True, check=False, timeout=900)
    assert (tmp_path / "found.json").exists(), process.stdout[-2000:] + process.stderr[-2000:]
    assert "stss: 8 of 8 frames" in process.stdout
    report = json.loads((tmp_path / "found.json").read_text())
    assert report["state"] == ["FINISHED"] * 2
    assert "--cuts 99: expected frames of 2 to 8" in report["refused"]
    assert report["kept"], "settings of the scene were changed for good"
    assert report["overwrite"] == [[number != 4 for number in range(1, 9)], [False] * 8]
    first, saved = process.stdout.index("rendering frame 2, 2 of 8"), process.stdout.index("frame.0003.exr.part'")
    assert first < saved, "progress is printed when all is done"
    assert report["image"] == "SEQUENCE"
    assert report["index"][0] == 0 < report["index"][1]
    assert not [place for place in [*report["python"], report["numpy"]] if str(tmp_path) in place and "packages" in place]
    film = tmp_path / "film"
    see_camera(film)
    names = [f"frame.{number:04d}.exr" for number in range(1, 9)]
    assert sorted(path.name for path in film.glob("*/frame*")) == sorted(names * 2)
    for number, name in enumerate(names, 1):
        header = read_header(film / "lr" / name)
        assert header.size == (32, 48)
        red = [channel for channel in header.channels if channel.endswith(".basecolor.R")]
        assert float(read_channels(header.path, red)[red[0]].max()) > 0.5  # the monkey's
        out = read_header(film / "out" / name)
        assert out.size == (64, 96)
        assert out.attributes["stss:kind"] == ("SF" if number % 2 else "EF")
    frames, truth = ([read_rgb(folder / name) for name in names] for folder in (film / "out", tmp_path / "truth"))
    for at in range(2, 7):  # the monkey moves 3 pixels a frame: each frame is nearest to its own truth
        errors = [float(np.square(frames[at] - truth[other]).mean()) for other in (at - 1, at, at + 1)]
        assert np.isfinite(frames[at]).all()
        assert errors[1] < 0.7 * min(errors[0], errors[2]), errors
    page = re.search(r"```python\n(.*?)```", (ROOT / "docs/blender.md").read_text(), re.S).group(1)
    (tmp_path / "stss-blender.zip").symlink_to(packed)
    words = [bpy_python[0], "-c", page + "import os; os._exit(0)"]  # for a user who has no extension yet
    shell = environment | {"PWD": str(tmp_path), "BLENDER_USER_RESOURCES": str(tmp_path / "other")}  # Blender goes by PWD
    again = subprocess.run(words, cwd=tmp_path, env=shell, capture_output=True, text=True, check=False, timeout=900)
    assert again.returncode == 0, again.stderr
    assert len([*(tmp_path / "stss" / "out").glob("frame.*.png")]) == 8
    see_trap(report["trap"], tmp_path, process.stdout)
    rows = measure_saving(bpy_python[0], tmp_path)
    assert [name for name, _, _ in rows] == ["full-1", "full-2", "stss"]
    assert all(took > 0 and 15 < psnr < 60 for _, took, psnr in rows)
    assert rows[0][2] < rows[1][2], "more samples, no better"


def see_camera(film):
    """A surface lies in the direction in which its own pixel looks: by the rows that give the background its motion."""
    table = np.loadtxt(film / "camera.csv", delimiter=",", skiprows=1)
    assert table.shape == (8, 13)
    names = [f"ViewLayer.Position.{axis}" for axis in "XYZ"]
    place = np.stack([*read_channels(film / "lr" / "frame.0003.exr", names).values()], axis=-1).reshape(-1, 3)
    y, x = (axis.ravel() for axis in np.mgrid[:32, :48])
    u, v, w = table[2, 4:].reshape(3, 3) @ (place - table[2, 1:4]).T
    floor = place[:, 2] == 0
    error = np.abs([(u / w + 1) * 24 - 0.5 - x, (v / w + 1) * 16 - 0.5 - y])[:, floor]
    assert floor.sum() > 100
    assert np.median(error) < 0.3, "the mean of four samples lies nearer to the middle than half a pixel"
    assert read_header(film / "out" / "frame.0002.exr").attributes["stss:background"] == "motion from the camera"


def see_trap(report, folder, output):
    """The scene of `blender_film.make_trap`: refused before an hour is spent; moving objects have numbers; a marker's cut is a cut."""
    assert {name: line.strip().split(": ")[1] for name, line in report["refused"].items()} == {
        "unsaved": "Folder", "use_multiview": "Stereoscopy", "frame_step": "Frame Range, Step", "cuts": "Options",
        "camera": "Camera, Type", "relative": "Folder", "format": "stss",
    }  # fmt: skip
    assert report["tried"] == 1, "a wrong value is told after the first frame, not after the last"
    assert report["done"] == "{'FINISHED'}"
    assert report["kept"]
    assert sorted(report["index"]) == [0, 1, 2, 3], "armature, shape key, instance of a collection; the plane rests"
    assert report["index"][-1] == 0
    assert report["image"] == [str(folder / "trap" / "out" / "frame.1001.exr"), True]
    assert not (folder / "mine").exists(), "the compositor wrote small frames over the user's files"
    for line in (
        "Render Region: the frames are whole",
        "Motion Blur: not",
        "view layers: zweite Ebene ö alone",
        "Compositor: not",
        "Sequencer: not",
        "66 x 46 pixels",
    ):
        assert f"Warning: {line}" in output or f"size: the frames have {line}" in output, line
    kinds = {}
    for path in sorted((folder / "trap" / "out").glob("*.exr")):
        header = read_header(path)
        assert header.size == (46, 66)
        kinds[int(path.stem[-4:])] = header.attributes["stss:kind"]
        assert {
            channel.rpartition(".")[0].partition(".")[0] for channel in read_header(folder / "trap/lr" / path.name).channels
        } == {"zweite Ebene ö"}
    assert kinds == {1001: "SF", 1002: "EF", 1003: "SF", 1004: "SF", 1005: "EF", 1006: "SF"}
    first = folder / "trap/lr/frame.1001.exr"
    names = [
        "zweite Ebene ö.basecolor.R",
        *(name for name in read_header(first).channels if re.search("IndexOB|Object Index", name)),
    ]
    ball, index = read_channels(first, names).values()
    assert (index[:, index.shape[1] // 2 :] > 0).any(), "beyond the region"
    assert np.median(ball[index == report["index"][2]]) > 0.4, "a material that only an instance uses"
    assert {int(number) for number in np.unique(index)} == {0, 1, 2, 3}


def measure_saving(python, folder):
    """What ``measure_saving.py`` prints of the scene: (name, seconds of a frame, PSNR)."""
    words = [python, ROOT / "blender/measure_saving.py", folder / "shot.blend", "-o", folder / "saving", "--frames", "1", "3"]
    words += ["--samples", "2", "--truth", "8", "--stss", f"{sys.executable} -m stss", "--options", "--backend ref --cuts 2"]
    process = subprocess.run(words, capture_output=True, text=True, check=False, timeout=900)
    assert process.returncode == 0, process.stdout + process.stderr
    rows = re.findall(r"^([\w-]+): ([\d.]+) s, ([\d.]+) dB, SSIM 0\.\d{3}$", process.stdout, re.M)
    return [(name, float(took), float(psnr)) for name, took, psnr in rows]
