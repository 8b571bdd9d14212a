# SPDX-License-Identifier: MIT
"""The inputs of the profile ``blender``: passes, AOVs, object numbers, the camera's table. Needs bpy; nothing of stss."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

PASSES = ("combined", "z", "vector", "normal", "position", "object_index", "diffuse_color")
AOVS = {"basecolor": "COLOR", "metallic": "VALUE", "roughness": "VALUE"}
"""Name to type."""
SOCKETS = {"basecolor": "Base Color", "metallic": "Metallic", "roughness": "Roughness"}
"""AOV to the input of the Principled BSDF that it shows."""


def set_up(scene: Any, layer: Any) -> list[str]:
    """Turn on passes, add AOVs to the view layer and to every material, number moving objects.

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
    for material in {slot.material for thing in scene.objects for slot in thing.material_slots if slot.material is not None}:
        if not _show(material):
            warnings.append(f"{material.name}: no Principled BSDF; base colour, metallic and roughness are taken as 0")
    _number(scene)
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


def _number(scene: Any) -> None:
    """Give each moving object a pass index of its own; 0 stays for objects at rest."""
    used_numbers = {thing.pass_index for thing in scene.objects}
    free = (number for number in range(1, 32768) if number not in used_numbers)
    for thing in scene.objects:
        if thing.pass_index == 0 and _moves(thing):
            thing.pass_index = next(free)


def _moves(thing: Any) -> bool:
    own = thing.animation_data is not None or bool(thing.constraints) or thing.rigid_body is not None
    return own or (thing.parent is not None and _moves(thing.parent))


def write_camera(scene: Any, frames: Iterable[int], path: Path) -> None:
    """Write where the camera is at each frame: ``frame,x,y,z`` in units of the scene."""
    lines = ["frame,x,y,z"]
    for number in frames:
        scene.frame_set(number)
        x, y, z = scene.camera.matrix_world.translation
        lines.append(f"{number},{x:.9g},{y:.9g},{z:.9g}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@contextmanager
def changed(*settings: tuple[Any, str, Any]) -> Iterator[None]:
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
