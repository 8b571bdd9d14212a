# SPDX-License-Identifier: MIT
"""Build the extension, one zip with the wheels of stss and of all that it needs, for one platform.

From the repository's folder::

    python blender/build.py -o stss-blender.zip                                  # for this platform
    python blender/build.py -o win.zip --platform win_amd64 --python 3.11        # for another one
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
PLATFORMS = {
    "manylinux_2_28_x86_64": "linux-x64",
    "macosx_11_0_arm64": "macos-arm64",
    "win_amd64": "windows-x64",
}
"""pip's name to Blender's."""


def collect(folder: Path, platform: str | None, python: str | None) -> None:
    """Have pip build our wheel and fetch those that it needs."""
    pip = [sys.executable, "-m", "pip"]
    subprocess.run([*pip, "wheel", "--quiet", "--no-deps", "-w", folder, HERE.parent], check=True)
    ours = next(folder.glob("spacetime_supersampling-*.whl"))
    there = [
        "--only-binary=:all:",
        *(["--platform", platform] if platform else []),
        *(["--python-version", python] if python else []),
    ]
    subprocess.run([*pip, "download", "--quiet", *there, "-d", folder, ours], check=True)


def pack(out: Path, wheels: list[Path], platform: str | None) -> None:
    """Write the zip: manifest, modules, wheels."""
    manifest = (HERE / "blender_manifest.toml").read_text(encoding="utf-8")
    named = "".join(f'  "./wheels/{wheel.name}",\n' for wheel in sorted(wheels))
    head, table, rest = manifest.partition("[permissions]")
    if platform is not None:
        head += f'platforms = ["{PLATFORMS[platform]}"]\n'
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
    parser.add_argument("--python", help="Blender's Python, such as 3.11; default: this one's")
    parser.add_argument("--wheels", type=Path, help="a folder of wheels to take, rather than ask pip")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="stss-") as folder:
        if given.wheels is None:
            collect(Path(folder), given.platform, given.python)
        pack(given.output, list((given.wheels or Path(folder)).glob("*.whl")), given.platform)


if __name__ == "__main__":
    main()
