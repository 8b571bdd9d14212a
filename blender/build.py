# SPDX-License-Identifier: MIT
"""Build the extension: one zip with stss and all that ``stss run`` needs, for one platform and one Python. Needs uv (``pip install uv``).

From the repository's folder::

    python blender/build.py -o stss-blender.zip                             # for this platform, Blender 4.2 to 5.0
    python blender/build.py -o win.zip --platform windows-x64 --python 3.13
"""

from __future__ import annotations

import argparse
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).parent
FILES = ("__init__.py", "film.py", "passes.py")
PLATFORMS = {
    "linux-x64": "x86_64-manylinux_2_28",
    "macos-arm64": "aarch64-apple-darwin",
    "windows-x64": "x86_64-pc-windows-msvc",
}
"""Blender's name -> uv's."""
PYTHONS = {"3.11": ("4.2.0", "5.1.0"), "3.13": ("5.1.0", None)}
"""Blender's Python -> the first Blender that has it, and the first that no longer has."""
LEFT_OUT = "opencv-python-headless"
"""Metrics and pages need it, ``stss run`` does not."""


def this_platform() -> str:
    """Blender's name of the platform that this runs on."""
    system = {"darwin": "macos", "win32": "windows"}.get(sys.platform, sys.platform)
    return f"{system}-{'arm64' if platform.machine().lower() in ('arm64', 'aarch64') else 'x64'}"


def install(packages: Path, target: str, python: str) -> None:
    """Build our wheel, and put it and its dependencies into a folder: the wheels' files as they are."""
    uv = shutil.which("uv", path=str(Path(sys.executable).parent)) or shutil.which("uv")
    if uv is None:
        sys.exit("build.py: uv is not installed: pip install uv")
    with tempfile.TemporaryDirectory(prefix="stss-") as folder:
        subprocess.run([uv, "build", "--quiet", "--wheel", "--out-dir", folder, HERE.parent], check=True)
        left_out = Path(folder, "left_out.txt")
        left_out.write_text(LEFT_OUT)
        there = ["--target", packages, "--python-platform", PLATFORMS[target], "--python-version", python]
        options = ["--only-binary", ":all:", "--excludes", left_out, *Path(folder).glob("*.whl")]
        subprocess.run([uv, "pip", "install", "--quiet", "--no-config", "--link-mode", "copy", *there, *options], check=True)
    for name in ("bin", "Scripts", ".lock"):  # of uv, and programs that name a Python that is not there
        shutil.rmtree(packages / name) if (packages / name).is_dir() else (packages / name).unlink(missing_ok=True)


def manifest(target: str, python: str) -> str:
    """The text of the manifest with platform and versions of Blender."""
    first, beyond = PYTHONS[python]
    lines = f'platforms = ["{target}"]\nblender_version_min = "{first}"\n'
    if beyond is not None:
        lines += f'blender_version_max = "{beyond}"  # the first that does not fit\n'
    head, table, rest = (HERE / "blender_manifest.toml").read_text(encoding="utf-8").partition("[permissions]")
    return f"{head}{lines}\n{table}{rest}"


def pack(out: Path, packages: Path, text: str) -> Iterator[tuple[str, int]]:
    """Write the zip: manifest, modules, packages. Yields each folder of ``packages`` and its bytes in the zip."""
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("blender_manifest.toml", text)
        for path in (*(HERE / name for name in FILES), HERE.parent / "LICENSE"):
            archive.write(path, path.name)
        for top in sorted(packages.iterdir()):
            before = archive.fp.tell() if archive.fp else 0
            for path in sorted(top.rglob("*")) if top.is_dir() else [top]:
                if path.is_file():
                    archive.write(path, f"packages/{path.relative_to(packages).as_posix()}")
            yield top.name, (archive.fp.tell() if archive.fp else 0) - before


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the Blender extension.")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the zip to write")
    parser.add_argument("--platform", choices=PLATFORMS, default=this_platform(), help="default: this platform")
    parser.add_argument("--python", choices=PYTHONS, default="3.11", help="3.11 for Blender 4.2 to 5.0, 3.13 for later versions")
    options = parser.parse_args()
    if not options.output.parent.is_dir():
        parser.error(f"-o {options.output}: expected a folder that is there, found none")
    part = options.output.with_name(f".{options.output.name}.part")
    with tempfile.TemporaryDirectory(prefix="stss-") as folder:
        print(f"packages of stss run for {options.platform}, Python {options.python}: from the package index, some 80 MB")
        install(Path(folder), options.platform, options.python)
        try:
            for name, size in pack(part, Path(folder), manifest(options.platform, options.python)):
                if size >= 1e6:
                    print(f"{size / 1e6:6.1f} MB  {name}", flush=True)
            part.replace(options.output)
        finally:
            part.unlink(missing_ok=True)
    print(f"{options.output.stat().st_size / 1e6:6.1f} MB  {options.output}")


if __name__ == "__main__":
    main()
