# SPDX-License-Identifier: MIT
"""Positions of the camera and of moving things at a frame: plain arithmetic, no Blender.

Lengths are in metres, angles in radians; the time `t` is in frames from the first one (frame 1 of the files is `t` = 0).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

Vector = tuple[float, float, float]
Spec = Mapping[str, Any]
STILL: Vector = (0.0, 0.0, 0.0)
FLOOR = 0.3
"""Least height of the camera; metres."""


def add(a: Sequence[float], b: Sequence[float], scale: float = 1.0) -> Vector:
    """``a + scale * b``."""
    return (a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2])


def distance(a: Sequence[float], b: Sequence[float]) -> float:
    """Euclidean distance."""
    return math.dist(a, b)


def turned(v: Sequence[float], angle: float) -> Vector:
    """Rotate about the vertical axis."""
    c, s = math.cos(angle), math.sin(angle)
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


def pose(motion: Spec | None, t: float) -> tuple[Vector, Vector]:
    """The offset of a moving thing from its place, and its turn.

    Args:
        motion: ``kind`` and its numbers; None: the thing rests.
        t: frames from the first one.

    Returns:
        offset: metres, to be added to the place.
        turn: Euler angles XYZ, to be added to the object's own.
    """
    if motion is None:
        return STILL, STILL
    kind, rate, phase = motion["kind"], motion["rate"], motion["phase"]
    spin = motion.get("spin", STILL)
    turn = (spin[0] * t, spin[1] * t, spin[2] * t)
    if kind == "slide":
        return add(STILL, motion["along"], rate * (t - motion["middle"])), turn
    if kind == "circle":
        radius, angle = motion["radius"], phase + rate * t
        return (radius * math.cos(angle), radius * math.sin(angle), 0.0), add(turn, (0.0, 0.0, angle))
    if kind == "bob":
        return (0.0, 0.0, motion["radius"] * (1 + math.sin(phase + rate * t))), turn
    if kind == "swing":
        return STILL, (motion["radius"] * math.sin(phase + rate * t), 0.0, 0.0)
    if kind == "spin":
        return STILL, turn
    raise ValueError(f"motion: unknown kind {kind!r}")


def shot_at(shots: Sequence[Spec], t: float) -> Spec:
    """The shot on screen at `t`: a new shot's first frame is a camera cut."""
    return [shot for shot in shots if shot["first"] <= max(t, 0)][-1]


def camera(shots: Sequence[Spec], t: float) -> tuple[Vector, Vector, float]:
    """The camera at `t`.

    Args:
        shots: each with ``first``, ``move``, ``eye``, ``target``, ``rate`` a frame, ``shake`` (radians), ``phase``.
        t: frames from the first one; -1 for the frame before it.

    Returns:
        eye, target: world positions.
        roll: about the view axis, radians.
    """
    shot = shot_at(shots, t)
    eye, target, rate, move = shot["eye"], shot["target"], shot["rate"], shot["move"]
    gone = rate * (t - shot["first"])
    view = add(target, eye, -1)
    length = math.sqrt(sum(x * x for x in view))
    ahead = tuple(x / length for x in view)
    if move == "orbit":
        eye = add(target, turned(add(eye, target, -1), gone))
    elif move == "pan":
        target = add(eye, turned(view, gone))
    elif move == "tilt":
        target = add(target, (0.0, 0.0, gone * length))
    elif move == "dolly":
        eye, target = add(eye, ahead, gone), add(target, ahead, gone)
    elif move == "truck":
        aside = turned((ahead[0], ahead[1], 0.0), math.pi / 2)
        eye, target = add(eye, aside, gone), add(target, aside, gone)
    elif move == "crane":
        eye = add(eye, (0.0, 0.0, gone))
    elif move != "rest":
        raise ValueError(f"camera: unknown move {move!r}")
    eye, target, roll = _shaken(shot, t, eye, target, length)
    return (eye[0], eye[1], max(eye[2], FLOOR)), target, roll


def _shaken(shot: Spec, t: float, eye: Vector, target: Vector, length: float) -> tuple[Vector, Vector, float]:
    """Shake the camera as a hand or an explosion does, by sines that do not repeat within a clip."""
    amplitude, p = shot["shake"], shot["phase"]
    shift = amplitude * length
    target = add(
        target,
        (math.sin(2.1 * t + p), math.sin(1.7 * t + 2 * p), math.sin(2.6 * t + 3 * p)),
        shift,
    )
    eye = add(eye, (math.sin(1.3 * t + 4 * p), math.sin(0.9 * t + 5 * p), math.sin(1.1 * t + 6 * p)), 0.3 * shift)
    return eye, target, amplitude * math.sin(1.9 * t + 7 * p)
