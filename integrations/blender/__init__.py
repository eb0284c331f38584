"""warpir in Blender: camera and light of a photo, and objects put into it.

All work is done by warpir in a process of its own environment, named in the preferences; this
add-on moves files between the two (``docs/blender.md``).
"""

from pathlib import Path
from typing import Any

import bpy
from bpy.props import BoolProperty, IntProperty, PointerProperty, StringProperty

from . import scene as scenes
from .job import Failure, Job

_jobs: list[Job] = []
"""The one that is running, if any."""
PYTHON = "The interpreter of the environment into which warpir was installed"
FLAGS = "Of python -m warpir.insert for the {}, such as {}"


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __package__
    python: StringProperty(name="Python with warpir", description=PYTHON, subtype="FILE_PATH")

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "python")


class Settings(bpy.types.PropertyGroup):
    """A scene's; ``light`` is the folder of the last estimate, ``result`` of the last run."""

    samples: IntProperty(name="Samples", description="Per pixel; 0: 32 or so", min=0, max=4096)
    estimate_flags: StringProperty(
        name="Flags of the estimate",
        description=FLAGS.format("estimate", "--fov 50 --camera-height 1.2"),
    )
    flags: StringProperty(
        name="Flags of the insertion",
        description=FLAGS.format("insertion", "--sharpness off --grain off"),
    )
    light: StringProperty()
    light_of: StringProperty(description="The estimate's photo")
    result: StringProperty()


class Run:
    """Runs warpir while Blender goes on; in the background, where nobody waits, it blocks."""

    bl_options = {"UNDO"}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return not _jobs

    def execute(self, context: Any) -> set[str]:
        preferences = context.preferences.addons[__package__].preferences
        self.scene = context.scene.name
        try:
            self.folder = scenes.new_folder(self.folder_name)
            arguments = self.arguments(context, self.folder)
            _jobs.append(Job(bpy.path.abspath(preferences.python), arguments, self.folder))
        except (Failure, OSError, ValueError) as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if bpy.app.background:
            while not _jobs[0].has_ended(1.0):
                pass
            return self.end()
        self.timer = context.window_manager.event_timer_add(0.2, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Any, event: Any) -> set[str]:
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        for window in context.window_manager.windows:
            for area in window.screen.areas:
                area.tag_redraw()
        if not _jobs[0].has_ended():
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self.timer)
        return self.end()

    def end(self) -> set[str]:
        job = _jobs.pop()
        try:
            job.check()
            if (scene := bpy.data.scenes.get(self.scene)) is None:
                raise Failure(f"Its scene is gone; the results are in {self.folder}")
            self.show(scene, self.folder)
        except Failure as error:
            self.report({"WARNING" if job.is_cancelled else "ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class WARPIR_OT_estimate(Run, bpy.types.Operator):
    """Set camera, light, ground and compositor from the camera's background image"""

    bl_idname, bl_label, folder_name = "warpir.estimate", "Estimate Camera and Light", "estimate"
    arguments = staticmethod(scenes.estimate_arguments)
    show = staticmethod(scenes.show_estimate)


class WARPIR_OT_insert(Run, bpy.types.Operator):
    """Render the selection into the photo; show the composite and its layers"""

    bl_idname, bl_label, folder_name = "warpir.insert", "Insert Selection with warpir", "insertion"
    arguments = staticmethod(scenes.insert_arguments)
    show = staticmethod(scenes.show_insertion)


class WARPIR_OT_photo(bpy.types.Operator):
    """Choose the photo: the background image of the scene's camera"""

    bl_idname, bl_label, bl_options = "warpir.photo", "Photo...", {"UNDO"}
    filepath: StringProperty(subtype="FILE_PATH")
    filter_image: BoolProperty(default=True, options={"HIDDEN"})

    def invoke(self, context: Any, event: Any) -> set[str]:
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: Any) -> set[str]:
        try:
            scenes.set_photo(context.scene, self.filepath)
        except Failure as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}


class WARPIR_OT_cancel(bpy.types.Operator):
    """Stop warpir"""

    bl_idname, bl_label = "warpir.cancel", "Cancel"

    def execute(self, context: Any) -> set[str]:
        for job in _jobs:
            job.cancel()
        return {"FINISHED"}


class WARPIR_OT_report(bpy.types.Operator):
    """Open the report of the last run in the browser"""

    bl_idname, bl_label = "warpir.report", "Open Report"

    def execute(self, context: Any) -> set[str]:
        path = Path(context.scene.warpir.result, "report.html")
        if not path.is_file():
            self.report({"ERROR"}, "There is no report yet: estimate or insert first")
            return {"CANCELLED"}
        return bpy.ops.wm.url_open(url=path.as_uri())


class Panel:
    bl_label = "warpir"

    def draw(self, context: Any) -> None:
        layout, scene = self.layout, context.scene
        try:
            layout.label(text=scenes.photo_of(scene)[1].name, icon="IMAGE_DATA")
        except Failure as error:
            layout.label(text=str(error), icon="INFO")
        layout.operator("warpir.photo", icon="FILEBROWSER")
        layout.prop(scene.warpir, "estimate_flags")
        layout.operator("warpir.estimate", icon="LIGHT_SUN")
        layout.prop(scene.warpir, "samples")
        layout.prop(scene.warpir, "flags")
        layout.operator("warpir.insert", icon="RENDER_STILL")
        for job in _jobs:
            layout.progress(factor=job.share, text=job.lines[-1][:80] or "Starting warpir")
            layout.operator("warpir.cancel", icon="CANCEL")
        layout.operator("warpir.report", icon="URL")


class WARPIR_PT_view(Panel, bpy.types.Panel):
    bl_space_type, bl_region_type, bl_category = "VIEW_3D", "UI", "warpir"


class WARPIR_PT_camera(Panel, bpy.types.Panel):
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "data"

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.camera is not None


RUNS = WARPIR_OT_estimate, WARPIR_OT_insert, WARPIR_OT_cancel
SHOWN = WARPIR_OT_photo, WARPIR_OT_report, WARPIR_PT_view, WARPIR_PT_camera
CLASSES = Preferences, Settings, *RUNS, *SHOWN
register_all, unregister_all = bpy.utils.register_classes_factory(CLASSES)


def register() -> None:
    register_all()
    bpy.types.Scene.warpir = PointerProperty(type=Settings)


def unregister() -> None:
    for job in _jobs:
        job.cancel()
    del bpy.types.Scene.warpir
    unregister_all()
