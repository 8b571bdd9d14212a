"""Checks of text for `make check`: licence lines; links of pages, and that what they and comments name is there."""

import ast
import re
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("stss_ground", "stss_ref", "stss_cl", "conformance", "stss", "stss_lab")
FOLDERS = (*PACKAGES, "kernels", "training", "tests", "docs", "blender", "packaging")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*")) if path.is_file()]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"] + [path for path in FILES if path.suffix == ".md"]
SOURCES = [path for path in FILES if path.suffix in (".py", ".cl", ".clh", ".cpp", ".sh")]
KERNELS = [path for path in SOURCES if path.parent.name == "kernels"]
ELSEWHERE = {
    "src/ng_model_gym/core/evaluator/metrics.py",
    "utils/matlab_metric.py",
    "--nthreads",
    "--protocol",
    "--uninitialized",
    "--target",
    "eval.py",
    "stage.cl",
    "network.cl",
    "stss.sha256",
    "stss.commands",
}
"""Options of Oclgrind, pip and dask; files of other projects, named without a folder; what a run leaves; a group of entry points."""

COMMENTS = re.compile(r"""((?<!\w)"{3}[\s\S]*?"{3}|#.*)|"{3}[\s\S]*?"{3}|"(?:\\.|[^"\\\n])*"|'(?:\\.|[^'\\\n])*'""")
"""Comments and docstrings of Python; a # within a string is none. The tokens of all files would take three seconds."""

text = cache(Path.read_text)
NAMES = {path.name for path in [*FILES, *ROOT.iterdir()]}
OF_KERNELS = {word for path in KERNELS for word in re.findall(r"\b[A-Z]\w*", re.sub(r"//.*", "", text(path)))}
OPTIONS = {name for path in SOURCES for name in re.findall(r"--[a-z][a-z-]+", text(path))}


def prose(page):
    """A page without its blocks of code, and without what a command wrote into it."""
    whole = re.sub(r"^```.*?^```", "", text(page), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"^<!-- (?!end).*?(?:^<!-- end -->|\Z)", "", whole, flags=re.MULTILINE | re.DOTALL)


def comments(path):
    """Comments and docstrings of a file."""
    if path.suffix != ".py":
        return "\n".join(re.findall(r"//.*", text(path)))
    return "\n".join(filter(None, COMMENTS.findall(text(path))))


def is_there(dotted):
    """Whether a dotted name is a module of ours, or something that the longest beginning that is a module names."""
    parts = dotted.replace(":", ".").split(".")
    for count in range(len(parts), 0, -1):
        place = ROOT.joinpath(*parts[:count])
        for file in (place.with_suffix(".py"), place / "__init__.py"):
            if file.is_file():
                return count == len(parts) or re.search(rf"\b{parts[count]}\b", text(file)) is not None
    return False


def bad_links(page):
    """Links to files and headings that are not there; anchors as GitHub makes them."""
    for target in re.findall(r"\]\((?!https?:)([^)\s]+)\)", prose(page)):
        file, _, anchor = target.partition("#")
        there = (page.parent / file).resolve() if file else page
        headings = re.findall(r"^#+ +(.+?)\s*$", prose(there), re.MULTILINE) if anchor and there.is_file() else []
        anchors = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
        if not there.exists() or (anchor and anchor not in anchors):
            yield f"link {target} leads nowhere"


def missing_names(page):
    """Files, modules, options and imports that a page names and that are not there."""
    names = set(re.findall(r"`([^`\n]+)`", prose(page))) - ELSEWHERE
    for name in names:
        if re.fullmatch(rf"(?:{'|'.join(FOLDERS)})/[\w./*<>-]+", name):
            there = list(ROOT.glob(name.rstrip("/").replace("STAGE", "warp").replace("COMMAND", "*")))
        elif re.fullmatch(r"[\w-]+\.(?:py|cl|clh|toml)", name):
            there = name in NAMES
        elif re.fullmatch(rf"(?:{'|'.join(PACKAGES)}|training)(?:\.\w+)+(?::\w+)?", name):
            there = is_there(name)
        else:
            there = set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", name)) <= OPTIONS | ELSEWHERE
        if not there:
            yield f"`{name}` is not there"
    for block in re.findall(r"^```python\n(.*?)^```", text(page), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in FOLDERS:
                yield from (f"no {node.module}.{a.name}" for a in node.names if not is_there(f"{node.module}.{a.name}"))


def bad_lines(page):
    """Lines over 100 columns, without tables and the targets of links; tables over six columns, or whose head ends a paragraph."""
    lines = prose(page).splitlines()
    for before, line in pairwise(["", *lines]):
        if re.fullmatch(r" *\|[ :]*-[-|: ]+", line) and not before.lstrip().startswith("|"):
            yield f"the head of a table, expected on a line of its own: {before}"
        if line.startswith("|") and line.replace(r"\|", "").count("|") > 7:
            yield f"more than six columns: {line}"
        elif not line.lstrip().startswith("|") and len(re.sub(r"\]\([^)]*\)", "]", line)) > 100:
            yield f"over 100 columns: {line}"


def missing_modules(path):
    """Modules that comments and docstrings name and that are not there."""
    for name in re.findall(rf"(?<![\w./])(?:{'|'.join(PACKAGES)})(?:\.[a-z_]\w*)+(?!\.?\w)", comments(path)):
        if name not in ELSEWHERE and not name.endswith(".md") and not is_there(name):
            yield f"{name} is not there"


def missing_decisions(path):
    """Decisions that a page or a comment names by number and that are not there."""
    text = re.sub(r"\s+(?://|#)?\s*", " ", prose(path) if path.suffix == ".md" else comments(path))
    pages = {int(page.name[:4]) for page in (ROOT / "docs" / "decisions").glob("0*.md")}
    names = re.findall(
        r"(?<!its )\bdecision (\d+)\b|(?<!its )\bdecisions ((?:\d+(?:, | and )?)+)|\bdecisions/[\w.-]+, (0\d{3})\b", text
    )
    for number in re.findall(r"\d+", " ".join(" ".join(words) for words in names)):
        if int(number) not in pages:
            yield f"decision {number} is not there"


def missing_references(path):
    """Files and -D options that comments name and that are not there."""
    text = re.sub(r"\s+(?://|#)?\s*", " ", comments(path))
    for name in re.findall(r"(?<![\w./*-])(?:[\w-]+/)*[\w-]+\.(?:clh?|md|py|toml)\b(?!\.\w)", text):
        there = any((folder / name).is_file() for folder in (ROOT, path.parent)) if "/" in name else name in NAMES
        if not there and name not in ELSEWHERE:
            yield f"{name} is not there"
    if path in KERNELS:
        options = re.findall(r"-D ((?:[A-Z][A-Z0-9_]*(?:, | and |\b))+)", text)
        for name in {word for some in options for word in re.findall(r"[A-Z]\w*", some)} - OF_KERNELS:
            yield f"-D {name} is in no kernel"


def threes_by_call(path):
    """Functions that are not inlined with a float3: Intel's runtime hands it over wrongly (docs/devices.md)."""
    if path in KERNELS:
        for kind, name, takes in re.findall(
            r"^(?:CALLED|static __attribute__\(\(noinline\)\)) (\w+) (\w+)\((.*?)\)$", text(path), re.M | re.S
        ):
            if "float3" in (kind, *re.findall(r"\w+", takes)):
                yield f"{name}: float3 in a function that is not inlined; expected float4"


def long_comments(path):
    """Lines of comments that clang-format would break, but that it leaves alone for the tables."""
    for line in re.findall(r"^ *//.{118,}", text(path), re.MULTILINE) if path in KERNELS else ():
        if len(line) > 120:
            yield f"over 120 columns: {line}"


def missing_licence(path):
    """The first line of what is installed."""
    ours = path.relative_to(ROOT).parts[0] in (*PACKAGES, "kernels") and path.suffix in (".py", ".cl", ".clh")
    if ours and not re.match(r"(#|//) SPDX-License-Identifier: MIT\n", text(path)):
        yield "the first line does not say the licence"


def broken_promises(page):
    """Rows of docs/promises.md without a test, or with one that is not there."""
    for row in re.findall(r"^\| (?!promise)(.*)\|$", text(page), re.MULTILINE):
        names = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", row)
        if not names:
            yield f"no test: {row}"
        for file, name in names:
            if not (ROOT / file).is_file() or f"\ndef {name}(" not in text(ROOT / file):
                yield f"{file}::{name} is not there"


def bad_workflow(path):
    """Actions at a tag, which can be moved, and rights that are not limited."""
    if not re.search(r"^permissions:\n  contents: read$", text(path), re.MULTILINE):
        yield "no permissions: contents: read"
    for action in re.findall(r"uses: *(\S+)", text(path)):
        if not re.fullmatch(r"[\w./-]+@[0-9a-f]{40}", action):
            yield f"{action}: expected the digest of a commit"


def faults():
    """Every fault with its file."""
    for checks, paths in (
        ((bad_links, missing_names, missing_decisions, bad_lines), PAGES),
        ((missing_modules, missing_references, missing_decisions, missing_licence, threes_by_call, long_comments), SOURCES),
        ((broken_promises,), [ROOT / "docs" / "promises.md"]),
        ((bad_workflow,), [*(ROOT / ".github" / "workflows").glob("*.yml"), ROOT / "examples" / "conform.yml"]),
    ):
        for path in paths:
            yield from (f"{path.relative_to(ROOT)}: {fault}" for check in checks for fault in check(path))


if __name__ == "__main__":
    sys.exit("\n".join(faults()) or 0)
