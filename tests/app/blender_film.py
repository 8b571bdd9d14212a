"""Run by a Python that has bpy: a small scene from nothing to supersampled frames, by the extension's own operators.

PYTHON blender_film.py EXTENSION_FOLDER OUT COMMAND
"""

import importlib.util
import json
import os
import shlex
import sys
import traceback
from pathlib import Path

import bpy


def settings(scene):
    render = scene.render
    return render.filepath, render.resolution_percentage, render.image_settings.file_format, scene.cycles.samples


def main():
    place, out, command = Path(sys.argv[1]), sys.argv[2], sys.argv[3]
    spec = importlib.util.spec_from_file_location("stss_blender", place / "__init__.py", submodule_search_locations=[str(place)])
    extension = sys.modules["stss_blender"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(extension)

    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    bpy.ops.mesh.primitive_plane_add(size=20)
    bpy.ops.mesh.primitive_monkey_add(size=2, location=(0, 0, 1))
    monkey = bpy.context.object
    for thing, colour in ((scene.objects["Plane"], (0.2, 0.4, 0.1, 1)), (monkey, (0.8, 0.2, 0.1, 1))):
        material = bpy.data.materials.new(thing.name)
        material.use_nodes = True
        material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = colour
        thing.data.materials.append(material)
    for number in (0, 6):
        monkey.location.x = 0.1 * number
        monkey.keyframe_insert("location", frame=number)
    bpy.ops.object.light_add(type="SUN", rotation=(0.5, 0.3, 0))
    bpy.ops.object.camera_add(location=(0, -6, 3), rotation=(1.2, 0, 0))
    scene.camera = bpy.context.object
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 4, False
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 96, 64, 100
    scene.frame_start, scene.frame_end = 1, 4
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    before = settings(scene)

    extension.register()
    scene.stss.folder = out
    extension.chosen_command = lambda context: shlex.split(command)
    scene.stss.options = "--backend ref --weights bilinear"
    state = bpy.ops.stss.render()
    image = bpy.data.images["stss"]
    found = {
        "state": list(state),
        "kept": before == settings(scene),
        "image": image.source,
        "index": [scene.objects["Plane"].pass_index, monkey.pass_index],
    }
    extension.unregister()
    Path(out, "found.json").write_text(json.dumps(found))


try:
    main()
except BaseException:
    traceback.print_exc()
finally:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python tidies up
