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
    bpy.ops.wm.read_homefile(use_empty=True)  # a new file: preferences, and so the extension, stay
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


def make_trap(mine):
    """An artist's scene: objects that move without keys of their own, two cameras, layers, a compositor that writes files, a sequencer,
    50 %."""
    scene, monkey = make_scene()
    monkey.animation_data_clear()
    bpy.ops.object.armature_add()
    bone = bpy.context.object.pose.bones["Bone"]
    monkey.vertex_groups.new(name="Bone").add(range(len(monkey.data.vertices)), 1, "ADD")
    monkey.modifiers.new("armature", "ARMATURE").object = bpy.context.object
    bpy.ops.mesh.primitive_cube_add(location=(0, 2, 1))
    cube = bpy.context.object
    cube.shape_key_add(name="Basis")
    key = cube.shape_key_add(name="up")
    for point in key.data:
        point.co.z += 1
    bpy.ops.mesh.primitive_uv_sphere_add(radius=0.3)
    ball, inside, empty = bpy.context.object, bpy.data.collections.new("inside"), bpy.data.objects.new("instance", None)
    ball.data.materials.append(bpy.data.materials.new("ball"))
    ball.data.materials[0].use_nodes = True
    inside.objects.link(ball)
    scene.collection.objects.unlink(ball)
    scene.collection.objects.link(empty)
    empty.instance_type, empty.instance_collection = "COLLECTION", inside
    for number in (1001, 1006):
        key.value = bone.location.x = empty.location.x = (number - 1001) / 4
        key.keyframe_insert("value", frame=number)
        bone.keyframe_insert("location", frame=number)
        empty.keyframe_insert("location", frame=number)
    bpy.ops.object.camera_add(location=(0, -6, 9), rotation=(0.5, 0, 0))
    for number, camera in ((1001, scene.camera), (1004, bpy.context.object)):
        scene.timeline_markers.new("cut", frame=number).camera = camera
    scene.frame_start, scene.frame_end = 1001, 1006
    scene.view_layers.new("zweite Ebene ö")
    scene.view_layers[0].use = False
    scene.view_layers.new("third")
    scene.use_nodes = scene.render.use_motion_blur = scene.render.use_border = True
    scene.render.border_max_x = 0.5
    write_files(scene, mine)
    edit = scene.sequence_editor_create()
    (edit.strips if hasattr(edit, "strips") else edit.sequences).new_effect(
        "c", "COLOR", 1, frame_start=1001, **length_of(edit, 9)
    )
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = 130, 90, 50
    return scene, [monkey, cube, ball, scene.objects["Plane"]]


def write_files(scene, folder):
    """A File Output node."""
    if hasattr(scene, "compositing_node_group"):  # Blender 5
        tree = scene.compositing_node_group = bpy.data.node_groups.new("compositor", "CompositorNodeTree")
        layers, files = tree.nodes.new("CompositorNodeRLayers"), tree.nodes.new("CompositorNodeOutputFile")
        layers.scene, files.directory = scene, str(folder)
        files.file_output_items.new("RGBA", "Image")
    else:
        tree = scene.node_tree
        files = tree.nodes.new("CompositorNodeOutputFile")
        files.base_path, layers = str(folder), next(node for node in tree.nodes if node.type == "R_LAYERS")
    tree.links.new(layers.outputs[0], files.inputs[0])


def length_of(edit, frames):
    """A strip's length: Blender 5 takes it, older ones its end."""
    kinds = (edit.strips if hasattr(edit, "strips") else edit.sequences).bl_rna.functions["new_effect"].parameters
    return {"length": frames} if "length" in kinds else {"frame_end": 1001 + frames}


def press():
    try:
        return str(bpy.ops.stss.render())
    except RuntimeError as error:
        return str(error)


def trap(out):
    scene, things = make_trap(out / "mine")
    scene.stss.options = "--backend ref --weights bilinear"
    unsaved = press()
    scene.stss.folder = str(out / "trap")
    refused = {"unsaved": unsaved}
    for name, of, value in (("use_multiview", scene.render, True), ("frame_step", scene, 2)):
        before = getattr(of, name)
        setattr(of, name, value)
        refused[name] = press()
        setattr(of, name, before)
    scene.camera.data.type = "ORTHO"
    refused["camera"] = press()
    scene.camera.data.type = "PERSP"
    scene.stss.folder, here = "trap", scene.stss.folder
    refused["relative"] = press()
    scene.stss.folder = here
    scene.stss.options += " --cuts 1001"
    refused["cuts"] = press()
    scene.stss.options = "--format jpg"
    refused["format"] = press()
    tried = len([*(out / "trap" / "lr").iterdir()])
    scene.stss.options = "--backend ref --weights bilinear --cuts=1006"
    before = (scene.render.resolution_x, scene.render.use_compositing, scene.view_layers[2].use)
    outcome = press()
    image = bpy.data.images["stss"]
    return {
        "refused": refused,
        "tried": tried,
        "done": outcome,
        "kept": before == (scene.render.resolution_x, scene.render.use_compositing, scene.view_layers[2].use),
        "index": [thing.pass_index for thing in things],
        "image": [image.filepath, image.use_view_as_render],
    }


def main():
    packed, out = Path(sys.argv[1]), Path(sys.argv[2])
    assert not cli_extension_handler(["install-file", "--repo", "user_default", "--enable", str(packed)])
    numpy_of_blender = numpy.__file__
    scene, monkey = make_scene()
    render_truth(scene, out / "truth")
    before = settings(scene)
    scene.stss.options = "--backend ref --format png --weights bilinear"
    bpy.ops.wm.save_as_mainfile(filepath=str(out / "shot.blend"))
    scene.stss.folder = str(out / "film")
    (out / "film" / "lr").mkdir(parents=True)  # of an earlier film, which was longer
    (out / "film" / "stss-film").touch()
    (out / "film" / "lr" / "frame.0009.exr").touch()
    state = bpy.ops.stss.render()
    # A device's kernels take a minute to compile; the reference has the same network.
    scene.stss.options = "--backend ref"
    again = bpy.ops.stss.render()
    files = sorted((out / "film" / "lr").iterdir())
    before_keeping = [path.stat().st_mtime_ns for path in files]
    files[3].unlink()
    scene.render.use_overwrite = False
    bpy.ops.stss.render()
    kept = [path.stat().st_mtime_ns == time for path, time in zip(files, before_keeping, strict=True)]
    scene.render.resolution_x += 2
    bpy.ops.stss.render()
    renewed = [path.stat().st_mtime_ns == time for path, time in zip(files, before_keeping, strict=True)]
    scene.render.resolution_x -= 2
    scene.render.use_overwrite = True
    bpy.ops.stss.render()
    scene.stss.options = "--cuts 99"
    report = {
        "state": [*state, *again],
        "refused": press(),
        "kept": before == settings(scene),
        "overwrite": [kept, renewed],
        "image": bpy.data.images["stss"].source,
        "index": [scene.objects["Plane"].pass_index, monkey.pass_index],
        "python": sys.path,
        "numpy": numpy_of_blender,
        "trap": trap(out),
    }
    (out / "found.json").write_text(json.dumps(report))


try:
    main()
except BaseException:
    traceback.print_exc()
finally:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # Blender as a module may wait for ever when Python exits
