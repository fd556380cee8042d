"""Blender's view of a GLB under an environment, by Cycles on the CPU. Run by a Python that has `bpy`:

    python blender_render.py GLB ENVIRONMENT.exr CAMERA.json OUT.exr SAMPLES

CAMERA.json has ``to_world`` [4, 4] (x right, y down, z forward, in the glTF's world), ``fov_x`` in radians and ``size``.
"""

import json
import math
import sys
from pathlib import Path

import bpy
import mathutils

glb, light, camera, out, samples = sys.argv[1:]
view = json.loads(Path(camera).read_text())
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=glb)
scene = bpy.context.scene

world = bpy.data.worlds.new("light")
scene.world, world.use_nodes = world, True
nodes, links = world.node_tree.nodes, world.node_tree.links
texture, mapping, place = (nodes.new(f"ShaderNode{name}") for name in ("TexEnvironment", "Mapping", "TexCoord"))
texture.image = bpy.data.images.load(light)
mapping.inputs["Rotation"].default_value[2] = math.pi / 2  # where the map starts is a quarter turn from where Blender does
links.new(place.outputs["Generated"], mapping.inputs["Vector"])
links.new(mapping.outputs["Vector"], texture.inputs["Vector"])
links.new(texture.outputs["Color"], nodes["Background"].inputs["Color"])

to_blender = mathutils.Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))
flip = mathutils.Matrix.Diagonal((1, -1, -1, 1))
lens = bpy.data.cameras.new("camera")
lens.sensor_fit, lens.angle = "HORIZONTAL", view["fov_x"]
scene.camera = bpy.data.objects.new("camera", lens)
scene.collection.objects.link(scene.camera)
scene.camera.matrix_world = to_blender @ mathutils.Matrix(view["to_world"]) @ flip

scene.render.engine = "CYCLES"
scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", int(samples), False
scene.cycles.use_adaptive_sampling = False
scene.cycles.pixel_filter_type, scene.cycles.filter_width = "GAUSSIAN", 2.0  # a quarter of it is its standard deviation
scene.cycles.max_bounces = scene.cycles.diffuse_bounces = scene.cycles.glossy_bounces = 5
scene.cycles.sample_clamp_indirect = 0
scene.render.resolution_x, scene.render.resolution_y = view["size"]
scene.view_settings.view_transform = "Raw"
settings = scene.render.image_settings
settings.file_format, settings.color_depth, settings.color_mode = "OPEN_EXR", "32", "RGB"
scene.render.filepath = out
bpy.ops.render.render(write_still=True)
