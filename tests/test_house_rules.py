"""The rules of CONTRIBUTING.md that a machine can hold us to."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from stss_cl.device.program import source

ROOT = Path(__file__).parents[1]
PACKAGES = ("stss_ref", "stss_cl", "conformance", "stss")
SOURCES = sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
TESTS = sorted((ROOT / "tests").rglob("*.py"))

MAY_IMPORT = {
    "stss_ref": {"stss_ref"},
    "conformance": {"conformance", "stss_ref"},
    "stss_cl": {"stss_cl", *(f"stss_ref.{name}" for name in ("arrays", "constants", "regular_file", "weights"))},
    "stss": {"stss", "stss_cl", "conformance", "stss_ref"},
}

FLOORS = {
    "stss": "__main__ > cli > demo bench > quality cluster > check run > port sequence baselines > conform stress frames"
    " > pages > images weights devices color optional > output > errors terminal version machine",
    "conformance": "run_suite stored_cases > suite > confirm diagnosis first_layer known_failures terms > rehearsal > judge"
    " > findings > answers mistakes cases > protocol scenes tolerance",
    "stss_cl": "skip > frame > network image_space > device > toml_table errors",
}
"""The rooms of a package from top to bottom: a room imports those on the floors below it, and none beside it."""


def name(path):
    return str(path.relative_to(ROOT))


def imports(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield node.module


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_imports_go_one_way(path):
    package = path.relative_to(ROOT).parts[0]
    for module in imports(path):
        top = module.split(".")[0]
        if top in PACKAGES:
            assert any(module == allowed or module.startswith(allowed + ".") for allowed in MAY_IMPORT[package]), module
        elif package == "stss_ref":
            assert top == "numpy" or top in sys.stdlib_module_names, module


@pytest.mark.parametrize("path", [p for p in SOURCES if p.relative_to(ROOT).parts[0] in FLOORS], ids=name)
def test_rooms_import_those_below(path):
    """Every room stands in the plan, and no import leads up or across; a package's ``__init__`` may import anything of its package."""
    package, *rest = path.relative_to(ROOT).with_suffix("").parts
    if rest == ["__init__"]:
        return
    floors = {room: i for i, floor in enumerate(FLOORS[package].split(" > ")) for room in floor.split()}
    for module in imports(path):
        top, *below = module.split(".")
        if top == package and below and below[0] != rest[0]:
            assert floors[below[0]] > floors[rest[0]], f"{rest[0]} imports {module}"


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_can_be_taken_in_at_a_glance(package):
    for folder in {path.parent for path in SOURCES if path.relative_to(ROOT).parts[0] == package} - {ROOT / "stss_ref"}:
        assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= 16, folder


@pytest.mark.parametrize("path", [p for p in SOURCES + TESTS if p.name not in ("tolerance.py", "test_house_rules.py")], ids=name)
def test_bounds_stand_in_one_table(path):
    found = re.findall(r"\b(?:atol|rtol|isclose|allclose|approx|assert_almost_equal)\b", path.read_text())
    assert not found


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_sizes(path):
    """A file fits a few screens, a function one: docstrings do not count."""
    tree = ast.parse(path.read_text())
    assert len(path.read_text().splitlines()) <= 300
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            lines = sum(statement.end_lineno - statement.lineno + 1 for statement in body)
            assert lines <= 40, f"{node.name}: {lines} lines"


def test_one_class_name_means_one_thing():
    """In all packages; a protocol may have the name of the class that it describes."""
    homes = {}
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                protocol = any(isinstance(base, ast.Name) and base.id == "Protocol" for base in node.bases)
                homes.setdefault(node.name, []).append((name(path), protocol))
    twice = {each: places for each, places in homes.items() if len([1 for _, protocol in places if not protocol]) > 1}
    assert not twice


@pytest.mark.parametrize("path", SOURCES, ids=name)
def test_every_file_says_its_licence(path):
    assert path.read_text().startswith("# SPDX-License-Identifier: MIT\n")


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
        needed = set(
            re.findall(r"(?:#ifndef |!defined\()(\w+)", "".join(re.findall(r"(#if.*)\n#error .*needs", path.read_text())))
        )
        assert needed <= rows[path.name], path.name
        assert rows[path.name] <= set(re.findall(r"\w+", source(path.name))), path.name


def test_no_large_file_is_kept():
    """A clone stays small; weights, 1.7 MB each, are the largest."""
    found = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    if found.returncode:
        pytest.skip("not a checkout of git")
    assert not [name for name in filter(None, found.stdout.split("\0")) if (ROOT / name).stat().st_size > 3e6]
