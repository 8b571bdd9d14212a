# SPDX-License-Identifier: MIT
"""Whether the camera of ``--camera`` agrees with positions and depths."""

from __future__ import annotations

import numpy as np

from stss.check_sequence.value_statistics import Line
from stss.sequence.reader import Sequence
from stss.sequence.solve_camera import solve_camera

SURE = 1e-3
"""Largest residual of a solved camera that allows a judgement of the given one."""
APART = 1e-2
"""Distance between the two, as a share of the distance to the surfaces, from which NoV is wrong."""


def camera_lines(sequence: Sequence, number: int) -> list[Line]:
    """Compare the camera of a frame, if it has one, with the camera that its positions and depths give."""
    pose = sequence.frames[number].camera
    if pose is None:
        return [("note", "camera: from position and depth of each frame")] if sequence.solves_camera else []
    buffers = sequence.load(number, color=False)
    position = buffers.position.astype(np.float64) * sequence.profile.units_per_cm
    ray = sequence.profile.depth.kind == "ray" and pose.to_camera is None
    solved = solve_camera(buffers.depth, position, ray=ray)
    if solved is None or solved.residual > SURE:
        return []
    visible = np.isfinite(buffers.depth) & np.isfinite(position).all(axis=-1)
    away = float(np.median(np.linalg.norm(position[visible] - solved.pose.position, axis=-1)))
    apart = float(np.linalg.norm(pose.position - solved.pose.position)) / away
    if apart <= APART:
        return [("note", f"camera: --camera agrees with position and depth (frame {number})")]
    words = ["(" + ", ".join(f"{x:.4g}" for x in place) + ")" for place in (pose.position, solved.pose.position)]
    return [
        (
            "warning",
            f"camera: frame {number}: given at {words[0]}, but position and depth put it at {words[1]}; leave --camera out",
        )
    ]
