"""What `test_addon.py` runs in Blender: ``python inside_blender.py JOB.json`` writes arrays and facts beside the job.

The add-on is installed from its zip, as a user does it. A job that names an ``engine`` renders the disc by it, no more.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np

FOLDER = Path(sys.argv[1]).parent
JOB = json.loads(Path(sys.argv[1]).read_text())


def evaluated(thing, name, size=3):
    """An attribute of the mesh that is drawn, a row for each vertex."""
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    attribute = mesh.attributes[name]
    values = np.empty(len(attribute.data) * size, np.float32)
    attribute.data.foreach_get("vector" if size == 3 else "value", values)
    return values.reshape(-1, size)


def refused(path):
    try:
        return str(bpy.ops.import_scene.relightable(filepath=path))
    except RuntimeError as error:
        return str(error)


def rendered(path, size, samples, engine="CYCLES"):
    """Radiance and alpha of a square picture of the scene, from above and 4 m wide, under white light."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.location, camera.data.type, camera.data.ortho_scale = (0.0, 0.0, 9.0), "ORTHO", 4.0
    world = bpy.data.worlds.new("white")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (1.0, 1.0, 1.0, 1.0)
    scene.camera, scene.world, scene.render.engine = camera, world, engine
    render = scene.render
    render.resolution_x = render.resolution_y = size
    render.film_transparent, scene.cycles.pixel_filter_type = True, "BOX"
    scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.use_adaptive_sampling = samples, False, False
    scene.eevee.taa_render_samples, render.filter_size = samples, 0.01
    render.image_settings.file_format, render.image_settings.color_depth = "OPEN_EXR", "32"
    render.image_settings.color_mode, render.filepath = "RGBA", str(path)
    bpy.ops.render.render(write_still=True)


bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(filepath=JOB["addon"], repo="user_default", enable_on_install=True)
if "engine" in JOB:
    bpy.ops.import_scene.relightable(filepath=JOB["disc"])
    names = [each.identifier for each in bpy.types.RenderSettings.bl_rna.properties["engine"].enum_items]
    engine = next(name for name in names if name.startswith(JOB["engine"]))
    rendered(FOLDER / f"{JOB['engine']}.exr", JOB["size"], JOB["samples"], engine)
    sys.exit()
scene = bpy.context.scene
scene.render.fps = 5  # the take has 10 frames a second
facts = {"menu": any("relightable" in draw.__module__ for draw in bpy.types.TOPBAR_MT_file_import._dyn_ui_initialize())}
facts |= {"dropped": bpy.types.VIEW3D_FH_relightable.bl_file_extensions, "refused": [refused(p) for p in JOB["broken"]]}

bpy.ops.import_scene.relightable(filepath=JOB["take"])
thing = bpy.context.object
facts["bounces"] = scene.cycles.transparent_max_bounces
frames = {}
for frame in (1, 2):
    scene.frame_set(frame)
    frames[f"corners_{frame}"] = evaluated(thing, "position")
    frames[f"centers_{frame}"] = evaluated(thing, "gaussian_center")
    frames[f"normals_{frame}"] = evaluated(thing, "shading_normal")
bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "saved.blend"))
bpy.ops.wm.open_mainfile(filepath=str(FOLDER / "saved.blend"))
scene, thing = bpy.context.scene, bpy.data.objects["take"]
scene.frame_set(1)
frames["after_loading"] = evaluated(thing, "gaussian_center")
Path(JOB["take"]).rename(FOLDER / "gone")
scene.frame_set(2)
frames["held"] = evaluated(thing, "gaussian_center")
facts["problem"] = thing.relightable.problem

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module="bl_ext.user_default.beam_relightable")
bpy.ops.import_scene.relightable(filepath=JOB["disc"])
rendered(FOLDER / "disc.exr", JOB["size"], JOB["samples"])
np.savez(FOLDER / "frames.npz", **frames)
(FOLDER / "facts.json").write_text(json.dumps(facts))
