"""Every ``stss`` command that a page shows is one: it exists, and takes the options and words that it is given. Those of the README run."""

import re
import shlex
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from stss.cli.main import stss
from stss.demo import write_demo_sequence

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "examples").rglob("*.md")),
]
BLOCK = re.compile(r"^( *)```(?:sh|bash)?\n(.*?)^ *```", re.M | re.S)
CELL = re.compile(r"`(stss [a-z][^`]*)`")


def commands():
    """(page, line) of every command in blocks and of those in running text that have an argument or an option."""
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        for block in BLOCK.finditer(text):
            for line in block[2].replace("\\\n", " ").splitlines():
                if line.strip().startswith("stss "):
                    yield page.relative_to(ROOT), line.strip()
        for cell in CELL.finditer(BLOCK.sub("", text).replace("\n", " ")):
            words = shlex.split(cell[1])
            if len(words) > 2 and words[1] in stss.list_commands(None) and "-o" in words:
                yield page.relative_to(ROOT), cell[1]


def parse(words):
    """Parse, without running anything."""
    group, command = click.Context(stss, info_name="stss"), stss
    while isinstance(command, click.Group):
        found = command.get_command(group, words[0])
        if found is None:
            raise click.UsageError(f"no command {words[0]}")
        command, words = found, words[1:]
    command.make_context(command.name, list(words), parent=group)


@pytest.mark.parametrize(("page", "line"), sorted(set(commands())), ids=str)
def test_a_page_shows_commands_that_can_be_typed(page, line):
    words = shlex.split(line, comments=True)
    if {"|", "&&", ";"} & set(words):
        words = words[: min(words.index(word) for word in ("|", "&&", ";") if word in words)]
    try:
        parse([word for word in words[1:] if not word.startswith(">")])
    except click.exceptions.Exit:
        pass
    except click.ClickException as error:
        pytest.fail(f"{page}: {line}: {error.format_message()}")


def test_the_commands_of_the_readme_run_as_they_stand(tmp_path, monkeypatch):
    write_demo_sequence(tmp_path, 4, (16, 24))
    (tmp_path / "frames").rename(tmp_path / "shot")
    (tmp_path / "truth").rename(tmp_path / "full")
    monkeypatch.chdir(tmp_path)
    section = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Use it")[2]
    lines = [shlex.split(line, comments=True) for line in BLOCK.search(section)[2].splitlines()]
    assert [words[1] for words in lines] == ["check", "run", "compare"]
    for words in lines:
        assert CliRunner().invoke(stss, words[1:], catch_exceptions=False).exit_code == 0, words
    assert len(list(Path("out").glob("frame.*.exr"))) == 4
    assert Path("page.html").stat().st_size > 0


@pytest.mark.parametrize("line", ["run a -o b --nothing", "nothing", "run a", "run a -o b --skip off|exact"])
def test_a_wrong_command_would_be_found(line):
    with pytest.raises(click.ClickException):
        parse(line.split())
