# SPDX-License-Identifier: MIT
"""Kinds of option, and groups of options, that several subcommands share."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from stss.backends import BACKENDS, PRECISIONS

PATH = click.Path(path_type=Path)
Command = TypeVar("Command", bound=Callable[..., Any])


class FrameRange(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]
    """``a:b``, both included."""

    name = "a:b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse; a wrong range is the user's mistake."""
        if isinstance(value, tuple):
            return value
        first, _, last = str(value).partition(":")
        if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
            self.fail(f"expected two frame numbers a:b with a <= b, got {value!r}", param, ctx)
        return int(first), int(last)


def sequence_options(command: Command) -> Command:
    """Add the options of everything that reads a sequence."""
    options = (
        click.option("--profile", default="stss", show_default=True, help="The renderer's conventions: a name or a TOML file."),
        click.option("--camera", type=PATH, help="CSV of frame,x,y,z in the sequence's unit of length, for NoV."),
        click.option("--metallic", type=click.FloatRange(0, 1), help="Constant, for files that have none."),
        click.option("--roughness", type=click.FloatRange(0, 1), help="Constant, for files that have none."),
        click.option(
            "--non-finite",
            type=click.Choice(["refuse", "mask"]),
            default="refuse",
            show_default=True,
            help="NaN and Inf in colour or G-buffer: an error, or 0 and a warping hole.",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def backend_options(command: Command) -> Command:
    """Add the options of everything that computes frames."""
    options = (
        click.option("--backend", type=click.Choice(BACKENDS), default="cl", show_default=True, help="OpenCL, or the reference."),
        click.option("--device", help="Part of an OpenCL device's name (stss devices)  [default: $STSS_DEVICE, or the fastest]"),
        click.option(
            "--precision",
            type=click.Choice(PRECISIONS),
            default="float32",
            show_default=True,
            help="float32-direct: without Winograd; half: activations stored as half.",
        ),
        click.option(
            "--memory-limit",
            type=click.IntRange(1),
            metavar="MIB",
            help="For the network's buffers; larger frames go in strips  [default: half of the device's memory]",
        ),
    )
    for option in reversed(options):
        command = option(command)
    return command


def perceptual_options(command: Command) -> Command:
    """Add the options of what compares images, for metrics that need further packages."""
    options = (
        click.option("--flip", is_flag=True, help="FLIP too  [needs the extra metrics]"),
        click.option("--vmaf", is_flag=True, help="VMAF too  [needs the extra metrics]"),
    )
    for option in reversed(options):
        command = option(command)
    return command


class Size(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]
    """``WIDTHxHEIGHT``, as (height, width)."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse; a wrong size is the user's mistake."""
        if isinstance(value, tuple):
            return value
        width, _, height = str(value).partition("x")
        if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
            self.fail(f"expected a size such as 960x540, got {value!r}", param, ctx)
        return int(height), int(width)


class Names(click.ParamType):  # pyright: ignore[reportMissingTypeArgument]
    """``a,b,c``; empty for none."""

    name = "a,b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        """Split at commas."""
        return value if isinstance(value, tuple) else tuple(name for name in str(value).split(",") if name)
