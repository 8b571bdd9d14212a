# SPDX-License-Identifier: MIT
"""Space-time supersampling in Blender: a panel in the render properties."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy

from . import film
from .passes import layer_of, set_up, survey

RELATIVE = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()
"""Blender 4.5 and newer want to be told that a path may begin with //."""


class Preferences(bpy.types.AddonPreferences):
    """Settings of the user, not of a scene: another person's file must not name a program to run."""

    bl_idname = __package__

    command: bpy.props.StringProperty(name="Command", description="Command that starts stss; empty: the one in this extension")  # type: ignore[valid-type]

    def draw(self, context: Any) -> None:
        """Draw the preferences."""
        del context
        self.layout.prop(self, "command")


def chosen_command(context: Any) -> list[str]:
    """The words of the command in the preferences; empty: none is there."""
    addon = context.preferences.addons.get(__package__)
    return [] if addon is None else film.split_words(addon.preferences.command)


def folder_of(path: str) -> Path:
    """The folder of the panel.

    Raises:
        film.FilmError: there is none, or it lies beside a .blend that was never saved.
    """
    if not path:
        raise film.FilmError("Folder: expected one, found nothing")
    if path.startswith("//") and not bpy.data.filepath:
        raise film.FilmError(f"Folder: {path} lies beside the .blend: save it first, or name a whole path")
    folder = Path(bpy.path.abspath(path))
    if not folder.is_absolute():
        raise film.FilmError(f"Folder: {path}: expected a whole path, or one that begins with // beside the .blend")
    return folder


class Settings(bpy.types.PropertyGroup):
    """The user's choices, stored in the scene, which may be somebody else's: no paths but the folder, no programs."""

    folder: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Folder", subtype="DIR_PATH", default="//stss", description="For frames and results", options=RELATIVE
    )
    options: bpy.props.StringProperty(name="Options", description="Options of stss run without paths, such as --format png")  # type: ignore[valid-type]


class SetUp(bpy.types.Operator):
    """Turn on the passes and AOVs that stss needs, and number moving objects."""

    bl_idname, bl_label, bl_options = "stss.set_up", "Set up passes", {"REGISTER", "UNDO"}

    def execute(self, context: Any) -> set[str]:
        """Set up the scene, and report warnings."""
        scene = context.scene
        try:
            film.require(scene)
        except film.FilmError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        layer, here = layer_of(scene), scene.frame_current
        for line in set_up(layer):
            self.report({"WARNING"}, line)
        survey(scene, layer, range(scene.frame_start, scene.frame_end + 1), film.half_size(scene))
        scene.frame_set(here)
        return {"FINISHED"}


class Render(bpy.types.Operator):
    """Render half the frames at half the size, and make all of them at full size."""

    bl_idname, bl_label = "stss.render", "Render and supersample"

    def invoke(self, context: Any, event: Any) -> set[str]:
        """The button: the status bar shows the progress, Esc stops it; Blender draws between frames and takes no other input."""
        del event
        self.steps = self.work(context)
        self.timer = context.window_manager.event_timer_add(0.01, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Any, event: Any) -> set[str]:
        """One step for each tick of the timer."""
        if event.type == "ESC":
            self.report({"WARNING"}, "stopped")
            return self.end(context, {"CANCELLED"})
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        result, line = self.step()
        if result is not None:
            return self.end(context, result)
        context.workspace.status_text_set(f"{line}. Esc stops it.")
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        """Without a window, or called from Python: all steps in one call."""
        self.steps, result, before = self.work(context), None, ""
        while result is None:
            result, line = self.step()
            if result is None and line != before:
                # Blender prints what an operator reports only when it ends.
                print(line, flush=True)  # noqa: T201
            before = line
        return result

    def step(self) -> tuple[set[str] | None, str]:
        """Go on; returns the operator's result, or None and a line on the progress."""
        try:
            return None, next(self.steps)
        except StopIteration as done:
            self.report({"INFO"}, done.value)
            return {"FINISHED"}, ""
        except (film.FilmError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}, ""

    def end(self, context: Any, state: set[str]) -> set[str]:
        """Stop what goes on, and give the status bar back."""
        self.steps.close()
        context.window_manager.event_timer_remove(self.timer)
        context.workspace.status_text_set(None)
        return state

    def work(self, context: Any) -> Generator[str, None, str]:
        """Render, run stss and load the result; yields lines on the progress, and returns the last one."""
        scene, settings = context.scene, context.scene.stss
        folder, command = folder_of(settings.folder), chosen_command(context)
        cuts, options = film.cuts_of(film.harmless(settings.options))
        film.require(scene, cuts)
        for line in film.list_unused(scene):
            self.report({"WARNING"}, line)
        first = scene.frame_start
        warnings, cuts = yield from film.render(scene, folder, cuts, lambda: film.try_first(folder, first, command, options))
        out, lines = yield from film.supersample(folder, cuts, command, options)
        image, count = film.load(out), scene.frame_end - scene.frame_start + 1
        for line in warnings:
            self.report({"WARNING"}, line)
        for line in lines:
            self.report({"INFO"}, line)
        for area in context.screen.areas if context.screen is not None else ():
            if area.type == "IMAGE_EDITOR":
                area.spaces.active.image = image
                film.show(area.spaces.active.image_user, scene.frame_start, count)
        return f"{out}: {count} frames"


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
