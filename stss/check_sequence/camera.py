# SPDX-License-Identifier: MIT
"""Whether the camera that is given, and NoV, agree with positions and depths."""

from __future__ import annotations

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.frames.buffers import Buffers
from stss.sequence.conventions import normal_dot_view
from stss.sequence.sequence import Sequence
from stss.sequence.solve_camera import solve_camera
from stss_ref.arrays import Array, Image

SURE = 1e-3
"""Largest residual of a solved camera that allows a judgement of the given one."""
NOV_APART = 0.1
"""Median difference of NoV from that of normals and camera, from which there is a warning. Found: up to 0.001 in the
reference films."""
APART = 1e-2
"""Distance between the two, as a share of the distance to the surfaces, from which NoV is wrong."""


def camera_lines(sequence: Sequence, number: int) -> list[Line]:
    """Compare the camera of a frame, if it has one, with the camera that its positions and depths give."""
    if sequence.solves_camera:
        return [("note", "camera: from position and depth of each frame")]
    pose = sequence.frames[number].camera
    buffers = sequence.load(number, color=False, cut=True)
    position = buffers.position.astype(np.float64) * sequence.profile.units_per_cm
    ray = sequence.profile.depth.kind == "ray" and (pose is None or pose.to_camera is None)
    camera = solve_camera(buffers.depth, position, ray=ray)
    if camera is None or camera.residual > SURE:
        return []
    lines = _nov_lines(buffers, position, camera.pose.position) if "nov" in sequence.frames[number].sources else []
    if pose is None:
        return lines
    visible = np.isfinite(buffers.depth) & np.isfinite(position).all(axis=-1)
    away = float(np.median(np.linalg.norm(position[visible] - camera.pose.position, axis=-1)))
    apart = float(np.linalg.norm(pose.position - camera.pose.position)) / away
    is_table = len(sequence.tables) > 1
    if apart <= APART:
        which = "--camera" if is_table else "that of the files"
        return [*lines, ("note", f"camera: {which} agrees with position and depth (frame {number})")]
    by_planes, by_file = (float(np.linalg.norm(place)) for place in (camera.pose.position, pose.position))
    times = by_planes / by_file if by_file > 0 else 1.0
    if not 0.5 < times < 2 and np.linalg.norm(camera.pose.position - times * pose.position) <= APART * by_planes:
        which = "--camera" if is_table else "the files' metadata"
        text = f"camera: frame {number}: position and depth put it {times:.4g} times as far from (0, 0, 0) as {which}"
        return [*lines, ("warning", f"{text}: positions and camera are in different units; write both in the same")]
    words = ["(" + ", ".join(f"{x:.4g}" for x in place) + ")" for place in (pose.position, camera.pose.position)]
    advice = "leave --camera out" if is_table else "the files' metadata belong to another camera: give --camera"
    text = f"camera: frame {number}: given at {words[0]}, but position and depth put it at {words[1]}; {advice}"
    return [*lines, ("warning", text)]


def nov_lines(buffers: Buffers) -> list[Line]:
    """Compare a frame's NoV with that of the camera that its positions and depths give."""
    camera = solve_camera(buffers.depth, buffers.position)
    return [] if camera is None or camera.residual > SURE else _nov_lines(buffers, buffers.position, camera.pose.position)


def _nov_lines(buffers: Buffers, position: Image, camera: Array) -> list[Line]:
    """Whether stored NoV is that of the stored normals, seen from the camera at ``camera``."""
    right = normal_dot_view(buffers.normal, position, camera)
    visible = np.isfinite(buffers.depth) & (buffers.normal != 0).any(axis=-1)
    apart = float(np.median(np.abs(buffers.nov - right)[visible])) if visible.any() else 0.0
    if apart <= NOV_APART:
        return []
    text = f"nov: differs by {apart:.2g} from the dot product of normal and view vector, in the median"
    return [
        (
            "warning",
            f"{text}: is it in other units, do normals point inwards, or is the camera's matrix inverted?",
        )
    ]
