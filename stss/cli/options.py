# SPDX-License-Identifier: MIT
"""Kinds of option, and groups of options, that several subcommands share."""

from __future__ import annotations

from typing import Any

import click

from stss.frames.backends import BACKENDS
from stss.frames.compute_options import ComputeOptions
from stss.images.color import TRANSFERS
from stss.quality.flip_vmaf import Perceptual
from stss.sequence.background import MOTION_SOURCES
from stss.sequence.choose_weights import AUTO
from stss.sequence.find_files import MAX_DIGITS
from stss.sequence.reader import SequenceOptions
from stss_cl.options import PRECISIONS, SKIPS
from stss_ground.commands import gather_options, group_options
from stss_ground.option_kinds import Names, Number, ReadName, ReadPath
from stss_ground.terminal import echo

MAX_MIB = 1 << 24
"""Largest ``--memory-limit``, in MiB: 16 TiB."""
MAX_COUNT = 10**6
"""Largest number of frames or repetitions that an option accepts."""


class FrameRange(click.ParamType):  # pyrefly: ignore[implicit-any-type-argument]
    """``a:b``, both included."""

    name = "a:b"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        """Parse; a wrong range is the user's mistake."""
        if isinstance(value, tuple):
            return value
        first, _, last = str(value).partition(":")
        if not (_is_whole(first, MAX_DIGITS) and _is_whole(last, MAX_DIGITS) and int(first) <= int(last)):
            expected = f"two frame numbers a:b with a <= b, of at most {MAX_DIGITS} digits"
            self.fail(f"expected {expected}, got {value!r}", param, ctx)
        return int(first), int(last)


class FrameNumbers(click.ParamType):  # pyrefly: ignore[implicit-any-type-argument]
    """``a,b,...``, as a sorted tuple."""

    name = "a,b,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        """Parse; a word that is no frame number is the user's mistake."""
        if isinstance(value, tuple):
            return value
        words = [word.strip() for word in str(value).split(",")]
        if not all(_is_whole(word, MAX_DIGITS) for word in words):
            self.fail(f"expected frame numbers a,b,..., got {value!r}", param, ctx)
        return tuple(sorted({int(word) for word in words}))


class TransferName(click.Choice):  # pyrefly: ignore[implicit-any]  # generic only since click 8.2
    """A transfer; ``hdr``, which scripts of early users have, gives the default, with a warning."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse; None: the default."""
        if value == "hdr":
            echo("warning: --transfer hdr is gone: srgb carries highlights past the network; the default is taken", err=True)
            return None
        return super().convert(value, param, ctx)


sequence_options = gather_options(
    "The sequence",
    "reading",
    SequenceOptions,
    click.option(
        "--profile",
        type=ReadName(),
        help="The renderer's conventions: a name or a TOML file  [default: the profile that fits the channels' names]",
    ),
    click.option(
        "--camera",
        type=ReadPath(),
        help="CSV of frame,x,y,z in the sequence's unit of length  [default: from the files, or from position and depth]",
    ),
    click.option("--metallic", type=Number(0, 1), help="A constant, for files without this buffer."),
    click.option("--roughness", type=Number(0, 1), help="A constant, for files without this buffer."),
    *(
        click.option(
            f"--{name}", type=click.Choice(MOTION_SOURCES), default="files", show_default=True, help=f"Source of {text}."
        )
        for name, text in (
            ("background", "the background's motion: camera computes it, for files without it"),
            (
                "static",
                "the motion of static surfaces, whose stencil is 0, and of the background: camera computes it",
            ),
        )
    ),
    click.option(
        "--non-finite",
        type=click.Choice(["refuse", "mask"]),
        default="refuse",
        show_default=True,
        help="NaN and Inf in colour or G-buffer: an error, or 0 and a warping hole.",
    ),
)
"""Options of commands that read a sequence; the command gets ``reading``, a ``SequenceOptions``."""


frame_options = group_options(
    "The frames",
    click.option(
        "--rendered",
        type=click.Choice(["even", "odd", "all"]),
        help="The frames to take as rendered  [default: those with colour; if all have it, every second of each shot]",
    ),
    click.option(
        "--cuts", type=FrameNumbers(), default=(), metavar="a,b,...", help="The first frame of each shot except the first."
    ),
    click.option(
        "--also",
        type=Names(),
        default=(),
        metavar="NAME,...",
        help="Layers or channels to warp and enlarge beside the colour, without the network; alpha is always included.",
    ),
    click.option("--frames", type=FrameRange(), help="First and last frame to write; earlier ones still serve as history."),
    click.option(
        "--transfer",
        type=TransferName(TRANSFERS),
        help="Transfer from the files' colour to the network's"
        "  [default: srgb for scene-linear files, none for display-referred ones]",
    ),
    click.option("--depth", type=click.Choice(["clip", "scale"]), help="How depth is normalised  [default: the profile's]"),
)
"""Options of commands that write frames of a sequence; see ``stss.run.options.RunOptions``."""


backend_options = gather_options(
    "The device",
    "compute",
    ComputeOptions,
    click.option("--backend", type=click.Choice(BACKENDS), default="cl", show_default=True, help="OpenCL, or the reference."),
    click.option("--device", help="Part of an OpenCL device's name (stss devices)  [default: $STSS_DEVICE, or the fastest]"),
    click.option(
        "--precision",
        type=click.Choice(PRECISIONS),
        default="float32",
        show_default=True,
        help="float32-direct: without Winograd; half: activations stored as half; bfloat16: on a processor's matrix units.",
    ),
    click.option(
        "--memory-limit",
        type=click.IntRange(1, MAX_MIB),
        metavar="MIB",
        callback=lambda _, __, value: None if value is None else value << 20,
        help="Memory for the network's buffers; larger frames are computed in strips  [default: half of the device's memory]",
    ),
    click.option(
        "--skip",
        type=click.Choice(SKIPS),
        default="exact",
        show_default=True,
        help="off: compute everything; exact: do not compute unchanged parts again, with the same bits.",
    ),
    click.option(
        "--accumulate/--no-accumulate",
        default=None,
        help="Mix each frame with the two before it, so that it flickers less  [default: if the weights are made for aliased input]",
    ),
)
"""Options of commands that compute frames; the command gets ``backend`` and ``compute``, a ``ComputeOptions``."""


weights_option = click.option(
    "--weights",
    type=ReadName(),
    default=AUTO,
    show_default=True,
    help="realtime or antialiased, which come with stss; a .safetensors file; bilinear: no network; auto: the set that suits the frames.",
)


perceptual_options = gather_options(
    "Metrics",
    "perceptual",
    Perceptual,
    click.option("--flip", is_flag=True, help="FLIP too  [needs the extra metrics]"),
    click.option("--vmaf", is_flag=True, help="VMAF too  [needs the extra metrics]"),
)
"""Options of metrics that need further packages; the command gets ``perceptual``, a ``Perceptual``."""


def _is_whole(word: str, digits: int) -> bool:
    """Whether ``word`` is a whole number of at most ``digits`` ASCII digits, perhaps below 0; ``int`` raises for more than 4300."""
    word = word.removeprefix("-")
    return word.isascii() and word.isdecimal() and len(word.lstrip("0")) <= digits
