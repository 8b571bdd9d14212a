"""Commands of training on a page are commands: their programs take the words as they stand. They take hours, so they are parsed alone."""

import argparse
import importlib
import re
import shlex

import click
import pytest

pytest.importorskip("torch", reason="PyTorch is not installed: make test-training")

from tests.app.docs.test_page_code import PAGES, ROOT
from tests.app.docs.test_page_commands import BLOCK, blocks

COMMAND = re.compile(r"python -m (training\.[\w.]+) (.*)")
CELL = re.compile(r"`([^`]*)`")
VALUES = {"first": "0", "split": "training"}
"""Words for variables of a loop that stand for a number or a choice; the others stand for names."""


class ParsedError(Exception):
    """The words were taken."""


def expand(text, variables):
    """The text with the values of the shell's variables."""
    return re.sub(r"\$(\w+)", lambda match: variables.get(match[1], match[0]), text)


def commands():
    """(page, module, words) of each command of training, in blocks and in running text."""
    for page, lines in blocks():
        variables = dict(VALUES)
        for part in (part for line in lines for part in line.split("; ")):
            if match := re.fullmatch(r'(\w)="(.*)"', part):
                variables[match[1]] = expand(match[2], variables)
            elif found := COMMAND.search(expand(part, variables)):
                yield page, found[1], shlex.split(found[2])
    for page in PAGES:
        text = BLOCK.sub("", page.read_text(encoding="utf-8")).replace("\n", " ")
        for found in (found for cell in CELL.findall(text) if (found := COMMAND.fullmatch(cell))):
            yield str(page.relative_to(ROOT)), found[1], shlex.split(found[2])


COMMANDS = [*commands()]


def test_pages_have_commands():
    assert {"training.train", "training.ablate", "training.rivals.run"} <= {module for _, module, _ in COMMANDS}


@pytest.mark.parametrize(("page", "module", "words"), COMMANDS, ids=lambda value: value if isinstance(value, str) else None)
def test_a_command_is_taken(page, module, words, monkeypatch, capsys):
    program, parse = importlib.import_module(module), argparse.ArgumentParser.parse_args

    def parse_alone(parser, arguments=None, namespace=None):
        parse(parser, arguments, namespace)
        raise ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_alone)
    monkeypatch.setattr("sys.argv", [module, *words])
    try:
        if isinstance(maker := getattr(program, "make", None), click.Command):
            maker.make_context(module, words)
        else:
            with pytest.raises(ParsedError):
                program.main()
    except SystemExit:
        pytest.fail(f"{page}: {capsys.readouterr().err.splitlines()[-1]}")
    except click.ClickException as error:
        pytest.fail(f"{page}: {error.format_message()}")
