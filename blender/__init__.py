# SPDX-License-Identifier: MIT
"""Space-time supersampling in Blender: a panel in the render properties."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import bpy

from . import film
from .passes import set_up


class Preferences(bpy.types.AddonPreferences):
    """What is the user's and no scene's: a file of somebody else must not name a program to run."""

    bl_idname = __package__

    command: bpy.props.StringProperty(name="Command", description="Command that starts stss; empty: the one in this extension")  # type: ignore[valid-type]

    def draw(self, context: Any) -> None:
        """Draw the preferences."""
        del context
        self.layout.prop(self, "command")


def chosen_command(context: Any) -> list[str]:
    """The words of the command in the preferences; empty: none is there."""
    addon = context.preferences.addons.get(__package__)
    return [] if addon is None else shlex.split(addon.preferences.command)


class Settings(bpy.types.PropertyGroup):
    """The user's choices, stored in the scene, which may be somebody else's: no paths but the folder, no programs."""

    folder: bpy.props.StringProperty(name="Folder", subtype="DIR_PATH", default="//stss", description="For frames and results")  # type: ignore[valid-type]
    options: bpy.props.StringProperty(name="Options", description="Options of stss run without paths, such as --format png")  # type: ignore[valid-type]


class SetUp(bpy.types.Operator):
    """Turn on the passes and AOVs that stss needs, and number moving objects."""

    bl_idname, bl_label, bl_options = "stss.set_up", "Set up passes", {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Set up the scene, and report warnings."""
        for line in set_up(context.scene, context.view_layer):
            self.report({"WARNING"}, line)
        return {"FINISHED"}


class Render(bpy.types.Operator):
    """Render half the frames at half the size, and make all of them at full size."""

    bl_idname, bl_label = "stss.render", "Render and supersample"

    def execute(self, context: Any) -> set[str]:
        """Render, run stss and load the result; Blender waits until all is done."""
        scene, chosen = context.scene, context.scene.stss
        folder, window = Path(bpy.path.abspath(chosen.folder)), context.window_manager
        window.progress_begin(scene.frame_start, scene.frame_end)
        try:
            options = film.harmless(chosen.options)
            told = film.render(scene, folder, window.progress_update)
            out = film.supersample(folder, scene.frame_start, chosen_command(context), options)
            image = film.load(out)
        except (film.FilmError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        finally:
            window.progress_end()
        for line in told:
            self.report({"WARNING"}, line)
        for area in context.screen.areas if context.screen is not None else ():
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
        self.report({"INFO"}, f"{out}: {scene.frame_end - scene.frame_start + 1} frames")
        return {"FINISHED"}


class Panel(bpy.types.Panel):
    """The panel."""

    bl_idname, bl_label = "RENDER_PT_stss", "Space-time supersampling"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "render"

    def draw(self, context: Any) -> None:
        """Draw the settings and the two buttons."""
        layout = self.layout
        layout.use_property_split = True
        for name in ("folder", "options"):
            layout.prop(context.scene.stss, name)
        layout.operator(SetUp.bl_idname)
        layout.operator(Render.bl_idname)


CLASSES = (Preferences, Settings, SetUp, Render, Panel)


def register() -> None:
    """Called by Blender."""
    for one in CLASSES:
        bpy.utils.register_class(one)
    bpy.types.Scene.stss = bpy.props.PointerProperty(type=Settings)


def unregister() -> None:
    """Called by Blender."""
    del bpy.types.Scene.stss
    for one in reversed(CLASSES):
        bpy.utils.unregister_class(one)
