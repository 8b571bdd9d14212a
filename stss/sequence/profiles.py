# SPDX-License-Identifier: MIT
"""Profiles: the names that each renderer gives its buffers, and the conventions in which it writes them.

A profile is a TOML file, the built-in ones too; docs/profiles.md explains every key. Nothing is guessed: a convention
has no default here, so a file that leaves one out is refused.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal, cast

from stss_ground.arguments import path_of, suggest
from stss_ground.errors import InputError
from stss_ground.toml_table import Table, read_toml
from stss_ref.depth import DepthMode

BUFFERS = {
    "color": 3,
    "motion": 2,
    "normal": 3,
    "depth": 1,
    "position": 3,
    "stencil": 1,
    "nov": 1,
    "base_color": 3,
    "roughness": 1,
    "metallic": 1,
}
"""Buffer -> number of channels."""
CONSTANTS = ("stencil", "roughness", "metallic")
"""Buffers that one number for the whole frame can stand in for."""

_DEPTH_KEYS = {"planar": ("kind", "background"), "ray": ("kind", "background"), "device": ("kind", "near", "far", "reversed")}

_TABLES = Path(__file__).with_name("profile_tables")

Channels = tuple[str, ...]


@dataclass(frozen=True)
class MotionRule:
    """How motion is stored: ``(value - bias) * scale`` is a displacement in ``unit``.

    Attributes:
        direction: "to_previous": previous minus current position; "from_previous": current minus previous.
        unit: "pixels"; "uv": 1 is the whole frame; "ndc": 2 is the whole frame.
        y: which way positive y points.
        bias: subtracted first, x and y.
        scale: factor after that, x and y.
    """

    direction: Literal["to_previous", "from_previous"]
    unit: Literal["pixels", "uv", "ndc"]
    y: Literal["up", "down"]
    bias: tuple[float, float]
    scale: tuple[float, float]


@dataclass(frozen=True)
class DepthRule:
    """How depth is stored.

    Attributes:
        kind: "planar": along the view axis; "ray": distance to the camera; "device": a depth buffer's values.
        background: this value, as a half float rounds it, and larger ones mean that nothing was hit; so do 0, negative and non-finite
            ones.
        near: "device" only: distance of the near plane.
        far: "device" only: distance of the far plane; infinite allowed.
        reversed: "device" only: 1 is the near plane, 0 the far one.
    """

    kind: Literal["planar", "ray", "device"]
    background: float
    near: float = 0.0
    far: float = math.inf
    reversed: bool = True


@dataclass(frozen=True)
class NormalRule:
    """How the world-space normal is stored: ``(value - bias) * scale``.

    Attributes:
        bias: subtracted first.
        scale: factor after that.
        background: stored value that means that nothing was hit; None where the renderer has none.
    """

    bias: float
    scale: float
    background: tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Profile:
    """A renderer's names and conventions.

    Attributes:
        name: its name on the command line.
        title: its description in one line.
        path: its TOML file.
        channels: buffer -> alternatives in order of preference, each the full names of the buffer's channels.
            ``{layer}`` stands for the text before the last two dots; for nothing, with its dot, where no name has two.
        files: buffer -> the endings that its file's name may have before the frame number, in order of preference; the other buffers
            share a file.
        motion: how motion is stored.
        depth: how depth is stored.
        normal: how the normal is stored.
        units_per_cm: scene units per centimetre: Unreal 1, Blender 0.01.
        color_domain: "linear": scene-linear; "display": display-referred, 0..1.
        depth_normalisation: spec 0: "clip" or "scale".
        camera: alternatives of three attribute names that hold the camera's position, in scene units.
        constants: buffer -> number that stands in where there is no channel.
        hints: buffer -> advice for when it is missing.
        view: of a stereo file, the one to read; "": the first.
    """

    name: str
    title: str
    path: Path
    channels: Mapping[str, tuple[Channels, ...]]
    motion: MotionRule
    depth: DepthRule
    normal: NormalRule
    units_per_cm: float
    color_domain: Literal["linear", "display"]
    depth_normalisation: DepthMode
    files: Mapping[str, tuple[str, ...]] = field(default_factory=dict[str, tuple[str, ...]])
    camera: tuple[Channels, ...] = ()
    constants: Mapping[str, float] = field(default_factory=dict[str, float])
    hints: Mapping[str, str] = field(default_factory=dict[str, str])
    view: str = ""

    def files_of(self, buffer: str) -> tuple[str, ...]:
        """The ends that the name of the buffer's file may have; "" for the file the others share."""
        return self.files.get(buffer, ("",))

    @property
    def endings(self) -> set[str]:
        """Those of all buffers."""
        return {ending for buffer in BUFFERS for ending in self.files_of(buffer)}


def profile_names() -> tuple[str, ...]:
    """Names of the built-in profiles."""
    return tuple(sorted(path.stem for path in _TABLES.glob("*.toml")))


def load_profile(name_or_path: str | Path, **changes: Any) -> Profile:
    """Load a built-in profile by name, or a TOML file by path; a file that has a ``base`` changes that built-in profile.

    Args:
        name_or_path: the name or the path.
        changes: keys to replace, tables as dictionaries: ``units_per_cm=0.01, motion={"unit": "ndc", "y": "up"}``. A table keeps
            the entries that its change does not name; if ``kind`` changes, only those that the new kind has too.

    Returns:
        The profile; `Profile` explains each entry.

    Raises:
        InputError: there is no such profile; or a key of it is unknown, missing or wrong.
    """
    path_given, text = path_of("profile", name_or_path), str(name_or_path)
    if text in profile_names():
        path = _TABLES / f"{text}.toml"
    else:
        path = path_given
        if not path.exists():
            if path.suffix == ".toml":
                raise InputError(f"profile {text}: no such file")
            names = profile_names()
            raise InputError(f"profile {text}: expected one of {', '.join(names)} or a TOML file{suggest(text, names)}")
    table = _read(path)
    if changes:
        table.path, table.rest = f"profile {text} as changed", _merge(table.rest, changes)
    return _profile(path, table)


def _read(path: Path) -> Table:
    """A file's table, with the entries of its base that it leaves out."""
    table = Table(path, "", InputError, _built_in(path)) if path.parent == _TABLES else read_toml(path, InputError)
    if "base" in table.rest:
        base = table.choice("base", profile_names())
        whole = {**_read(_TABLES / f"{base}.toml").rest, "name": path.stem, "title": f"{path.stem}, changed from {base}"}
        table.rest = _merge(whole, table.rest)
    return table


@cache
def _built_in(path: Path) -> dict[str, Any]:
    """A built-in profile, parsed once: every sequence tries all of them."""
    return read_toml(path, InputError).rest


def _merge(top: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Keys and tables; a change keeps the keys that it does not name."""
    merged = dict(top)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(old, dict) and isinstance(value, dict)
        merged[key] = _change(cast("dict[str, Any]", old), cast("dict[str, Any]", value)) if both else value
    return merged


def _change(old: dict[str, Any], change: dict[str, Any]) -> dict[str, Any]:
    keys = _DEPTH_KEYS.get(str(change.get("kind")), old)
    return {**{key: value for key, value in old.items() if key in keys}, **change}


def _profile(path: Path, top: Table) -> Profile:
    top.only("name, title, base, view, units_per_cm, color_domain, depth_normalisation and the tables "
             "channels, motion, depth, normal, files, camera, constants, hints")  # fmt: skip
    channels, files, hints = top.table("channels"), top.table("files", optional=True), top.table("hints", optional=True)
    constants, camera = top.table("constants", optional=True), top.table("camera", optional=True)
    for table in (channels, files, hints):
        table.only(", ".join(BUFFERS))
    constants.only(", ".join(CONSTANTS))
    camera.only("attributes")
    return Profile(
        name=top.text("name"),
        title=top.text("title"),
        path=path,
        channels={buffer: channels.names(buffer, count) for buffer, count in BUFFERS.items()},
        motion=_motion(top.table("motion")),
        depth=_depth(top.table("depth")),
        normal=_normal(top.table("normal")),
        units_per_cm=top.number("units_per_cm", positive=True),
        color_domain=top.choice("color_domain", ("linear", "display")),
        depth_normalisation=top.choice("depth_normalisation", ("clip", "scale")),
        files={buffer: files.texts(buffer) for buffer in BUFFERS if buffer in files.rest},
        camera=camera.names("attributes", 3) if "attributes" in camera.rest else (),
        constants={buffer: constants.number(buffer) for buffer in CONSTANTS if buffer in constants.rest},
        hints={buffer: hints.text(buffer) for buffer in BUFFERS if buffer in hints.rest},
        view=top.text("view") if "view" in top.rest else "",
    )


def _motion(table: Table) -> MotionRule:
    table.only("direction, unit, y, bias, scale")
    bias, scale = table.numbers("bias", 2), table.numbers("scale", 2)
    return MotionRule(
        table.choice("direction", ("to_previous", "from_previous")),
        table.choice("unit", ("pixels", "uv", "ndc")),
        table.choice("y", ("up", "down")),
        (bias[0], bias[1]),
        (scale[0], scale[1]),
    )


def _depth(table: Table) -> DepthRule:
    kind = table.choice("kind", tuple(_DEPTH_KEYS))
    table.only(", ".join(_DEPTH_KEYS[kind]))
    if kind == "device":
        near, far = table.number("near", positive=True), table.number("far", positive=True, infinite=True)
        rule = DepthRule(kind, math.inf, near, far, table.take("reversed", "true or false", bool))
        if far <= near:
            raise table.fail("far", f"more than near ({near})", far)
        return rule
    return DepthRule(kind, table.number("background", positive=True, infinite=True))


def _normal(table: Table) -> NormalRule:
    table.only("bias, scale, background")
    background = None
    if "background" in table.rest:
        x, y, z = table.numbers("background", 3)
        background = x, y, z
    return NormalRule(table.number("bias"), table.number("scale"), background)
