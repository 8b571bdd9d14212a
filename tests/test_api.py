"""docs/api.md and the code: the page has exactly the public names of the packages."""

import importlib
import re
from pathlib import Path

import pytest

from stss.cli.main import stss

DOCS = Path(__file__).parents[1] / "docs"
PAGE = (DOCS / "api.md").read_text()
SECTIONS = dict(re.findall(r"^## `?([^`\n]+?)`?\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))


def names(section):
    """The first cells of a section's table."""
    return re.findall(r"^\| `([^`]+)` \|", SECTIONS[section], re.MULTILINE)


@pytest.mark.parametrize("package", sorted(SECTIONS.keys() - {"stss_ref", "The command line"}))
def test_the_page_has_what_a_package_hands_on(package):
    module = importlib.import_module(package)
    assert sorted(names(package)) == sorted(module.__all__)
    assert not [name for name in names(package) if not hasattr(module, name)]
    assert {*names(package)} <= {*dir(module)}, "a shell completes what dir lists"


def test_the_page_has_every_stage_and_no_function_that_is_not_there():
    for module, function in (name.split(".") for name in names("stss_ref")):
        assert callable(getattr(importlib.import_module(f"stss_ref.{module}"), function))
    stages = importlib.import_module("conformance.protocol").STAGES
    assert not stages.keys() - {name.split(".")[0] for name in names("stss_ref")}


def test_the_page_has_every_command():
    assert sorted(names("The command line")) == sorted(f"stss {command}" for command in stss.list_commands(None))


@pytest.mark.parametrize(("command", "page"), [("run", "options.md"), ("conform", "conformance.md")])
def test_a_page_has_every_option_of_its_command(command, page):
    options = {name for parameter in stss.get_command(None, command).params for name in parameter.opts if name.startswith("--")}
    assert options <= set(re.findall(r"--[a-z-]+", (DOCS / page).read_text()))
