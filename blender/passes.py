# SPDX-License-Identifier: MIT
"""The inputs of the profile ``blender``: passes, AOVs, object numbers, the camera's table. Needs bpy; nothing of stss."""

from __future__ import annotations

from array import array
from collections.abc import Collection, Generator, Iterable, Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import Any

import bpy

PASSES = ("combined", "z", "vector", "normal", "position", "object_index", "diffuse_color")
AOVS = {"basecolor": "COLOR", "metallic": "VALUE", "roughness": "VALUE"}
"""Name to type."""
SOCKETS = {"basecolor": "Base Color", "metallic": "Metallic", "roughness": "Roughness"}
"""AOV to the input of the Principled BSDF that it shows."""
COLUMNS = ("frame", "x", "y", "z", "ux", "uy", "uz", "vx", "vy", "vz", "wx", "wy", "wz")
"""Of the camera's table; those behind z may be left out."""
GEOMETRY = {"MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD", "VOLUME"}
"""Kinds of object that are drawn."""


def layer_of(scene: Any) -> Any:
    """The first view layer that is rendered, or None."""
    return next((layer for layer in scene.view_layers if layer.use), None)


def set_up(layer: Any) -> list[str]:
    """Turn on passes, add AOVs to the view layer and to every material.

    Passes and nodes that are there already stay. The result is in the file that the user saves.

    Returns:
        A line for each material that has no Principled BSDF: its AOVs are 0.
    """
    for name in PASSES:
        setattr(layer, f"use_pass_{name}", True)
    for name, kind in AOVS.items():
        if name not in layer.aovs:
            added = layer.aovs.add()
            added.name, added.type = name, kind
    warnings: list[str] = []
    # All of the file: instances, nodes and the layer's override use materials that no object of the scene names.
    for material in bpy.data.materials:
        if material.users and not material.is_grease_pencil and not _show(material):
            warnings.append(f"{material.name}: no Principled BSDF; base colour, metallic and roughness are taken as 0")
    return sorted(warnings)


def _show(material: Any) -> bool:
    """Add the output nodes of the AOVs to a material; False where it has no Principled BSDF."""
    tree = material.node_tree
    if tree is None:
        return False
    there = {node.aov_name for node in tree.nodes if node.type == "OUTPUT_AOV"}
    source = next((node for node in tree.nodes if node.type == "BSDF_PRINCIPLED"), None)
    if source is None:
        return set(AOVS) <= there
    for name, kind in AOVS.items():
        if name in there:
            continue
        node = tree.nodes.new("ShaderNodeOutputAOV")
        node.aov_name = name
        value, target = source.inputs[SOCKETS[name]], node.inputs["Color" if kind == "COLOR" else "Value"]
        if value.is_linked:
            tree.links.new(value.links[0].from_socket, target)
        else:
            target.default_value = value.default_value
    return True


def survey(scene: Any, layer: Any, frames: Iterable[int], size: tuple[int, int]) -> list[tuple[int, Any, tuple[float, ...]]]:
    """Step through the frames: record the camera in each, and give every moving object its own pass index.

    Movement is found in the evaluated scene, not guessed from its keys: objects, particles and other instances by their matrices,
    armatures, shape keys, simulations and geometry nodes by the vertices that they yield. 0 stays for objects at rest.

    Args:
        scene: the scene.
        layer: the view layer that is rendered.
        frames: their numbers.
        size: width and height of the frames.

    Returns:
        For each frame its number, its camera and the numbers of `write_camera`.
    """
    cameras: list[tuple[int, Any, tuple[float, ...]]] = []
    first: dict[Any, Any] = {}
    moving: dict[Any, None] = {}
    for number in frames:
        scene.frame_set(number)
        layer.update()
        cameras.append((number, scene.camera, _numbers(scene, layer.depsgraph, size)))
        for thing, instance, pose in _poses(layer.depsgraph):
            if first.setdefault((thing, instance), pose) != pose:
                moving[thing] = None
    instanced = {thing for thing, _ in first}
    for thing in scene.objects:
        if thing.type in GEOMETRY and thing not in instanced and not thing.hide_render and _has_keys(thing):
            moving[thing] = None
    numbers = {thing.pass_index for thing in bpy.data.objects}
    free = (number for number in range(1, 32768) if number not in numbers)
    for thing in sorted(moving, key=lambda one: one.name):
        if thing.pass_index == 0:
            thing.pass_index = next(free, 32767)
    return cameras


def _has_keys(thing: Any) -> bool:
    """Of an object that only renders draw, not the viewport, so that its poses are not seen here."""
    own = thing.animation_data is not None or bool(thing.constraints) or thing.rigid_body is not None
    return own or (thing.parent is not None and _has_keys(thing.parent))


def _poses(graph: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Of everything that is drawn: its object, which of its instances it is, and where its vertices are."""
    digests: dict[Any, bytes] = {}
    for one in graph.object_instances:
        thing = one.object
        if thing.type not in GEOMETRY:
            continue
        if thing not in digests:
            digests[thing] = _vertices(thing)
        instance = (one.parent.original, *one.persistent_id) if one.is_instance else ()
        yield thing.original, instance, (one.matrix_world.copy(), digests[thing])


def _vertices(thing: Any) -> bytes:
    """A digest of an evaluated object's vertices; empty where nothing can move them."""
    data = thing.original.data
    if thing.type in {"POINTCLOUD", "VOLUME"} or not (
        thing.modifiers or getattr(data, "shape_keys", None) is not None or data.animation_data is not None
    ):
        return b""
    curves = thing.type == "CURVES"
    points = thing.data.position_data if curves else thing.to_mesh().vertices
    places = array("f", bytes(12 * len(points)))
    points.foreach_get("vector" if curves else "co", places)
    thing.to_mesh_clear()
    return sha256(places).digest()


def _numbers(scene: Any, graph: Any, size: tuple[int, int]) -> tuple[float, ...]:
    """Where the camera is; and the rows by which the background, infinitely far away, is seen, if a matrix says it."""
    camera, render = scene.camera, scene.render
    place = (*camera.matrix_world.translation,)
    if camera.data.type != "PERSP":
        return place
    lens = camera.calc_matrix_camera(graph, x=size[0], y=size[1], scale_x=render.pixel_aspect_x, scale_y=render.pixel_aspect_y)
    u, v, _, w = lens @ camera.matrix_world.normalized().inverted()
    return (*place, *u[:3], *(-x for x in v[:3]), *w[:3])  # stss has y down


def write_camera(cameras: Collection[tuple[int, Any, tuple[float, ...]]], path: Path) -> None:
    """Write the table of ``stss run --camera``, in units of the scene."""
    width = 1 + min(len(numbers) for _, _, numbers in cameras)
    rows = [",".join([str(number), *(f"{x:.9g}" for x in numbers[: width - 1])]) for number, _, numbers in cameras]
    lines = [",".join(COLUMNS[:width]), *rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def changed(*settings: tuple[Any, str, Any]) -> Generator[None]:
    """Have settings (object, name, value) for a while; then they are as they were."""
    before = [(of, name, getattr(of, name)) for of, name, _ in settings]
    try:
        for of, name, value in settings:
            setattr(of, name, value)
        yield
    finally:
        # In the same order again: which depths of colour there are depends on the file's format.
        for of, name, value in before:
            setattr(of, name, value)
