"""The pages: their width, and that what they name is there."""

import ast
import io
import re
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("stss", "stss_cl", "stss_ref", "conformance", "kernels", "training", "tests", "docs")
PAGES = sorted(
    [
        *(path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md"),
        *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.md")),
    ]
)
WIDTH = 100
FOREIGN_OPTIONS = {"--nthreads", "--uninitialized", "--target"}
"""Of Oclgrind, of pip and of dask."""
ELSEWHERE = {"eval.py", "stage.cl", "network.cl", "stss.sha256"}
"""Files of other projects, named without a folder, rows of the table of bounds, and what a run leaves."""
TITLE = "Low-latency Space-time Supersampling for Real-time Rendering"

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))


@cache
def text(page):
    return page.read_text()


@cache
def prose(page):
    """A page without its blocks of code, and without what a command wrote into it."""
    whole = re.sub(r"^```.*?^```", "", text(page), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^<!-- (?!end).*?(?:^<!-- end -->|\Z)", "", whole, flags=re.MULTILINE | re.DOTALL)


@cache
def named(page):
    """What stands in backticks."""
    return set(re.findall(r"`([^`\n]+)`", prose(page)))


@cache
def anchors(page):
    """The anchors that GitHub makes of a page's headings."""
    headings = re.findall(r"^#+ +(.+?)\s*$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@cache
def file_names():
    return {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*")} | {path.name for path in ROOT.iterdir()}


@cache
def options():
    """What the command line, scripts and ports take."""
    files = [path for folder in FOLDERS for kind in ("py", "cpp", "sh") for path in (ROOT / folder).rglob(f"*.{kind}")]
    return {name for path in files for name in re.findall(r"--[a-z][a-z-]+", text(path))}


def comments(path):
    """Comments and docstrings of a file."""
    if path.suffix != ".py":
        return "\n".join(re.findall(r"//.*", text(path)))
    kinds = (tokenize.COMMENT, tokenize.STRING)
    tokens = tokenize.generate_tokens(io.StringIO(text(path)).readline)
    return "\n".join(token.string for token in tokens if token.type in kinds and token.string.startswith(("#", '"""')))


def module(dotted):
    """The file of the longest beginning of a dotted name that is a module, and the names that are left."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return file, parts[count:]
    return None, parts


def is_there(dotted):
    """Whether a dotted name is a module of ours, or something that a module of ours names."""
    file, left = module(dotted)
    return file is not None and (not left or re.search(rf"\b{left[0]}\b", file.read_text()) is not None)


@each_page
def test_lines_fit_a_screen(page):
    """Tables, code and the targets of links may be longer."""
    for line in prose(page).splitlines():
        if not line.startswith("|"):
            assert len(re.sub(r"\]\([^)]*\)", "]", line)) <= WIDTH, line


def test_the_changelog_has_its_headings_and_fits_a_screen():
    lines = prose(ROOT / "CHANGELOG.md").splitlines()
    assert all(len(re.sub(r"\]\([^)]*\)", "]", line)) <= WIDTH for line in lines if not line.lstrip().startswith("|"))
    kinds = [line[4:] for line in lines if line.startswith("### ")]
    assert set(kinds) <= {"Added", "Changed", "Fixed", "Numbers"}
    released = re.split(r"^## ", prose(ROOT / "CHANGELOG.md"), flags=re.MULTILINE)[1:]
    assert all(len(set(found)) == len(found) for found in (re.findall(r"^### (.+)$", each, re.MULTILINE) for each in released))


@each_page
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if not re.match(r"https?:", target):
            file, _, anchor = target.partition("#")
            there = (page.parent / file).resolve() if file else page
            assert there.exists(), target
            assert not anchor or anchor in anchors(there), target


@each_page
def test_files_that_are_named_exist(page):
    for name in named(page):
        if re.fullmatch(rf"(?:{'|'.join(FOLDERS)})/[\w./*<>-]+", name):
            assert list(ROOT.glob(name.rstrip("/").replace("STAGE", "warp"))), f"{name} is not there"
        elif re.fullmatch(r"[\w-]+\.(?:py|cl|clh|toml)", name):
            assert name in file_names() | ELSEWHERE, f"{name} is not there"


@each_page
def test_modules_that_are_named_exist(page):
    for name in named(page):
        if re.fullmatch(r"(?:stss|stss_cl|stss_ref|conformance|training)(?:\.\w+)+(?::\w+)?", name):
            assert name in ELSEWHERE or is_there(name.replace(":", ".")), f"{name} is not there"


@pytest.mark.parametrize("folder", FOLDERS)
def test_modules_that_comments_name_exist(folder):
    """Comments and docstrings, of Python and of kernels."""
    for path in [*(ROOT / folder).rglob("*.py"), *(ROOT / folder).rglob("*.cl*")]:
        for name in re.findall(r"(?<![\w./])(?:stss|stss_cl|stss_ref|conformance)(?:\.[a-z_]\w*)+(?!\.?\w)", comments(path)):
            assert name in ELSEWHERE or name.endswith(".md") or is_there(name), f"{path}: {name} is not there"


@each_page
def test_options_that_are_named_exist(page):
    """Of our commands and scripts; few are another program's."""
    for name in set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", " ".join(named(page)))):
        assert name in options() | FOREIGN_OPTIONS, f"{name} is not there"


@each_page
def test_code_imports_what_there_is(page):
    for block in re.findall(r"^```python\n(.*?)^```", text(page), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in FOLDERS:
                for alias in node.names:
                    assert is_there(f"{node.module}.{alias.name}"), f"{node.module}: no {alias.name}"


@each_page
def test_tables_are_narrow(page):
    for line in prose(page).splitlines():
        if line.startswith("|"):
            assert line.replace(r"\|", "").count("|") <= 7, line


def test_the_readme_is_short():
    assert len(re.findall(r"\S*\w\S*", text(ROOT / "README.md"))) <= 1000


def test_the_paper_has_one_title():
    for path in [*PAGES, *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))]:
        flat = re.sub(r"\s+", " ", text(path))
        assert path == Path(__file__) or flat.count("Space-time Supersampling for") == flat.count(TITLE), path
        assert path == Path(__file__) or "Efficient Space" not in flat, path
