# SPDX-License-Identifier: MIT
"""Check an engine's frames in memory, as ``stss check`` checks files."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

from stss.check_sequence.alignment import alignment_lines
from stss.check_sequence.camera import nov_lines
from stss.check_sequence.motion_convention import judge_motion
from stss.check_sequence.static_positions import judge_static_geometry
from stss.check_sequence.value_statistics import Line, Values, motion_lines
from stss.frames.buffers import Buffers
from stss.frames.check_buffers import check_buffers
from stss_ground.arguments import require_kind
from stss_ground.errors import InputError


def check_frames(frames: Iterable[Buffers], *, linear: bool = True) -> list[Line]:
    """Whether motion, depth, normals, positions, object numbers and colours of neighbouring frames fit each other.

    The positions of static geometry give the camera, and the camera gives the right values of the other planes: signs, units, axes,
    spaces, jitter.

    Args:
        frames: display frames in a row, all in memory; about ten in which the camera moves and turns are best.
        linear: whether colours are scene-linear.

    Returns:
        ("warning" or "note", one line of text), warnings first. The lines are those of ``stss check``, and may change.

    Raises:
        InputError: a plane does not fit `Buffers`; or no two frames follow each other without a cut, at one size.
    """
    require_kind("frames", frames, Iterable, "frames")
    row = list(frames)
    for frame in row:
        check_buffers(frame)
    pairs = [(a, b) for a, b in pairwise(row) if b.number == a.number + 1 and a.size == b.size and not b.cut]
    if not pairs:
        raise InputError("frames: expected two of successive numbers, of one size and without a cut between; found none")
    values = Values()
    for frame in row:
        values.add_buffers(frame)
    geometry = judge_static_geometry(pairs)
    lines = geometry.left_of(motion_lines(judge_motion(pairs), "its profile"))
    lines += [*values.buffer_lines(), *values.color_lines(linear=linear), *geometry.lines()]
    lines += [*nov_lines(row[0]), *alignment_lines(row, linear=linear)]
    return sorted(lines, key=lambda line: line[0] == "note")
