"""Blender add-on: relightable 4D Gaussians of a container (b4d) or a PLY, as discs that Cycles and EEVEE light.

An object keeps the path of its take, not its frames: a handler puts the Gaussians of the scene's time into its mesh.
"""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.app.handlers import persistent
from bpy.props import BoolProperty, CollectionProperty, FloatProperty, PointerProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from .decoder import DeliveryError
from .discs import disc_material, disc_nodes, fill
from .takes import Take, TakeError, open_take

TRANSPARENT_BOUNCES = 128
"""Discs that a path may pass: Cycles ends it after eight by default, which shows as dark spots."""

_takes: dict[tuple[str, str, int], Take] = {}


def _taken(filepath: str, axes: str) -> Take:
    """Return a take, open since it was last changed."""
    path = bpy.path.abspath(filepath)
    try:
        key = path, axes, Path(path).stat().st_mtime_ns
    except OSError:
        raise TakeError(f"take must be a file, got {path}. Choose it again.") from None
    if key not in _takes:
        for old in [each for each in _takes if each[:2] == key[:2]]:
            del _takes[old]
        _takes[key] = open_take(path, axes)
    return _takes[key]


def seconds_at(settings: RelightableSettings, scene: bpy.types.Scene, take: Take) -> float:
    """Return the time of a take at the scene's time [s]."""
    since = (scene.frame_current_final - settings.start) * scene.render.fps_base / scene.render.fps * settings.speed
    return since % (take.frames / take.rate) if settings.repeat else since


def show(thing: bpy.types.Object, scene: bpy.types.Scene) -> None:
    """Put the Gaussians of the scene's time into an object; what cannot be read leaves the last ones, and is told."""
    settings, problem = thing.relightable, ""
    try:
        take = _taken(settings.filepath, settings.axes)
        fill(thing.data, take.at(seconds_at(settings, scene, take)))
    except (TakeError, DeliveryError, OSError) as error:
        problem = " ".join(str(error).split())
    if problem != settings.problem:
        settings.problem = problem
        if problem:
            print(f"{thing.name}: {problem}")


@persistent
def follow_time(scene: bpy.types.Scene, _graph: object = None) -> None:
    """Show every take at the scene's time, before Blender evaluates it."""
    for thing in scene.objects:
        if thing.type == "MESH" and thing.relightable.filepath:
            show(thing, scene)


def _changed(settings: RelightableSettings, context: bpy.types.Context) -> None:
    if settings.filepath:
        show(settings.id_data, context.scene)


class RelightableSettings(bpy.types.PropertyGroup):
    """What an object keeps of its take."""

    filepath: StringProperty(name="Take", subtype="FILE_PATH", description="b4d, manifest.json or PLY", update=_changed)
    axes: StringProperty(name="Axes", description="Axes of a PLY that does not state them: rdf if empty")
    start: FloatProperty(name="Start", default=1.0, description="Scene frame of the take's first one", update=_changed)
    speed: FloatProperty(name="Speed", default=1.0, description="Share of the speed of the take", update=_changed)
    repeat: BoolProperty(name="Repeat", description="Begin again at the end, not hold the last frame", update=_changed)
    problem: StringProperty(name="Problem", description="Why these are not the Gaussians of this time")


class IMPORT_SCENE_OT_relightable(bpy.types.Operator, ImportHelper):
    """Import relightable Gaussians of a b4d container, or of a PLY with materials"""

    bl_idname = "import_scene.relightable"
    bl_label = "Import Relightable Gaussians"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012  Blender wants a set

    filter_glob: StringProperty(default="*.b4d;*.ply;manifest.json", options={"HIDDEN"})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"})
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    axes: StringProperty(name="PLY axes", default="rdf", description="Axes of a PLY that does not state them")
    start: FloatProperty(name="Start", default=1.0, description="Scene frame of the take's first one")
    speed: FloatProperty(name="Speed", default=1.0, description="Share of the speed of the take")
    repeat: BoolProperty(name="Repeat", description="Begin again at the end, not hold the last frame")
    bounces: BoolProperty(
        name="Raise transparent bounces",
        default=True,
        description=f"Let Cycles pass {TRANSPARENT_BOUNCES} discs: with fewer, edges are dark",
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask for files, or for options if files were dropped."""
        return self.invoke_popup(context) if self.directory or self.filepath else super().invoke(context, event)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Import all files; one that cannot be read is reported, in one line."""
        names = [Path(self.directory, each.name) for each in self.files if each.name]
        made = [self._import(context, path) for path in names or [Path(self.filepath)]]
        if self.bounces and any(made) and hasattr(context.scene, "cycles"):
            settings = context.scene.cycles
            settings.transparent_max_bounces = max(settings.transparent_max_bounces, TRANSPARENT_BOUNCES)
        return {"FINISHED"} if any(made) else {"CANCELLED"}

    def _import(self, context: bpy.types.Context, path: Path) -> bool:
        """Make an object of a file."""
        try:
            take = _taken(str(path), self.axes)
            arrays = take.at(0.0)
        except (TakeError, DeliveryError, OSError) as error:
            self.report({"ERROR"}, " ".join(str(error).split()))
            return False
        thing = bpy.data.objects.new(path.stem, bpy.data.meshes.new(path.stem))
        fill(thing.data, arrays)
        material = disc_material()
        thing.data.materials.append(material)
        thing.modifiers.new("Relightable discs", "NODES").node_group = disc_nodes(material)
        context.collection.objects.link(thing)
        context.view_layer.objects.active = thing
        thing.select_set(True)
        for name in ("axes", "start", "speed", "repeat"):
            thing.relightable[name] = getattr(self, name)
        thing.relightable.filepath = str(path)  # shows the scene's time
        return True


class VIEW3D_FH_relightable(bpy.types.FileHandler):
    """Files that are dropped into a 3D view."""

    bl_idname = "VIEW3D_FH_relightable"
    bl_label = "Relightable Gaussians"
    bl_import_operator = IMPORT_SCENE_OT_relightable.bl_idname
    bl_file_extensions = ".b4d;.ply"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Take files in 3D views."""
        return context.area is not None and context.area.type == "VIEW_3D"


class OBJECT_PT_relightable(bpy.types.Panel):
    """The take of an object."""

    bl_label = "Relightable Gaussians"
    bl_space_type, bl_region_type, bl_context = "PROPERTIES", "WINDOW", "object"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Show it for objects with a take."""
        return context.object is not None and bool(context.object.relightable.filepath)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the settings, and what is wrong."""
        settings, column = context.object.relightable, self.layout.column()
        for name in ("filepath", "start", "speed", "repeat"):
            column.prop(settings, name)
        if settings.problem:
            column.label(text=settings.problem, icon="ERROR")


CLASSES = (RelightableSettings, IMPORT_SCENE_OT_relightable, VIEW3D_FH_relightable, OBJECT_PT_relightable)


def _menu(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    menu.layout.operator(IMPORT_SCENE_OT_relightable.bl_idname, text="Relightable Gaussians (.b4d, .ply)")


def register() -> None:
    """Add the add-on to Blender."""
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Object.relightable = PointerProperty(type=RelightableSettings)
    bpy.types.TOPBAR_MT_file_import.append(_menu)
    bpy.app.handlers.frame_change_pre.append(follow_time)


def unregister() -> None:
    """Take the add-on out of Blender; imported points keep their discs and material."""
    bpy.app.handlers.frame_change_pre.remove(follow_time)
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    del bpy.types.Object.relightable
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
    _takes.clear()
