# SPDX-License-Identifier: MIT
"""Commands that are imported only when they are called, and options in groups."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import fields
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from stss_ground.arguments import suggest
from stss_ground.errors import InputError, PipeClosedError
from stss_ground.option_kinds import ReadName, ReadPath, WrittenFile, WrittenFolder
from stss_ground.optional import require_own_conformance
from stss_ground.output.places import require_places

Command = TypeVar("Command", bound=Callable[..., Any])
Sections = Mapping[str, Mapping[str, tuple[str, str]]]
"""Heading -> command -> ``module:attribute`` and the command's purpose, in one line."""

IMAGES = (".exr", ".png")


def places_of(ctx: click.Context) -> tuple[dict[str, Path], list[Path], list[Path]]:
    """The files of a command's parameters: option -> the file that it writes; the files that it reads; the folders that it writes into."""
    outputs, inputs, folders = dict[str, Path](), list[Path](), list[Path]()
    for parameter in ctx.command.params:
        if (value := ctx.params.get(str(parameter.name))) is None:
            continue
        if isinstance(parameter.type, WrittenFile):
            outputs[parameter.opts[-1]] = value
        elif isinstance(parameter.type, WrittenFolder):
            folders.append(value)
        elif isinstance(parameter.type, (ReadPath, ReadName)):
            several = value if getattr(parameter, "multiple", False) or parameter.nargs != 1 else [value]
            inputs += [place for each in several for place in parameter.type.reads(each)]
    return outputs, inputs, folders


class Commands(click.Group):
    """A group whose commands stand in sections; each is imported only when it is called."""

    def __init__(self, *words: Any, sections: Sections, **options: Any):
        super().__init__(*words, **options)
        self.sections = sections

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All names, in the order of the sections."""
        del ctx
        return [name for commands in self.sections.values() for name in commands]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None if there is none of that name."""
        del ctx
        require_own_conformance()  # before a command imports it
        for commands in self.sections.values():
            if cmd_name in commands:
                module, _, attribute = commands[cmd_name][0].partition(":")
                return getattr(import_module(module), attribute)
        return None

    def resolve_command(self, ctx: click.Context, args: list[str]) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the command that was named.

        Raises:
            click.UsageError: there is none.
        """
        names = self.list_commands(ctx)
        if args[0] not in names and not args[0].startswith("-"):
            raise click.UsageError(f"no command {args[0]}; expected one of {', '.join(names)}{suggest(args[0], names)}", ctx)
        return super().resolve_command(ctx, args)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command that was named."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise PipeClosedError from error
        except KeyboardInterrupt:  # for which click prints an empty line
            raise click.exceptions.Abort from None

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a list for each section."""
        del ctx
        for heading, commands in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name, short) for name, (_, short) in commands.items()])


def group_options(heading: str, *options: Callable[[Any], Any]) -> Callable[[Command], Command]:
    """Add options to a command that stand together in the help of a `Subcommand`."""

    def add(command: Any) -> Any:
        before = len(getattr(command, "__click_params__", ()))
        for option in reversed(options):
            command = option(command)
        for parameter in command.__click_params__[before:]:
            parameter.heading = heading
        return command

    return add


def gather_options(
    heading: str, argument: str, kind: type[Any], *options: Callable[[Any], Any]
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add options as `group_options` does; the command gets those of ``kind``'s fields as one object.

    Args:
        heading: in the help.
        argument: of the command: its name.
        kind: a dataclass; each of its fields has the name of one of the options.
        options: to add; the command gets those that are no fields of ``kind`` one by one.
    """
    names = [each.name for each in fields(kind)]

    def add(command: Callable[..., Any]) -> Callable[..., Any]:
        @wraps(command)
        def gather(**values: Any) -> Any:
            group = kind(**{name: values.pop(name) for name in names})
            return command(**values, **{argument: group})

        return group_options(heading, *options)(gather)

    return add


def refuse_options(use: str, names: Collection[str]) -> None:
    """Refuse options of the command that runs which would have no effect.

    Args:
        use: when they have one, for the error: "only with --onnx", "not with --onnx".
        names: of the parameters.

    Raises:
        InputError: the user has set one of them.
    """
    context = click.get_current_context()
    for parameter in context.command.params:
        if parameter.name in names and context.get_parameter_source(str(parameter.name)) is ParameterSource.COMMANDLINE:
            raise InputError(f"{parameter.opts[-1]}: {use}")


class Subcommand(click.Command):
    """A command of ``stss``.

    It refuses, before it begins, to write a file that it reads, by the kinds of its parameters (``stss_ground.option_kinds``). Its
    options stand in the help under the headings that `group_options` gave them.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse; if a shell expanded a pattern to many images, the error says so."""
        images = [word for word in args if word.lower().endswith(IMAGES)]
        try:
            return super().parse_args(ctx, args)
        except click.UsageError as error:
            if len(images) > 1 and "extra argument" in error.message:
                raise click.UsageError(
                    f"{images[0]} and {len(images) - 1} more: expected a folder, or a pattern like name.####.exr, not each file",
                    ctx,
                ) from None
            raise

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, unless it would write a file that it reads.

        Raises:
            InputError: it would.
        """
        outputs, inputs, folders = places_of(ctx)
        require_places(outputs, inputs, new_folders=folders)
        return super().invoke(ctx)

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write a list for each heading; options without one come first."""
        groups: dict[str, list[tuple[str, str]]] = {"Options": []}
        for parameter in self.get_params(ctx):
            if isinstance(parameter, click.Option) and (record := parameter.get_help_record(ctx)) is not None:
                groups.setdefault(getattr(parameter, "heading", "Options"), []).append(record)
        for heading, records in groups.items():
            with formatter.section(heading):
                formatter.write_dl(records)
