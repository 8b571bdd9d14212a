"""The rules of CONTRIBUTING.md that a machine can check."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from stss_cl.device.program import source

ROOT = Path(__file__).parents[1]
PACKAGES = ("stss_ground", "stss_ref", "stss_cl", "conformance", "stss", "stss_lab")

MAY_IMPORT = {
    "stss_ground": {"stss_ground"},
    "stss_ref": {"stss_ref"},
    "conformance": {"conformance", "stss_ref", "stss_ground"},
    "stss_cl": {"stss_cl", "stss_ground", *(f"stss_ref.{name}" for name in ("arrays", "constants", "weights"))},
    "stss": {"stss", "stss_cl", "conformance", "stss_ref", "stss_ground"},
    "stss_lab": {"stss_lab", "stss", "stss_cl", "conformance", "stss_ref", "stss_ground"},
}

FLOORS = {
    "stss": "__main__ > cli > demo > quality cluster > check_sequence run > port sequence > frames > pages > devices > images weights",
    "stss_lab": "commands > command_bench command_methods command_stress command_tune > bench methods > stress tune baselines",
    "conformance": "command pytest_plugin > graph > report > suite > explain > judging reference_port > answers mistakes cases > "
    "protocol scenes tolerance > options",
    "stss_cl": "skip > frame > network image_space > device graph liveness options cost",
    "stss_ground": "exit_status commands > optional option_kinds output pages progress toml_table cores > machine arguments > "
    "errors terminal version regular_file shell",
}
"""The rooms of a package from top to bottom: a room imports those on the floors below it, and none beside it."""


def imports_of(package):
    """Every module that a file of the package imports, with the file."""
    for path in sorted((ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                yield from ((path, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                yield path, node.module


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_go_one_way(package):
    for path, module in imports_of(package):
        top = module.split(".")[0]
        if top in PACKAGES:
            allowed = any(module == each or module.startswith(each + ".") for each in MAY_IMPORT[package])
        else:
            allowed = package != "stss_ref" or top == "numpy" or top in sys.stdlib_module_names
        assert allowed, f"{path} imports {module}"


def test_training_has_the_networks_graph_and_no_kernels():
    """Training imports only those modules of the backend that import no OpenCL."""
    modules = {module for _, module in imports_of("training") if module.split(".")[0] == "stss_cl"}
    assert modules == {"stss_cl.graph", "stss_cl.liveness"}


@pytest.mark.parametrize("package", FLOORS)
def test_rooms_import_those_below(package):
    """Every room stands in the plan, and no import leads up or across; a package's ``__init__`` may import anything of its package."""
    floors = {room: i for i, floor in enumerate(FLOORS[package].split(" > ")) for room in floor.split()}
    for path, module in imports_of(package):
        room = path.relative_to(ROOT / package).with_suffix("").parts[0]
        top, *below = module.split(".")
        if room != "__init__" and top == package and below and below[0] != room:
            assert floors[below[0]] > floors[room], f"{path} imports {module}"


def test_the_table_of_kernels_has_the_options_that_they_take():
    """No kernel without a row, none that needs an option its row lacks, no option that the file and what it includes do not know."""
    rows, file = {}, ""
    for line in (ROOT / "kernels" / "README.md").read_text().splitlines():
        cells = line.split("|")
        if len(cells) == 7:
            file = (re.findall(r"\w+\.cl\b", cells[1]) or [file])[0]
            rows.setdefault(file, set()).update(re.findall(r"`([A-Z0-9_]+)`", cells[5]))
    paths = {path.name: path for path in (ROOT / "kernels").glob("*.cl")}
    assert rows.keys() - {""} == paths.keys()
    for path in paths.values():
        conditions = re.findall(r"(#if(?:.*\\\n)*.*)\n#error .*needs", path.read_text())
        needed = set(re.findall(r"(?:#ifndef |!defined[ (])(\w+)", "".join(conditions)))
        assert needed <= rows[path.name], path.name
        assert rows[path.name] <= set(re.findall(r"\w+", source(path.name))), path.name


def test_tests_patch_no_private_name():
    """Not by its text either; ruff finds the others. A test would break where the code inside moves."""
    for path in (ROOT / "tests").rglob("*.py"):
        assert not re.findall(r"setattr\([^)]*\"(?:\w+\.)*_[a-z]\w*\"", path.read_text()), path


def test_no_function_that_is_inlined_promises_restrict():
    """Oclgrind, in the weekly test of memory, fails at what remains of it. `common.clh` takes it away, which not all kernels include."""
    for path in (ROOT / "kernels").glob("*.cl"):
        text = source(path.name)
        if "#define restrict" not in text:
            promise = re.search(r"^(?:INLINE|ALWAYS|static inline)\b[^{]*\brestrict\b", text, re.MULTILINE)
            assert promise is None, (path.name, promise[0])


NOT_ON_WINDOWS = re.compile(
    r"\b(?:os\.(?:O_CLOEXEC|O_DIRECTORY|O_NOFOLLOW|O_NONBLOCK|chown|fchmod|fchown|fork|get[ep]?[gu]id|getloadavg|getpgid|killpg|mkfifo"
    r"|posix_spawnp?|pread|pwrite|sched_getaffinity|setsid|statvfs|uname|WNOHANG)|signal\.(?:SIGALRM|SIGHUP|SIGKILL|alarm)"
    r"|import (?:fcntl|pwd|resource|select|termios))\b"
)
"""Names that Python has on POSIX alone."""
GUARDS = {
    "os.O_CLOEXEC": "if fcntl is not None", "os.fchmod": 'hasattr(os, "fchmod")', "os.getuid": 'hasattr(os, "getuid")',
    "os.killpg": 'hasattr(os, "killpg")|if os.name != "posix"', "os.sched_getaffinity": 'hasattr(os, "sched_getaffinity")',
    "os.statvfs": 'hasattr(os, "statvfs")', "import fcntl": "except ImportError", "signal.SIGKILL": "os.killpg",
}  # fmt: skip
"""What a file that has such a name asks first."""


def test_no_name_is_used_that_windows_lacks():
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        text = path.read_text()
        for name in (
            {match[0] for match in NOT_ON_WINDOWS.finditer(text)} if path.name != "reaper.py" else ()
        ):  # Linux alone runs that
            assert name in GUARDS, f"{path}: {name}"
            assert any(guard in text for guard in GUARDS[name].split("|")), f"{path}: {name} without {GUARDS[name]}"


def test_no_large_file_is_kept():
    """A clone stays small; weights, 1.7 MB each, are the largest."""
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if listing.returncode:
        pytest.skip("not a checkout of git")
    assert not [name for name in filter(None, listing.stdout.split("\0")) if (ROOT / name).stat().st_size > 3e6]


def test_no_package_names_one_above_it():
    """Not in a string either: commands of `stss_lab` arrive by an entry point, and a wheel without it works."""
    for package, above in (("stss", "stss_lab"), ("stss_cl", "stss_lab"), ("conformance", "stss_cl"), ("stss_ref", "stss_cl")):
        for path in (ROOT / package).rglob("*.py"):
            words = [node.value for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Constant)]
            assert not [word for word in words if isinstance(word, str) and word.startswith(f"{above}.")], path
