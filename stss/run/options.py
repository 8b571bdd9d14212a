# SPDX-License-Identifier: MIT
"""The user's choices for a run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from stss.sequence.profiles import Profile
from stss_ref.depth import DepthMode


@dataclass(frozen=True)
class RunOptions:
    """The user's choices for a run.

    Attributes:
        transfer: ``none``, ``srgb``.
        depth: ``clip``, ``scale``.
        rendered: ``even``, ``odd``, ``all``; None = see ``stss.frames.output.choose_rendered``.
        frames: first and last display frame to write, both included; None = all. Frames before the first still serve as history.
        cuts: the first display frame of each shot except the first; it uses no earlier frame.
        also: names of further layers or channels of the files that are warped and enlarged like the colour.
        format: ``exr``, ``png``.
        keep_going: leave out a frame that cannot be read, and go on.
        resume: keep the files of an earlier run that equal those of this run.
        overwrite: replace the files of an earlier run one by one; remove the rest of them once all are written.
    """

    transfer: str = "srgb"
    depth: DepthMode = "scale"
    rendered: str | None = None
    frames: tuple[int, int] | None = None
    cuts: tuple[int, ...] = ()
    also: tuple[str, ...] = ()
    format: str = "exr"
    keep_going: bool = False
    resume: bool = False
    overwrite: bool = False

    @classmethod
    def of(cls, profile: Profile, *, transfer: str | None, depth: DepthMode | None, **others: Any) -> RunOptions:
        """The user's choices; the profile decides on transfer and depth where they are None."""
        usual = "srgb" if profile.color_domain == "linear" else "none"
        return cls(transfer=transfer or usual, depth=depth or profile.depth_normalisation, **others)
