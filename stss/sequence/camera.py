# SPDX-License-Identifier: MIT
"""The camera's positions: from a table, or from the metadata of a renderer's files."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stss.images.headers import Header
from stss.sequence.profiles import Profile
from stss_ground.errors import InputError
from stss_ground.regular_file import read_regular
from stss_ref.arrays import Array

MAX_BYTES = 64 << 20
"""Largest size of a table; a line takes about 40 bytes."""
PLACE = ("frame", "x", "y", "z")
FAR = ("ux", "uy", "uz", "vx", "vy", "vz", "wx", "wy", "wz")
"""Columns of a table; the second ones, `CameraPose.far`, may be left out."""
ROUNDING = 1e-4
"""Largest difference of a matrix's last row from 0, 0, 0, 1: a projection's differs by about 1."""


@dataclass(frozen=True)
class CameraPose:
    """One frame's camera, in scene units.

    Attributes:
        position: (3,) float64.
        to_camera: (4, 4) float64, world to camera, for column vectors; None where only the position is known.
        far: (3, 3) float64, rows u, v, w: a point infinitely far along ``d`` is seen at ``(u d, v d) / (w d)`` of the display
            window, -1..1, x right, y down, with ``w d`` above 0 in front of the camera; None where it is not known.
    """

    position: Array
    to_camera: Array | None = None
    far: Array | None = None

    @classmethod
    def of_matrix(cls, matrix: Array) -> CameraPose | None:
        """From a (4, 4) world to camera, for column vectors, else for row vectors: a pure rotation may be either.

        None where it is neither, as with a projection, or has no inverse.
        """
        if not _is_last(matrix[3]):
            matrix = matrix.T
        if not np.isfinite(matrix).all() or not _is_last(matrix[3]) or not np.linalg.det(matrix[:3, :3]):
            return None
        return cls(-np.linalg.solve(matrix[:3, :3], matrix[:3, 3]), matrix)


def _is_last(row: Array) -> bool:
    """Whether it is 0, 0, 0, 1 but for the rounding of the program that inverted the matrix."""
    return bool(np.abs(row - (0, 0, 0, 1)).max() <= ROUNDING)


def read_cameras(path: Path) -> dict[int, CameraPose]:
    """Read a table ``frame,x,y,z``, in scene units, or one that goes on with `FAR`: frame number -> camera.

    Raises:
        InputError: it is not such a table or not a regular file of at most `MAX_BYTES`, or a frame appears twice.
    """
    try:
        rows = csv.reader(io.StringIO(read_regular(path, MAX_BYTES).decode("utf-8-sig"), newline=""))
        first = next(rows, ["nothing"])
        names = [word.strip() for word in first]
        if names not in (list(PLACE), [*PLACE, *FAR]):
            raise InputError(
                f"{path}: expected the first line to be {','.join(PLACE)}, which {','.join(FAR)} may follow; found {','.join(first)}"
            )
        return _table(path, rows, len(names) - 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: cannot be read: {error}") from error


def _table(path: Path, rows: Iterable[list[str]], width: int) -> dict[int, CameraPose]:
    cameras: dict[int, CameraPose] = {}
    for line, row in enumerate(rows, start=2):
        if not row:
            continue
        try:
            number, values = int(row[0]), np.array([float(word) for word in row[1:]])
        except ValueError:
            number, values = -1, np.empty(0)
        if len(values) != width or not np.isfinite(values).all():
            raise InputError(f"{path}: line {line}: expected a frame number and {width} numbers; found {','.join(row)}")
        far = values[3:].reshape(3, 3) if width > 3 else None
        if far is not None and np.linalg.matrix_rank(far) < 3:
            raise InputError(f"{path}: line {line}: {','.join(FAR)} show no picture: the three rows lie in one plane")
        if number in cameras:
            raise InputError(f"{path}: line {line}: frame {number} appears twice")
        cameras[number] = CameraPose(values[:3], far=far)
    return cameras


def camera_of(header: Header, profile: Profile) -> CameraPose | None:
    """The camera by a file's metadata: ``worldToCamera`` or the attributes that the profile names; None without either."""
    matrix = header.attributes.get("worldToCamera")
    if isinstance(matrix, tuple) and len(matrix) == 16:
        # EXR's own convention is row vectors, translation in the last row; some writers store the transpose.
        pose = CameraPose.of_matrix(np.array(matrix, dtype=np.float64).reshape(4, 4).T)
        if pose is not None:
            return pose
    for names in profile.camera:
        position = _numbers(header.attributes, names)
        if position is not None:
            return CameraPose(position)
    return None


def _numbers(attributes: Mapping[str, object], names: tuple[str, ...]) -> Array | None:
    try:
        values = np.array([float(str(attributes[name])) for name in names])
    except (KeyError, ValueError):
        return None
    return values if np.isfinite(values).all() else None
