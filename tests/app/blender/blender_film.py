"""Run by a Python that has bpy: the extension's zip, installed as Blender installs it; a small scene; the button.

``PYTHON blender_film.py ZIP OUT``, with ``BLENDER_USER_RESOURCES`` naming a folder of its own. Writes ``OUT/found.json``, the frames
that Blender renders at full size, as ``OUT/truth/frame.NNNN.exr``, and what the button makes.
"""

import json
import os
import sys
import traceback
from pathlib import Path

import bpy
import numpy
from bl_pkg.bl_extension_cli import cli_extension_handler

FRAMES = range(1, 9)


def settings(scene):
    render = scene.render
    return render.filepath, render.resolution_percentage, render.image_settings.file_format, scene.cycles.samples


def make_scene():
    """A monkey that crosses a plane."""
    bpy.ops.wm.read_homefile(use_empty=True)  # of a new file: preferences, and so the extension, stay
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=20)
    bpy.ops.mesh.primitive_monkey_add(location=(0, 0, 1))
    monkey = bpy.context.object
    for thing, colour in ((scene.objects["Plane"], (0.2, 0.4, 0.1, 1)), (monkey, (0.8, 0.2, 0.1, 1))):
        material = bpy.data.materials.new(thing.name)
        material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = colour
        thing.data.materials.append(material)
    for number in (FRAMES[0], FRAMES[-1]):
        monkey.location.x = 0.2 * number - 0.9
        monkey.keyframe_insert("location", frame=number)
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.3, 0))
    bpy.ops.object.camera_add(location=(0, -6, 3), rotation=(1.2, 0, 0))
    scene.camera = bpy.context.object
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 64, 100
    scene.frame_start, scene.frame_end = FRAMES[0], FRAMES[-1]
    scene.render.threads_mode, scene.render.threads = "FIXED", 2
    return scene, monkey


def render_truth(scene, folder):
    before = settings(scene)
    image = scene.render.image_settings
    image.file_format, scene.cycles.samples = "OPEN_EXR", 16
    for number in FRAMES:
        scene.frame_set(number)
        scene.render.filepath = str(folder / f"frame.{number:04d}.exr")
        bpy.ops.render.render(write_still=True)
    scene.render.filepath, _, image.file_format, scene.cycles.samples = before


def main():
    packed, out = Path(sys.argv[1]), Path(sys.argv[2])
    assert not cli_extension_handler(["install-file", "--repo", "user_default", "--enable", str(packed)])
    numpy_of_blender = numpy.__file__
    scene, monkey = make_scene()
    render_truth(scene, out / "truth")
    before = settings(scene)
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "shot.blend"))
    scene.stss.folder = str(out / "film")
    scene.stss.options = "--backend ref --format png --weights bilinear"
    (out / "film" / "lr").mkdir(parents=True)  # of an earlier film, which was longer
    (out / "film" / "stss-film").touch()
    (out / "film" / "lr" / "frame.0009.exr").touch()
    state = bpy.ops.stss.render()
    # A device's kernels take a minute to compile; the reference has the same network.
    scene.stss.options = "--backend ref"
    again = bpy.ops.stss.render()
    scene.stss.options = "--cuts 99"
    try:
        refused = str(bpy.ops.stss.render())
    except RuntimeError as error:
        refused = str(error)
    report = {
        "state": [*state, *again],
        "refused": refused,
        "kept": before == settings(scene),
        "image": bpy.data.images["stss"].source,
        "index": [scene.objects["Plane"].pass_index, monkey.pass_index],
        "python": sys.path,
        "numpy": numpy_of_blender,
    }
    (out / "found.json").write_text(json.dumps(report))


try:
    main()
except BaseException:
    traceback.print_exc()
finally:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python tidies up
