# SPDX-License-Identifier: MIT
"""``PYTHON docs/pictures/street.py FOLDER``, by a Python with bpy (``make test-blender`` makes one): the frames of ``first.png``.

A street of our own, as an engine renders it: one sample at each pixel's centre, 960 x 540, half of the frames in colour. Writes
``FOLDER/lr``, ``FOLDER/camera.csv``, and of the last frame, which is extrapolated, the full render ``FOLDER/truth``.
"""

import math
import os
import random
import sys
from pathlib import Path

import bpy
from mathutils import Euler, Vector

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "blender"))
from passes import changed, set_up, survey, write_camera  # noqa: E402

FRAMES = range(6)
SIZE = 1920, 1080
TRUTH_SAMPLES = 36
PART = 300, 1090, 530, 272
"""Of the full render: y, x, height, width of the part that the picture shows."""
LIGHT = 0.55
"""Share of the base colour that shines: light from all sides without a ray for it, and so without noise."""

FACING = (math.pi / 2, 0, 0)
"""Turn of lettering that faces the camera."""
LOOKS = {
    "grass": [(0.2, 0.26, 0.12)],
    "asphalt": [(0.14, 0.14, 0.15)],
    "stone": [(0.5, 0.47, 0.42), (0.3, 0.28, 0.26), 1.2],
    "brick": [(0.46, 0.17, 0.1), (0.6, 0.55, 0.48), 2.0, "YZ"],
    "plaster": [(0.72, 0.6, 0.38)],
    "ochre": [(0.62, 0.36, 0.16)],
    "pale": [(0.75, 0.73, 0.68)],
    "tiles": [(0.36, 0.12, 0.07), (0.2, 0.06, 0.04), 2.5, "YX"],
    "white": [(0.85, 0.84, 0.8)],
    "glass": [(0.06, 0.09, 0.12)],
    "iron": [(0.03, 0.035, 0.04)],
    "leaf": [(0.12, 0.3, 0.05)],
    "bark": [(0.13, 0.08, 0.05)],
    "red": [(0.6, 0.05, 0.04)],
    "blue": [(0.04, 0.12, 0.4)],
    "yellow": [(0.85, 0.62, 0.08)],
}
"""Name -> arguments of `material`."""


def material(name, color, mortar=None, scale=1.0, axes="XY"):
    """One colour, or bricks in a plane of the object's two axes."""
    material_data = bpy.data.materials.new(name)
    material_data.use_nodes = True
    nodes, links = material_data.node_tree.nodes, material_data.node_tree.links
    shader = nodes["Principled BSDF"]
    shader.inputs["Roughness"].default_value = 1.0
    shader.inputs["Specular IOR Level"].default_value = 0.0
    shader.inputs["Emission Strength"].default_value = LIGHT
    for socket in ("Base Color", "Emission Color"):
        shader.inputs[socket].default_value = (*color, 1)
    material_data.cycles.emission_sampling = "NONE"  # no lamp of its own: no noise
    if mortar:
        place, apart, plane, bricks = (
            nodes.new(f"ShaderNode{kind}") for kind in ("TexCoord", "SeparateXYZ", "CombineXYZ", "TexBrick")
        )
        links.new(place.outputs["Object"], apart.inputs[0])
        for axis, socket in zip(axes, plane.inputs, strict=False):
            links.new(apart.outputs[axis], socket)
        links.new(plane.outputs[0], bricks.inputs["Vector"])
        bricks.inputs["Scale"].default_value = scale
        for socket, value in (("Color1", color), ("Color2", [0.8 * c for c in color]), ("Mortar", mortar)):
            bricks.inputs[socket].default_value = (*value, 1)
        for socket in ("Base Color", "Emission Color"):
            links.new(bricks.outputs["Color"], shader.inputs[socket])
    return material_data


def put(data, of, at=(0, 0, 0), turn=(0, 0, 0)):
    """An object of some mesh or curve."""
    thing = bpy.data.objects.new(data.name, data)
    thing.location, thing.rotation_euler = at, turn
    thing.visible_diffuse = False  # lights nothing else: no noise
    data.materials.append(of)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def boxes(name, of, parts, at=(0, 0, 0), turn=(0, 0, 0)):
    """Boxes (centre, size), one object."""
    points, faces = [], []
    for (x, y, z), (w, d, h) in parts:
        first = len(points)
        points += [(x + i * w / 2, y + j * d / 2, z + k * h / 2) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)]
        faces += [
            tuple(first + corner for corner in side)
            for side in ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        ]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points, [], faces)
    return put(mesh, of, at, turn)


def wire(name, of, points, radius):
    """A round wire through points."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth, curve.bevel_resolution = "3D", radius, 2
    line = curve.splines.new("POLY")
    line.points.add(len(points) - 1)
    for point, place in zip(line.points, points, strict=True):
        point.co = (*place, 1)
    return put(curve, of)


def sag(start, end, depth, steps=24):
    """Points of a wire that hangs between two places."""
    start, end = Vector(start), Vector(end)
    return [start.lerp(end, t / steps) - Vector((0, 0, depth * 4 * (t / steps) * (1 - t / steps))) for t in range(steps + 1)]


def words(text, of, at, size, turn):
    """Lettering."""
    curve = bpy.data.curves.new(text, "FONT")
    curve.body, curve.size, curve.extrude, curve.align_x, curve.align_y = text, size, 0.02, "CENTER", "CENTER"
    return put(curve, of, at, turn)


def tree(of, trunk, at, height, count, seed):
    """A trunk with twigs, and leaves of two triangles each around their ends."""
    draw = random.Random(seed)
    wire("trunk", trunk, [at, (at[0] + 0.1, at[1], height * 0.55)], 0.11)
    points, faces = [], []
    for _ in range(34):
        angle, up = draw.uniform(0, 2 * math.pi), draw.uniform(0.4, 1.0)
        reach = 1.9 * math.sin(math.pi * (0.12 + 0.8 * (up - 0.4) / 0.6)) * draw.uniform(0.6, 1)
        end = Vector((at[0] + reach * math.cos(angle), at[1] + reach * math.sin(angle), height * up))
        wire("twig", trunk, [(at[0] + 0.1, at[1], height * min(0.55, up - 0.1)), end], 0.018)
        for _ in range(count // 34):
            centre = end + Vector([draw.gauss(0, 0.3) for _ in range(3)])
            turned = Euler([draw.uniform(0, 2 * math.pi) for _ in range(3)]).to_matrix()
            first, size = len(points), draw.uniform(0.05, 0.09)
            points += [centre + turned @ Vector(corner) * size for corner in ((-1, 0, 0), (0, -0.5, 0), (1, 0, 0), (0, 0.5, 0))]
            faces.append((first, first + 1, first + 2, first + 3))
    mesh = bpy.data.meshes.new("leaves")
    mesh.from_pydata(points, [], faces)
    put(mesh, of)


def house(side, y, width, height, wall, frame, glass, roof):
    """Walls, windows with glazing bars, a roof of tiles; ``side`` is -1 on the left of the street, 1 on the right."""
    x = side * 7.0
    boxes("house", wall, [((x + side * 2, y, height / 2), (4, width, height))])
    panes, bars = [], []
    for row in range(int(height // 2.8)):
        for column in range(int(width // 2.2)):
            at = y - width / 2 + 1.3 + 2.2 * column, 1.6 + 2.8 * row
            panes.append(((x, at[0], at[1]), (0.1, 1.2, 1.6)))
            bars += [((x - side * 0.08, at[0] + dy, at[1]), (0.06, 0.05, 1.6)) for dy in (-0.6, -0.2, 0.2, 0.6)]
            bars += [((x - side * 0.08, at[0], at[1] + dz), (0.06, 1.2, 0.05)) for dz in (-0.8, -0.27, 0.27, 0.8)]
            bars.append(((x - side * 0.2, at[0], at[1] - 0.85), (0.4, 1.5, 0.07)))
    boxes("panes", glass, panes)
    boxes("bars", frame, bars)
    mesh = bpy.data.meshes.new("roof")
    near, far, mid, top = x - side * 0.4, x + side * 4.4, x + side * 2, height + 2.2
    ends = [y - width / 2 - 0.2, y + width / 2 + 0.2]
    mesh.from_pydata(
        [(at, end, h) for end in ends for at, h in ((near, height), (mid, top), (far, height))],
        [],
        [(0, 1, 4, 3), (1, 2, 5, 4), (0, 1, 2), (3, 4, 5)],
    )
    put(mesh, roof)


def railing(of, y0, y1, x):
    """Thin bars along the pavement."""
    count = int((y1 - y0) / 0.14)
    bars = [((0, y0 + 0.14 * i, 0.5), (0.025, 0.025, 1.0)) for i in range(count)]
    boxes(
        "railing",
        of,
        [*bars, ((0, (y0 + y1) / 2, 1.0), (0.05, y1 - y0, 0.05)), ((0, (y0 + y1) / 2, 0.12), (0.04, y1 - y0, 0.04))],
        at=(x, 0, 0),
    )


def mast(of, at, height):
    """A lattice mast on a roof."""
    x, y, z = at
    corners = [(x + i, y + j) for i, j in ((-0.4, -0.4), (0.4, -0.4), (0.4, 0.4), (-0.4, 0.4))]
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        wire("leg", of, [(x0, y0, z), (x0, y0, z + height)], 0.022)
        for level in range(int(height / 0.8)):
            low, high = z + 0.8 * level, z + 0.8 * (level + 1)
            wire("brace", of, [(x0, y0, low), (x1, y1, high), (x0, y0, high)], 0.014)
    for level in range(3):
        up = z + height - 0.5 * level
        wire("arm", of, [(x - 1.2, y, up), (x + 1.2, y, up)], 0.016)
        for step in range(-4, 5):
            wire("rod", of, [(x + 0.28 * step, y - 0.4, up), (x + 0.28 * step, y + 0.4, up)], 0.01)


def ground(of):
    """Road and pavements."""
    boxes("ground", of["grass"], [((0, 200, -0.3), (800, 500, 0.2))])
    boxes("road", of["asphalt"], [((0, 40, -0.1), (8.4, 160, 0.2))])
    boxes("marks", of["white"], [((0, 4.0 * i, 0.002), (0.14, 2.0, 0.004)) for i in range(-2, 24)])
    boxes("pavement", of["stone"], [((side * 5.8, 40, 0.03), (3.2, 160, 0.26)) for side in (-1, 1)])


def houses(of):
    """Two rows, drawn from a seed."""
    draw = random.Random(3)
    for side in (-1, 1):
        y = 2.0
        while y < 92:
            width, height = draw.choice([6.6, 8.8, 11.0]), draw.choice([5.6, 8.4, 8.4, 11.2])
            wall = of[draw.choice(["brick", "plaster", "ochre", "pale"])]
            house(side, y + width / 2, width, height, wall, of["white"], of["glass"], of["tiles"])
            y += width + 0.02


def wires(iron):
    """Poles, the tram's wires, wires across, masts on roofs."""
    mast(iron, (-8.6, 22, 9.5), 5.6)
    mast(iron, (8.4, 34, 11), 5.0)
    for y in range(8, 64, 12):
        wire("pole", iron, [(-4.6, y, 0), (-4.6, y, 7.4)], 0.05)
        wire("pole", iron, [(4.6, y, 0), (4.6, y, 7.4)], 0.05)
        wire("across", iron, sag((-4.6, y, 7.2), (4.6, y, 7.2), 0.5), 0.012)
        for x in (-1.6, -0.2, 1.6):
            wire("tram", iron, sag((x, y, 6.7), (x, y + 12, 6.7), 0.15), 0.012)
        for x, z in ((-4.9, 7.1), (-4.3, 7.1), (4.9, 7.3), (4.3, 7.3), (-4.6, 7.5)):
            wire("cable", iron, sag((x, y, z), (x, y + 12, z), 0.45), 0.013)
        wire("slant", iron, sag((-7, y + 3, 9.0), (4.6, y + 12, 7.4), 0.6), 0.012)
        wire("slant", iron, sag((7, y + 5, 10.2), (-4.6, y, 7.4), 0.7), 0.012)


def signs(of):
    """Boards across the pavement."""
    for text, board, at, size in (
        ("CAFE  MUSEUM", "blue", (-5.6, 13.2, 4.3), 0.42),
        ("Space-time books", "red", (5.7, 17.5, 3.9), 0.33),
        ("HOTEL", "red", (-5.8, 27.5, 6.8), 0.8),
        ("Station 2 km", "blue", (2.9, 30.0, 5.0), 0.5),
    ):
        boxes("board", of[board], [(at, (0.62 * size * len(text), 0.08, 1.7 * size))])
        ends = [(at[0], at[1], at[2] + 0.85 * size), (math.copysign(7, at[0]), at[1], at[2] + 1.6 * size)]
        wire("bracket", of["iron"], ends, 0.02)
        words(text, of["white"], (at[0], at[1] - 0.06, at[2] - 0.02), size, FACING)


def tram(of):
    """It comes at 10 m/s."""
    arm = [(-0.7, -1, 3.2), (0, 0.6, 4.9), (0.7, -1, 3.2), (0, 0.6, 4.9), (0, 0, 6.55), (-0.8, 0, 6.55), (0.8, 0, 6.55)]
    parts = [
        boxes("tram", of["yellow"], [((0, 0, 1.75), (2.4, 9.0, 2.5))]),
        boxes("front", of["glass"], [((0, -4.52, 2.15), (2.1, 0.06, 1.0))]),
        boxes("bumper", of["iron"], [((0, -4.6, 0.55), (2.3, 0.3, 0.3)), ((0, 0, 3.08), (2.0, 8.0, 0.2))]),
        words("LINE 60", of["iron"], (0, -4.56, 2.83), 0.32, FACING),
        words("540 to 1080", of["iron"], (0, -4.56, 1.3), 0.3, FACING),
        wire("pantograph", of["iron"], arm, 0.025),
    ]
    for part in parts:
        start = part.location.copy()
        for number in (FRAMES[0], FRAMES[-1]):
            part.location = start + Vector((1.0, 26 - number * 10 / 60, 0))
            part.keyframe_insert("location", frame=number)


def camera_and_light(scene):
    """The camera walks forward and to the right, and turns by 12 degrees a second; the sun, and a sky that lights nothing."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera, camera.data.angle = camera, math.radians(64)
    for number in (FRAMES[0], FRAMES[-1]):
        camera.location = (-1.4 + 0.02 * number, -1.0 + 0.05 * number, 1.75)
        camera.rotation_euler = (math.radians(98), 0, math.radians(2.0 - 0.2 * number))
        for path in ("location", "rotation_euler"):
            camera.keyframe_insert(path, frame=number)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    scene.collection.objects.link(sun)
    sun.data.energy, sun.data.angle, sun.rotation_euler = 2.2, 0, (math.radians(38), 0, math.radians(-35))
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.5, 0.68, 0.92, 1)
    scene.world.cycles.sampling_method, scene.world.cycles_visibility.diffuse = "NONE", False


def make():
    """The scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    of = {name: material(name, *look) for name, look in LOOKS.items()}
    ground(of)
    houses(of)
    wires(of["iron"])
    railing(of["iron"], 6, 40, -4.3)
    railing(of["iron"], 6, 40, 4.3)
    tree(of["leaf"], of["bark"], (4.9, 9.5, 0), 6.4, 9000, 1)
    tree(of["leaf"], of["bark"], (-5.0, 17, 0), 6.6, 9000, 2)
    tree(of["leaf"], of["bark"], (5.0, 25, 0), 6.4, 8000, 5)
    signs(of)
    tram(of)
    camera_and_light(scene)
    for thing in scene.objects:
        if thing.animation_data is not None:
            for curve in thing.animation_data.action.layers[0].strips[0].channelbags[0].fcurves:  # Blender 4.4 and newer
                for key in curve.keyframe_points:
                    key.interpolation = "LINEAR"  # evenly
    return scene


def plain(scene):
    """As a rasteriser: direct light alone, nothing random."""
    scene.render.engine, cycles = "CYCLES", scene.cycles
    cycles.device, cycles.max_bounces, cycles.use_denoising, cycles.use_adaptive_sampling = "CPU", 0, False, False
    cycles.pixel_filter_type, cycles.samples = "BOX", 1
    cycles.filter_width = 0.01  # one sample, at the pixel's centre
    scene.view_settings.view_transform = "Standard"
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = *SIZE, 50
    scene.render.use_file_extension = False
    scene.render.use_persistent_data = True
    image = scene.render.image_settings
    if hasattr(image, "media_type"):
        image.media_type = "MULTI_LAYER_IMAGE"
    image.file_format, image.color_depth, image.exr_codec = "OPEN_EXR_MULTILAYER", "16", "ZIP"


def main():
    """Render."""
    out = Path(sys.argv[1])
    scene = make()
    plain(scene)
    scene.frame_start, scene.frame_end = FRAMES[0], FRAMES[-1]
    warnings = set_up(scene.view_layers[0])
    assert not warnings, warnings
    (out / "lr").mkdir(parents=True, exist_ok=True)
    size = scene.render.resolution_x, scene.render.resolution_y
    write_camera(survey(scene, scene.view_layers[0], FRAMES, size), out / "camera.csv")
    for number in FRAMES:
        scene.frame_set(number)
        scene.render.filepath = str(out / "lr" / f"frame.{number:04d}.exr")
        bpy.ops.render.render(write_still=True)
    y, x, height, width = PART
    render, (columns, rows) = scene.render, SIZE
    full = [(render, "resolution_percentage", 100), (scene.cycles, "samples", TRUTH_SAMPLES), (scene.cycles, "filter_width", 1.0)]
    border = {"min_x": x / columns, "max_x": (x + width) / columns, "min_y": 1 - (y + height) / rows, "max_y": 1 - y / rows}
    with changed(*full, (render, "use_border", True), *((render, f"border_{side}", at) for side, at in border.items())):
        scene.render.filepath = str(out / "truth" / f"frame.{FRAMES[-1]:04d}.exr")
        bpy.ops.render.render(write_still=True)
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python tidies up


main()
