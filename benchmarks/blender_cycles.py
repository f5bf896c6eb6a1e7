"""What `blender.py` runs in Blender: ``python blender_cycles.py JOB.json``, Cycles on the CPU, an EXR for each case.

The add-on is installed from its zip and imports the asset; light and camera are set here as a user would set them.
"""

import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix


def light(world, path, rotation):
    """Light a world by a lat-long map, turned about z as `beam render --rotate-environment` turns it [degree]."""
    world.use_nodes = True
    tree = world.node_tree
    place, turn = tree.nodes.new("ShaderNodeTexCoord"), tree.nodes.new("ShaderNodeMapping")
    turn.vector_type = "TEXTURE"
    turn.inputs["Rotation"].default_value = (0.0, 0.0, math.radians(rotation))
    image = tree.nodes.new("ShaderNodeTexEnvironment")
    image.image, image.interpolation = bpy.data.images.load(path), "Closest"
    tree.links.new(place.outputs["Generated"], turn.inputs[0])
    tree.links.new(turn.outputs[0], image.inputs[0])
    tree.links.new(image.outputs[0], tree.nodes["Background"].inputs[0])


def look(scene, camera):
    """Set the pinhole camera whose axes are right, down and forward; its centre is that of the picture."""
    data = bpy.data.cameras.new("camera")
    thing = bpy.data.objects.new("camera", data)
    thing.matrix_world = Matrix(camera["camera_to_world"]) @ Matrix.Diagonal((1.0, -1.0, -1.0, 1.0))
    data.sensor_fit, data.sensor_width, data.clip_start = "HORIZONTAL", 36.0, 1e-3
    data.lens = 36.0 * camera["focal"] / camera["width"]
    scene.collection.objects.link(thing)
    scene.camera = thing
    scene.render.resolution_x, scene.render.resolution_y = camera["width"], camera["height"]


def cycles(scene, samples, bounces):
    """Ask for what the path tracer computes: nothing clamped or denoised, the pixel's square as its filter."""
    scene.render.engine, scene.render.film_transparent = "CYCLES", True
    settings = scene.cycles
    settings.samples, settings.use_adaptive_sampling, settings.use_denoising = samples, False, False
    settings.max_bounces = settings.diffuse_bounces = settings.glossy_bounces = bounces
    settings.sample_clamp_direct = settings.sample_clamp_indirect = settings.blur_glossy = 0.0
    settings.pixel_filter_type = "BOX"
    file = scene.render.image_settings
    file.file_format, file.color_depth, file.color_mode = "OPEN_EXR", "32", "RGBA"


def draw(case):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.preferences.addon_enable(module="bl_ext.user_default.beam_relightable")
    scene = bpy.context.scene
    bpy.ops.import_scene.relightable(filepath=case["asset"])
    scene.world = bpy.data.worlds.new("light")
    light(scene.world, case["environment"], case["rotation"])
    look(scene, case["camera"])
    cycles(scene, case["samples"], case["bounces"])
    scene.render.filepath = case["out"]
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    job = json.loads(Path(sys.argv[1]).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.extensions.package_install_files(filepath=job["addon"], repo="user_default", enable_on_install=True)
    for each in job["cases"]:
        draw(each)
    print(json.dumps({"blender": bpy.app.version_string}))
