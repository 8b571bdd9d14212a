# SPDX-License-Identifier: MIT
"""Build the extension, one zip with the wheels of stss and of all that it needs, for one platform.

From the repository's folder::

    python blender/build.py -o stss-blender.zip                                  # for this platform
    python blender/build.py -o win.zip --platform windows-x64 --python 3.11      # for another one; needs uv
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
FILES = ("__init__.py", "film.py", "passes.py")
MANYLINUX = [f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)] + ["manylinux2014_x86_64", "manylinux1_x86_64"]
MACOS = [f"macosx_{major}_0_{kind}" for major in range(14, 10, -1) for kind in ("arm64", "universal2")]
PLATFORMS = {
    "linux-x64": ("x86_64-manylinux_2_28", MANYLINUX),
    "macos-arm64": ("aarch64-apple-darwin", MACOS),
    "windows-x64": ("x86_64-pc-windows-msvc", ["win_amd64"]),
}
"""Blender's name -> uv's, and the tags of wheels that fit, the best first."""


def collect(folder: Path, platform: str | None, python: str) -> None:
    """Have pip build our wheel and fetch those that it needs.

    For another platform uv settles what is needed: pip would read the markers of requirements for this one.
    """
    pip = [sys.executable, "-m", "pip"]
    subprocess.run([*pip, "wheel", "--quiet", "--no-deps", "-w", folder, HERE.parent], check=True)
    ours = next(folder.glob("spacetime_supersampling-*.whl"))
    if platform is None:
        subprocess.run([*pip, "download", "--quiet", "--only-binary=:all:", "-d", folder, ours], check=True)
        return
    target, tags = PLATFORMS[platform]
    settle = [
        "uv",
        "pip",
        "compile",
        "--quiet",
        "--only-binary",
        ":all:",
        "--python-platform",
        target,
        "--python-version",
        python,
    ]
    needed = folder / "needed.txt"
    subprocess.run([*settle, "--no-header", "--no-annotate", "-o", needed, HERE.parent / "pyproject.toml"], check=True)
    fitting = [word for tag in tags for word in ("--platform", tag)]
    there = ["--only-binary=:all:", "--no-deps", "--python-version", python, *fitting]
    subprocess.run([*pip, "download", "--quiet", *there, "-d", folder, "-r", needed], check=True)


def pack(out: Path, wheels: list[Path], platform: str | None) -> None:
    """Write the zip: manifest, modules, wheels."""
    manifest = (HERE / "blender_manifest.toml").read_text(encoding="utf-8")
    named = "".join(f'  "./wheels/{wheel.name}",\n' for wheel in sorted(wheels))
    head, table, rest = manifest.partition("[permissions]")
    if platform is not None:
        head += f'platforms = ["{platform}"]\n'
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("blender_manifest.toml", f"{head}wheels = [\n{named}]\n\n{table}{rest}")
        for name in FILES:
            archive.write(HERE / name, name)
        archive.write(HERE.parent / "LICENSE", "LICENSE")
        for wheel in sorted(wheels):
            archive.write(wheel, f"wheels/{wheel.name}", zipfile.ZIP_STORED)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description="Build the Blender extension.")
    parser.add_argument("-o", "--output", type=Path, required=True, help="the zip to write")
    parser.add_argument("--platform", choices=PLATFORMS, help="default: this one")
    parser.add_argument(
        "--python", default=f"{sys.version_info[0]}.{sys.version_info[1]}", help="Blender's Python; default: this one's"
    )
    parser.add_argument("--wheels", type=Path, help="a folder of wheels to take, rather than ask pip")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stss-") as folder:
        if given.wheels is None:
            collect(Path(folder), given.platform, given.python)
        pack(given.output, list((given.wheels or Path(folder)).glob("*.whl")), given.platform)


if __name__ == "__main__":
    main()
