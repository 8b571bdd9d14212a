# SPDX-License-Identifier: MIT
"""A described scene in Blender: meshes, lights, keys for every frame. Needs bpy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import bpy
import mathutils
from materials import AOVS, build_material, build_sky
from paths import camera, pose
from shapes import mesh

Spec = Mapping[str, Any]
DOME = 70.0
"""Radius in metres: farther than all else, yet near enough not to use up the range of the depth."""
PRIMITIVES: dict[str, Callable[[], Any]] = {
    "plane": lambda: bpy.ops.mesh.primitive_plane_add(size=1),
    "cube": lambda: bpy.ops.mesh.primitive_cube_add(size=1),
    "sphere": lambda: bpy.ops.mesh.primitive_uv_sphere_add(radius=0.5, segments=48, ring_count=24),
    "cylinder": lambda: bpy.ops.mesh.primitive_cylinder_add(radius=0.5, depth=1, vertices=48),
    "cone": lambda: bpy.ops.mesh.primitive_cone_add(radius1=0.5, depth=1, vertices=48),
    "torus": lambda: bpy.ops.mesh.primitive_torus_add(major_radius=0.35, minor_radius=0.15),
    "monkey": lambda: bpy.ops.mesh.primitive_monkey_add(size=1),
}
SMOOTH = ("sphere", "torus", "monkey")
WORDS = ("STSS", "frame 42", "Halt!", "R2x2", "exit", "98.6 m", "Platform 7", "No entry", "Kiosk", "%&?")


def _mesh_object(shape: str, seed: int) -> Any:
    """An object that fits a cube of 1 m around its origin."""
    if shape in PRIMITIVES:
        PRIMITIVES[shape]()
        made = bpy.context.object
        for face in made.data.polygons:
            face.use_smooth = shape in SMOOTH and seed % 3 > 0
        return made
    if shape == "letters":
        bpy.ops.object.text_add()
        text = bpy.context.object.data
        text.body, text.align_x, text.extrude, text.size = WORDS[seed % len(WORDS)], "CENTER", 0.03, 0.5
        bpy.ops.object.convert(target="MESH")
        made = bpy.context.object
        made.data.transform(mathutils.Matrix.Rotation(1.5708, 4, "X"))
        return made
    plain = mesh(shape, seed)
    data = bpy.data.meshes.new(shape)
    data.from_pydata(plain.corners, [], plain.faces)
    layer = data.uv_layers.new(name="UVMap")
    layer.data.foreach_set("uv", [x for uv in plain.uv for x in uv])
    made = bpy.data.objects.new(shape, data)
    bpy.context.collection.objects.link(made)
    return made


def _key(thing: Any, frame: int, at: Any, turn: Any, path: str = "rotation_euler") -> None:
    thing.location = at
    setattr(thing, path, turn)
    thing.keyframe_insert("location", frame=frame)
    thing.keyframe_insert(path, frame=frame)


def _moved(thing: Any, spec: Spec, frames: int) -> None:
    """Keys at every frame, and one before and after, since the Vector pass looks there."""
    base = spec.get("turn", (0, 0, 0))
    for t in range(-1, frames + 1):
        offset, turn = pose(spec["motion"], t)
        _key(
            thing,
            t + 1,
            [a + b for a, b in zip(spec["at"], offset, strict=True)],
            [a + b for a, b in zip(base, turn, strict=True)],
        )


def build_object(spec: Spec, material: Any, frames: int) -> None:
    """One object; its size is in its mesh, so textures are in metres."""
    made = _mesh_object(spec["shape"], spec["seed"])
    made.data.transform(mathutils.Matrix.Diagonal((*spec["size"], 1.0)))
    made.location, made.rotation_euler = spec["at"], spec["turn"]
    made.data.materials.clear()
    made.data.materials.append(material)
    made.pass_index = spec["index"]
    if spec["motion"] is not None:
        _moved(made, spec, frames)


def build_light(spec: Spec, frames: int) -> None:
    """A sun or a lamp."""
    data = bpy.data.lights.new(spec["kind"], spec["kind"].upper())
    data.energy, data.color = spec["power"], spec["colour"]
    made = bpy.data.objects.new(spec["kind"], data)
    bpy.context.collection.objects.link(made)
    if spec["kind"] == "sun":
        data.angle = spec["soft"]
        x, y, z = spec["turn"]
        for t in range(-1, frames + 1):
            _key(made, t + 1, (0, 0, 20), (x, y, z + spec["rate"] * t))
    else:
        data.shadow_soft_size = spec["soft"]
        _moved(made, spec, frames)


def build_camera(scene: Spec) -> None:
    """The camera with its cuts."""
    data = bpy.data.cameras.new("camera")
    data.angle, data.clip_start, data.clip_end = scene["fov"], 0.05, 500
    made = bpy.data.objects.new("camera", data)
    bpy.context.collection.objects.link(made)
    bpy.context.scene.camera = made
    made.rotation_mode = "QUATERNION"
    for t in range(-1, scene["frames"] + 1):
        eye, target, roll = camera(scene["shots"], t)
        look = (mathutils.Vector(target) - mathutils.Vector(eye)).to_track_quat("-Z", "Y")
        _key(made, t + 1, eye, look @ mathutils.Quaternion((0, 0, 1), roll), "rotation_quaternion")


def build_background(sky: Spec) -> None:
    """The world, and the dome where there is one."""
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    bpy.context.scene.world = world
    build_sky(sky, world.node_tree, dome=False)
    world.cycles_visibility.diffuse = sky["lights"]
    # A lamp would be asked in only some of the samples, the sky in the others: that is noise even in full sun.
    world.cycles.sampling_method = "NONE"
    if sky["kind"] != "dome":
        return
    bpy.ops.mesh.primitive_uv_sphere_add(radius=DOME, segments=96, ring_count=48)
    dome = bpy.context.object
    material = bpy.data.materials.new("dome")
    material.use_nodes = True
    material.cycles.emission_sampling = "NONE"
    build_sky(sky, material.node_tree, dome=True)
    dome.data.materials.append(material)
    # Seen by the camera only: light and reflections come from the world behind it.
    dome.visible_shadow = dome.visible_diffuse = dome.visible_glossy = dome.visible_transmission = False


def build(scene: Spec) -> None:
    """Build the scene from nothing."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    layer = bpy.context.scene.view_layers[0]
    for name, kind in AOVS.items():
        aov = layer.aovs.add()
        aov.name, aov.type = name, kind
    sky, frames = scene["sky"], scene["frames"]
    ambient = 0.0 if sky["lights"] else sky["ambient"]
    materials: dict[tuple[int, bool], Any] = {}
    for spec in scene["objects"]:
        flat = spec["shape"] in ("card", "bush", "grass")
        key = (spec["material"], flat)
        if key not in materials:
            materials[key] = build_material(scene["materials"][spec["material"]] | {"flat": flat}, ambient)
        build_object(spec, materials[key], frames)
    for spec in scene["lights"]:
        build_light(spec, frames)
    build_camera(scene)
    build_background(sky)
