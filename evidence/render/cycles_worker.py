"""Renders an exported scene with Cycles. Run by `bench experiment cycles` in a Python that has bpy."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import bpy  # type: ignore[import-not-found]
import numpy as np


def main(folder: Path) -> None:
    """Reads `scene.npz` and `scene.json`; writes an array for each (spp, seed) and `times.json`."""
    scene = np.load(folder / "scene.npz")
    told = json.loads((folder / "scene.json").read_text("utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bodies = {name: _body(name, scene, told["bodies"][name]) for name in told["bodies"]}
    for index, lamp in enumerate(told["lamps"]):
        _lamp(index, lamp)
    _camera(scene["rotation"], scene["centre"], told)
    _settings(told)
    times: dict[str, list[float]] = {}
    for spp in told["spp"]:
        bpy.context.scene.cycles.samples = spp
        for seed in range(3):
            bpy.context.scene.cycles.seed = seed
            # A frame's own work: the surface moves, then it is rendered. The first of each is warm-up.
            start = time.process_time()
            mesh = bodies["cortex"].data
            mesh.vertices.foreach_set("co", scene["cortex_vertices"].astype(np.float32).ravel())
            mesh.update()
            bpy.context.scene.render.filepath = str(folder / f"cycles-{spp}-{seed}.exr")
            bpy.ops.render.render(write_still=True)
            times.setdefault(str(spp), []).append(time.process_time() - start)
            image = bpy.data.images.load(bpy.context.scene.render.filepath)
            texels = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)
            np.save(folder / f"cycles-{spp}-{seed}.npy", texels[::-1, :, :3])
    (folder / "times.json").write_text(json.dumps({"cpu_s": times, "version": bpy.app.version_string}))


def _body(name: str, scene: Any, told: dict[str, Any]) -> Any:
    vertices, faces, uv = (scene[f"{name}_{part}"] for part in ("vertices", "faces", "uv"))
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    layer = mesh.uv_layers.new(name="map")
    layer.data.foreach_set("uv", uv[faces].astype(np.float32).ravel())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    body = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(body)
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    coat = nodes["Principled BSDF"]
    coat.inputs["Roughness"].default_value = told["roughness"] ** 0.5  # Blender squares it
    if "albedo" in told:
        coat.inputs["IOR"].default_value = told["index"]
        links.new(_image(nodes, f"{name}_albedo", scene).outputs["Color"], coat.inputs["Base Color"])
        bent = nodes.new("ShaderNodeNormalMap")
        links.new(_image(nodes, f"{name}_normal", scene).outputs["Color"], bent.inputs["Color"])
        links.new(bent.outputs["Normal"], coat.inputs["Normal"])
    else:
        coat.inputs["Base Color"].default_value = (0.88, 0.88, 0.87, 1.0)
        coat.inputs["Metallic"].default_value = told["metallic"]
    mesh.materials.append(material)
    return body


def _image(nodes: Any, name: str, scene: Any) -> Any:
    texels = scene[name]
    image = bpy.data.images.new(name, texels.shape[1], texels.shape[0], float_buffer=True)
    image.colorspace_settings.name = "Non-Color"  # linear already
    image.pixels.foreach_set(np.dstack([texels, np.ones(texels.shape[:2])]).astype(np.float32).ravel())
    node = nodes.new("ShaderNodeTexImage")
    node.image = image
    return node


def _lamp(index: int, told: dict[str, Any]) -> None:
    import mathutils  # type: ignore[import-not-found]

    light = bpy.data.lights.new(f"lamp{index}", "SPOT")
    strength = max(told["intensity"])
    light.energy = strength * 4 * np.pi**2  # Blender's watt of a point, over solid angle and pi
    light.color = [value / strength for value in told["intensity"]]
    light.spot_size, light.shadow_soft_size = np.deg2rad(60.0), told["radius"]  # past the picture
    lamp = bpy.data.objects.new(f"lamp{index}", light)
    lamp.location = told["position"]
    towards = mathutils.Vector(told["target"]) - mathutils.Vector(told["position"])
    lamp.rotation_euler = towards.to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(lamp)


def _camera(rotation: Any, centre: Any, told: dict[str, Any]) -> None:
    import mathutils

    lens = bpy.data.cameras.new("lens")
    lens.sensor_width, lens.lens = 36.0, 36.0 * told["focal_px"] / told["size"][0]
    lens.clip_start, lens.clip_end = 1.0, 2000.0
    camera = bpy.data.objects.new("lens", lens)
    matrix = np.eye(4)
    matrix[:3, :3] = (rotation * np.array([[1.0], [-1.0], [-1.0]])).T
    matrix[:3, 3] = centre
    camera.matrix_world = mathutils.Matrix(matrix.tolist())
    bpy.context.scene.collection.objects.link(camera)
    bpy.context.scene.camera = camera


def _settings(told: dict[str, Any]) -> None:
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("dark")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0.0
    import addon_utils  # type: ignore[import-not-found]  # on the path once bpy is loaded

    addon_utils.enable("cycles")  # a fresh bpy starts without it
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = told["size"]
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", told["threads"]
    cycles = scene.cycles
    cycles.use_denoising, cycles.use_adaptive_sampling, cycles.use_light_tree = False, False, True
    cycles.max_bounces, cycles.pixel_filter_type = 0, "BOX"
    scene.render.filter_size = 1.0


if __name__ == "__main__":
    main(Path(sys.argv[1]))
