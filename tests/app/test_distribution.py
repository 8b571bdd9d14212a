"""The wheel: all that the program reads is in it, and it overwrites nothing of others."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from stss_ground.version import DISTRIBUTION, VERSION
from tests.app.wheels import ROOT, build_wheel, unpack_wheel

DATA = (
    *(f"stss_cl/kernels/{path.name}" for path in (ROOT / "kernels").iterdir()),
    *(f"stss/sequence/profile_tables/{path.name}" for path in (ROOT / "stss/sequence/profile_tables").iterdir()),
    "stss_cl/device/tuning.toml",
    "stss/weights/realtime.safetensors",
    "stss/weights/antialiased.safetensors",
    *(f"stss_judge/conformance/suite/{path.name}" for path in (ROOT / "conformance/suite").glob("*.py")),
    "stss_judge/conformance/examples/cpp/port.cpp",
)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build_wheel(".", tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def site(wheel, tmp_path_factory):
    """A folder in which the wheel is installed."""
    return unpack_wheel(wheel, tmp_path_factory.mktemp("site"))


def run(site, code, path=""):
    """Python code where ``site`` is a site folder, after the folders of ``path`` and before the rest."""
    start = f"import site, sys; at = len(sys.path); site.addsitedir({str(site)!r}); sys.path[:] = sys.path[at:] + sys.path[:at]\n"
    start += f"sys.path[:0] = {path.split()!r}\n"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "-c", start + code]
    return subprocess.run(command, cwd=site, env=environment, check=False, capture_output=True, text=True)


def test_the_wheel_has_all_that_the_program_reads(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    assert not set(DATA) - names
    sources = {
        str(path.relative_to(ROOT)) for package in ("stss", "stss_cl", "stss_ref") for path in (ROOT / package).rglob("*.py")
    }
    assert not sources - names


def test_the_wheel_overwrites_nothing_of_others(wheel):
    tops = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    information = f"{DISTRIBUTION.replace('-', '_')}-{VERSION}.dist-info"
    assert tops == {"stss", "stss_cl", "stss_ref", "stss_ground", "stss_lab", "stss_judge", "stss_judge.pth", information}


def test_what_is_installed_finds_its_judge(site):
    done = run(site, "import conformance, stss_ground.version; print(conformance.__file__, stss_ground.version.VERSION)")
    assert done.stdout.split() == [str(site / "stss_judge/conformance/__init__.py"), VERSION], done.stderr


COMMAND = "from stss.cli.main import main; sys.argv = ['stss', 'conform']; main()"


def test_another_package_of_that_name_is_one_line(site, tmp_path):
    """Theirs is imported, ours is untouched, and the line says where both are and what to do."""
    (tmp_path / "conformance").mkdir()
    (tmp_path / "conformance" / "__init__.py").write_text("")
    done = run(site, COMMAND, path=str(tmp_path))
    assert done.returncode == 2
    assert re.fullmatch(r"stss: conformance: expected .*\n", done.stderr), done.stderr
    assert str(tmp_path / "conformance") in done.stderr
    done = run(site, COMMAND, path=f"{site / 'stss_judge'} {tmp_path}")
    assert "expected either --port" in done.stderr


TARGETS = {
    "x86_64-manylinux_2_28": "",
    "aarch64-manylinux_2_28": "",
    "aarch64-apple-darwin": "",
    "x86_64-apple-darwin": "",
    "x86_64-pc-windows-msvc": "",
    "x86_64-unknown-linux-musl": "openimageio",  # it has no wheels for musl
}
"""Platform -> the requirement that has no wheel there."""


@pytest.mark.parametrize("target", TARGETS)
def test_all_that_stss_needs_has_wheels(target):
    """On every platform but those that lack one, which is named."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        pytest.skip("uv is not installed")
    command = [uv, "pip", "compile", "--quiet", "--only-binary", ":all:", "--python-version", "3.12", "--python-platform", target]
    done = subprocess.run([*command, "pyproject.toml"], cwd=ROOT, check=False, capture_output=True, text=True, timeout=300)
    if "Failed to fetch" in done.stderr:
        pytest.skip("the package index is not reached")
    if TARGETS[target]:
        assert done.returncode
        assert f"{TARGETS[target]}>=" in done.stderr
    else:
        assert not done.returncode, done.stderr
        assert ("pocl-binary-distribution" in done.stdout) == (target == "x86_64-manylinux_2_28")
