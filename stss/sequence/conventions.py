# SPDX-License-Identifier: MIT
"""Convert a renderer's planes to the conventions of spec section 0."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stss.frames.buffers import Buffers
from stss.frames.check_buffers import ROUNDING, float_hint, require_distinct, require_unmasked
from stss.images.color import BLOCK
from stss.sequence.camera import CameraPose
from stss.sequence.profiles import BUFFERS, CONSTANTS, DepthRule, MotionRule, NormalRule, Profile, load_profile
from stss_ground.arguments import require_kind, suggest
from stss_ground.cores import for_blocks
from stss_ground.errors import InputError
from stss_ref.arrays import Array, Image, Mask, Plane

BACKGROUND_POSITION = 1e7
"""Each coordinate of the position where nothing was hit; cm. One place, so that sky matches sky; far away, so that no surface matches."""

STORED = 1 - 2.0**-11
"""A file may store depth as half floats: a value rounds down to no less than this share of itself."""

_COLORS = {"color", "colour", "colors", "colours", "rgb", "rgba"}
"""Names by which a plane of another name is taken for a mistake, if there is no ``color``."""


def convert(
    number: int,
    planes: Mapping[str, Array | float],
    profile: str | Path | Profile = "stss",
    *,
    camera: Array | None = None,
    cut: bool = False,
) -> Buffers:
    """Bring an engine's planes of one display frame to the conventions of the specification.

    Args:
        number: the display frame.
        planes: the fields of `Buffers` in the profile's conventions. ``color`` may be missing or None: the frame was not rendered;
            ``nov`` may be missing if there is a camera; ``stencil``, ``roughness`` and ``metallic`` may be one number. Planes of other
            names go to ``carried``.
        profile: a built-in profile's name, a TOML file, or one from `load_profile`.
        camera: (3,) its position or (4, 4) world to camera, for column vectors, or for row vectors if it has a translation; in scene
            units.
        cut: whether the frame is the first of a shot.

    Returns:
        The frame; it shares no memory with ``planes``.

    Raises:
        InputError: a plane is missing, has another shape, or is of whole numbers; the camera is none.
    """
    require_kind("number", number, (int, np.integer), "a frame's number")
    require_kind(f"frame {number}: planes", planes, Mapping, "names and planes")
    table = profile if isinstance(profile, Profile) else load_profile(profile)
    where = None if camera is None else _pose(camera)
    originals: dict[str, Array] = {}
    _require_planes(number, planes, where is not None)
    for name in BUFFERS:
        if planes.get(name) is None:
            continue
        original = _array(f"frame {number}: {name}", planes[name])
        if original.ndim and original.dtype.kind != "f" and name != "stencil":
            hint = float_hint(original.dtype)
            raise InputError(f"frame {number}: {name}: expected floating-point numbers, found {original.dtype}; {hint}")
        originals[name] = original
    shape = _size(number, originals)
    buffers: dict[str, Array] = {}
    for name, original in originals.items():
        channels, plane = BUFFERS[name], original
        if name == "stencil":
            plane = original.astype(np.float32)
            require_distinct(f"frame {number}: {name}", original, plane)
        if plane.ndim == 0 and name in CONSTANTS:
            plane = np.full(shape, plane)
        plane = plane[..., None] if plane.ndim == 2 else plane
        if plane.shape != (*shape, channels):
            raise InputError(f"frame {number}: {name}: expected shape {(*shape, channels)}, found {original.shape}")
        buffers[name] = plane
    require_depth(f"frame {number}", buffers["depth"], table.depth)
    depth = to_specification(buffers, table, where)
    single = {name: buffers[name][..., 0] for name in ("stencil", "nov", "roughness", "metallic")}
    carried: dict[str, Array] = {}
    for name, plane in planes.items():
        if name not in BUFFERS:
            carried[name] = _array(f"frame {number}: {name}", plane).astype(np.float32)
    several = {name: buffers[name] for name in ("motion", "normal", "position", "base_color")}
    return Buffers(number, buffers.get("color"), depth=depth, **single, **several, cut=cut, carried=carried)


def _array(where: str, value: Any) -> Array:
    """A plane as an array of numbers; a library refuses in its own words, for a tensor on a GPU or with a gradient."""
    require_unmasked(where, value)
    try:
        array = np.asarray(value)
    except Exception as error:
        raise InputError(f"{where}: expected an array, found {type(value).__name__}: {str(error).partition('. ')[0]}") from error
    if array.dtype.kind not in "fiub":
        raise InputError(f"{where}: expected numbers, found {array.dtype}")
    return array


def _require_planes(number: int, planes: Mapping[str, Array | float], has_camera: bool) -> None:
    """Raise InputError if a plane is missing; a colour of another name too, since the frame would count as not rendered."""
    others = [str(name) for name in planes if name not in BUFFERS]
    for name in BUFFERS:
        if planes.get(name) is not None or (name == "nov" and has_camera):
            continue
        if name == "color":
            if "color" not in planes and (colors := [other for other in others if other.lower() in _COLORS]):
                raise InputError(
                    f"frame {number}: no color; expected an array, or None if it was not rendered; found {colors[0]}"
                )
            continue
        expected = "an array, or a camera" if name == "nov" else "an array"
        raise InputError(f"frame {number}: no {name}; expected {expected}{suggest(name, others)}")


def _size(number: int, planes: Mapping[str, Array]) -> tuple[int, int]:
    """(H, W) of most planes, so that an error names the plane of another size; depth's if two sizes are equally frequent."""
    sizes = [planes["depth"].shape[:2]]
    sizes += [plane.shape[:2] for name, plane in planes.items() if plane.ndim >= 2 and (*plane.shape, 1)[2] == BUFFERS[name]]
    height, width = max(sizes, key=sizes.count) if planes["depth"].ndim >= 2 else (0, 0)
    if not height * width:
        raise InputError(f"frame {number}: depth: expected an array (H, W), found shape {planes['depth'].shape}")
    return height, width


def require_depth(where: str, values: Array, rule: DepthRule) -> None:
    """Raise InputError if finite depths (H, W, 1) cannot be what the profile says: a depth buffer's 0 to 1, or distances.

    One negative value, or several equal ones, may stand for nothing hit; different ones measure something.
    """
    if rule.kind != "device":
        with np.errstate(invalid="ignore"):
            below = values[np.isfinite(values) & (values < 0)]
            if len(below) and below.min() < below.max() and not (values > 0).any():
                raise InputError(
                    f"{where}: depth: expected distances from the camera, > 0, found {len(below)} negative ones and no other, "
                    f"{below.min():g} to {below.max():g}; negate them if they are z of a view space that looks along -z, as OpenGL's"
                )
        return
    with np.errstate(invalid="ignore"):
        bad = np.isfinite(values) & ((values < -ROUNDING) | (values > 1 + ROUNDING))
    if bad.any():
        y, x, _ = np.argwhere(bad)[0]
        raise InputError(
            f"{where}: depth: expected a depth buffer's values, from 0 to 1, found {bad.sum()} others, the first {values[y, x, 0]:g} at "
            f'(y={y}, x={x}); the profile says kind = "device", linear depth is kind = "planar"'
        )


def _pose(value: Array) -> CameraPose:
    try:
        camera = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        raise InputError(f"camera: expected a position (3,) or a matrix (4, 4), found {type(value).__name__}") from None
    if camera.shape not in ((3,), (4, 4)):
        raise InputError(f"camera: expected a position (3,) or a matrix (4, 4), found shape {camera.shape}")
    if not np.isfinite(camera).all():
        raise InputError("camera: expected finite numbers, found others")
    if camera.shape == (3,):
        return CameraPose(camera)
    pose = CameraPose.of_matrix(camera)
    if pose is None:
        raise InputError(
            "camera: expected a matrix from world to camera, without a projection, whose last row or column is 0, 0, 0, 1, "
            f"and that has an inverse; found the last row {', '.join(f'{x:g}' for x in camera[3])}"
        )
    return pose


def to_specification(
    buffers: dict[str, Array],
    profile: Profile,
    camera: CameraPose | None,
    *,
    display: tuple[int, int] | None = None,
    outside: Mask | None = None,
    in_place: bool = False,
) -> Plane:
    """Bring stored buffers (H, W, C) to spec section 0, as float32; returns depth, infinite where nothing was hit.

    The dictionary is changed; its arrays only if ``in_place``, which takes float32.
    ``display``: (H, W) of the frame without its overscan, the side of which a motion may be a share of; None: of the buffers.
    ``outside``: (H, W) pixels that are in no data window: nothing was hit there, and nothing moves.
    """
    height, width = size = buffers["depth"].shape[:2]
    depth = np.empty(size, np.float32)
    results = buffers if in_place else {name: np.empty(plane.shape, np.float32) for name, plane in buffers.items()}
    results = {"nov": np.empty((*size, 1), np.float32)} | results

    def convert_rows(rows: slice) -> None:  # a block, so that intermediate results stay in the processor's cache
        stored = {name: plane[rows].astype(np.float32, copy=False) for name, plane in buffers.items()}
        part, beyond = {**stored}, None if outside is None else outside[rows]
        depth[rows] = _convert_part(part, profile, camera, display or (height, width), beyond)
        for name, plane in part.items():
            if not in_place or plane is not stored.get(name):
                results[name][rows] = plane

    for_blocks(height, max(1, BLOCK // width), convert_rows)
    buffers |= results
    return depth


def _convert_part(
    buffers: dict[str, Array], profile: Profile, camera: CameraPose | None, display: tuple[int, int], outside: Mask | None
) -> Plane:
    """`to_specification` of some rows of a frame."""
    depth = linear_depth(buffers["depth"][..., 0], profile.depth)
    normal, background = world_normal(buffers["normal"], profile.normal)
    background |= ~np.isfinite(depth) if outside is None else ~np.isfinite(depth) | outside
    position = buffers["position"]
    finite = np.isfinite(position)
    if not finite.all():
        position = np.where(finite.all(axis=-1, keepdims=True), position, np.nan)
    if profile.depth.kind == "ray":
        depth = ray_to_planar(depth, position, camera)
    if "nov" not in buffers:
        assert camera is not None
        buffers["nov"] = normal_dot_view(normal, position, camera.position)[..., None]
    motion = motion_in_pixels(buffers["motion"], profile.motion, display)
    buffers["motion"] = motion if outside is None else np.where(outside[..., None], np.float32(0), motion)
    buffers["normal"] = normal
    buffers["position"] = (position / profile.units_per_cm).astype(np.float32)
    if background.any():
        depth[background] = np.inf
        for buffer in ("normal", "nov", "position", "stencil", "base_color", "roughness", "metallic"):
            value = BACKGROUND_POSITION if buffer == "position" else 0
            buffers[buffer] = np.where(background[..., None], np.float32(value), buffers[buffer])
    return depth


def motion_in_pixels(motion: Image, rule: MotionRule, display: tuple[int, int] | None = None) -> Image:
    """Stored motion as (H, W, 2) float32; pixels, current -> previous, x right, y down. Non-finite values stay non-finite."""
    height, width = display or motion.shape[:2]
    unit = {"pixels": (1.0, 1.0), "uv": (width, height), "ndc": (width / 2, height / 2)}[rule.unit]
    sign = 1.0 if rule.direction == "to_previous" else -1.0
    factor = np.array(rule.scale) * unit * (sign, sign if rule.y == "down" else -sign)
    with np.errstate(invalid="ignore", over="ignore"):
        return ((motion - np.array(rule.bias)) * factor + 0.0).astype(np.float32)  # + 0.0: no negative zeros


def linear_depth(depth: Plane, rule: DepthRule) -> Plane:
    """Stored depth as linear depth (H, W) float32, infinite where nothing was hit; a ray's length stays one, see `ray_to_planar`."""
    d = depth.astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if rule.kind == "device":
            background = ~np.isfinite(d)
            d = np.clip(d, 0, 1)
            d = d if rule.reversed else 1 - d
            # d is 1 at the near plane, 0 at the far one; 1 / z is linear in it.
            d = 1 / (d / rule.near + (1 - d) / rule.far)
            hit = np.isfinite(d) & (d < rule.far * (1 - 1e-6)) & ~background
        else:
            hit = np.isfinite(d) & (d > 0) & (d < rule.background * STORED)
    return np.where(hit, d, np.inf).astype(np.float32)


def ray_to_planar(depth: Plane, position: Image, camera: CameraPose | None) -> Plane:
    """Turn distances to the camera (H, W) into depths along its axis; unchanged where the axis is not known.

    ``position`` is in scene units. The depth comes from it, not from the ray: ``|z|`` in camera space.
    """
    if camera is None or camera.to_camera is None:
        return depth
    z = np.abs(position.astype(np.float64) @ camera.to_camera[2, :3] + camera.to_camera[2, 3])
    usable = np.isfinite(depth) & np.isfinite(z) & (z > 0)
    return np.where(usable, z, depth).astype(np.float32)


def world_normal(normal: Image, rule: NormalRule) -> tuple[Image, Mask]:
    """The stored normal as (H, W, 3) float32, and (H, W) True where its value means that nothing was hit."""
    background = np.zeros(normal.shape[:2], dtype=np.bool_)
    if rule.background is not None:
        background = (normal == np.array(rule.background, dtype=np.float32)).all(axis=-1)
    with np.errstate(invalid="ignore", over="ignore"):
        return ((normal - rule.bias) * rule.scale).astype(np.float32), background


def normal_dot_view(normal: Image, position: Image, camera: Array) -> Plane:
    """NoV (H, W): ``dot(normalize(normal), normalize(camera - position))``, 0 where either has no length or is not finite."""
    # Component by component: NumPy is slow where the axis that lies together has three numbers.
    n = [normal[..., i].astype(np.float64) for i in range(3)]
    view = [camera[i] - position[..., i].astype(np.float64) for i in range(3)]

    def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        nov = dot(n, view) / np.sqrt(dot(n, n) * dot(view, view))
    return np.where(np.isfinite(nov), np.clip(nov, -1, 1), 0).astype(np.float32)
