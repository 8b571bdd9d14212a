# SPDX-License-Identifier: MIT
"""Where the camera was: from a table, or from what a renderer wrote into its files."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stss.errors import InputError
from stss.images.headers import Header
from stss.sequence.profiles import Profile
from stss_ref.arrays import Array


@dataclass(frozen=True)
class Camera:
    """One frame's camera, in scene units.

    Attributes:
        position: (3,) float64.
        to_camera: (4, 4) float64, world to camera, for column vectors; None where only the position is known.
    """

    position: Array
    to_camera: Array | None = None


def read_cameras(path: Path) -> dict[int, Camera]:
    """A table ``frame,x,y,z``, in scene units.

    Raises:
        InputError: not such a table; or a frame is in it twice.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error
    if not rows or [word.strip() for word in rows[0]] != ["frame", "x", "y", "z"]:
        raise InputError(f"{path}: expected the first line to be frame,x,y,z; found {','.join(rows[0]) if rows else 'nothing'}")
    cameras: dict[int, Camera] = {}
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue
        try:
            number, position = int(row[0]), np.array([float(word) for word in row[1:]])
        except ValueError:
            number, position = -1, np.empty(0)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(f"{path}: line {line}: expected a frame number and three numbers; found {','.join(row)}")
        if number in cameras:
            raise InputError(f"{path}: line {line}: frame {number} is there twice")
        cameras[number] = Camera(position)
    return cameras


def camera_of(header: Header, profile: Profile) -> Camera | None:
    """The camera as a file's metadata have it: ``worldToCamera``, or the profile's attributes; None without either."""
    matrix = header.attributes.get("worldToCamera")
    if isinstance(matrix, tuple) and len(matrix) == 16:
        to_camera = np.array(matrix, dtype=np.float64).reshape(4, 4)
        # EXR's own convention is row vectors, translation in the last row; some writers store the transpose.
        if np.array_equal(to_camera[:, 3], (0, 0, 0, 1)):
            to_camera = to_camera.T
        if np.isfinite(to_camera).all() and abs(np.linalg.det(to_camera[:3, :3])) > 0:
            return Camera(-np.linalg.solve(to_camera[:3, :3], to_camera[:3, 3]), to_camera)
    for names in profile.camera:
        position = _numbers(header.attributes, names)
        if position is not None:
            return Camera(position)
    return None


def _numbers(attributes: Mapping[str, object], names: tuple[str, ...]) -> Array | None:
    try:
        values = np.array([float(str(attributes[name])) for name in names])
    except (KeyError, ValueError):
        return None
    return values if np.isfinite(values).all() else None
