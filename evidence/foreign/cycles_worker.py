"""Renders a moving surface with Cycles. Run by `bench experiment foreign` in a Python that has bpy.

It imports nothing of ours. Reads `pictures.npz` and `pictures.json`; writes `NNNNN.png` of the first camera
and `right-NNNNN.png` of a second one, 8 bits sRGB.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy  # type: ignore[import-not-found]
import mathutils  # type: ignore[import-not-found]
import numpy as np


def main(folder: Path) -> None:
    """One film."""
    given = np.load(folder / "pictures.npz")
    told = json.loads((folder / "pictures.json").read_text("utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    tissue = _sheet(given["rest"])
    tissue.data.materials.append(_wet(given["albedo"], given["bumps"]))
    tool = _rod(told["tool_mm"])
    for k, at in enumerate(told["lamps_mm"]):
        _lamp(k, at, told)
    cameras = {name: _camera(name, told, matrix) for name, matrix in told["cameras"].items()}
    _settings(told)
    for k, moved in enumerate(given["moved"]):
        tissue.data.vertices.foreach_set("co", (given["rest"] + moved).astype(np.float32).ravel())
        tissue.data.update()
        _place(tool, given["tip"][k], given["shaft"][k])
        for eye, (name, camera) in enumerate(cameras.items()):
            bpy.context.scene.camera = camera
            bpy.context.scene.cycles.seed = 2 * k + eye  # noise that eyes shared would be followed
            bpy.context.scene.render.filepath = str(folder / f"{name}{k:05d}.png")
            bpy.ops.render.render(write_still=True)


def _sheet(rest: Any) -> Any:
    """A square grid of vertices (N, N, 3) as a smooth mesh, its map from 0 to 1 along both edges."""
    side = rest.shape[0]
    number = np.arange(side * side).reshape(side, side)
    faces = np.stack([number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]], -1).reshape(-1, 4)
    mesh = bpy.data.meshes.new("tissue")
    mesh.from_pydata(rest.reshape(-1, 3).tolist(), [], faces.tolist())
    row, column = np.divmod(faces, side)
    uv = np.stack([column, row], axis=-1) / (side - 1)
    mesh.uv_layers.new(name="map").data.foreach_set("uv", uv.astype(np.float32).ravel())
    mesh.polygons.foreach_set("use_smooth", np.ones(len(faces), bool))
    sheet = bpy.data.objects.new("tissue", mesh)
    bpy.context.scene.collection.objects.link(sheet)
    return sheet


def _wet(albedo: Any, bumps: Any) -> Any:
    material = bpy.data.materials.new("wet")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    coat = nodes["Principled BSDF"]
    coat.inputs["Roughness"].default_value, coat.inputs["IOR"].default_value = 0.3, 1.36
    links.new(_image(nodes, "albedo", albedo).outputs["Color"], coat.inputs["Base Color"])
    bump = nodes.new("ShaderNodeBump")
    bump.inputs["Distance"].default_value = 0.15  # mm
    links.new(
        _image(nodes, "bumps", np.repeat(bumps[..., None], 3, -1)).outputs["Color"], bump.inputs["Height"]
    )
    links.new(bump.outputs["Normal"], coat.inputs["Normal"])
    return material


def _image(nodes: Any, name: str, texels: Any) -> Any:
    image = bpy.data.images.new(name, texels.shape[1], texels.shape[0], float_buffer=True)
    image.colorspace_settings.name = "Non-Color"
    image.pixels.foreach_set(np.dstack([texels, np.ones(texels.shape[:2])]).astype(np.float32).ravel())
    node = nodes.new("ShaderNodeTexImage")
    node.image = image
    return node


def _rod(radius_mm: float) -> Any:
    """A steel rod with a round end at its origin, along +z."""
    bpy.ops.mesh.primitive_cylinder_add(
        radius=radius_mm, depth=80.0, location=(0, 0, 40 + radius_mm), vertices=48
    )
    shaft = bpy.context.object
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius_mm, location=(0, 0, radius_mm))
    end = bpy.context.object
    steel = bpy.data.materials.new("steel")
    steel.use_nodes = True
    coat = steel.node_tree.nodes["Principled BSDF"]
    coat.inputs["Base Color"].default_value = (0.6, 0.6, 0.62, 1.0)
    coat.inputs["Metallic"].default_value, coat.inputs["Roughness"].default_value = 1.0, 0.35
    whole = bpy.data.objects.new("tool", None)
    bpy.context.scene.collection.objects.link(whole)
    for part in (shaft, end):
        part.data.materials.append(steel)
        part.parent = whole
    return whole


def _place(tool: Any, tip: Any, shaft: Any) -> None:
    tool.location = tip.tolist()
    tool.rotation_euler = mathutils.Vector(shaft.tolist()).to_track_quat("Z", "Y").to_euler()


def _lamp(k: int, at: list[float], told: dict[str, Any]) -> None:
    light = bpy.data.lights.new(f"lamp{k}", "AREA")
    light.shape, light.size, light.energy = "DISK", 25.0, told["watts"]
    lamp = bpy.data.objects.new(f"lamp{k}", light)
    lamp.location = at
    lamp.rotation_euler = (-mathutils.Vector(at)).to_track_quat("-Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(lamp)


def _camera(name: str, told: dict[str, Any], matrix: list[list[float]]) -> Any:
    lens = bpy.data.cameras.new(f"lens{name}")
    lens.sensor_width, lens.lens = 36.0, 36.0 * told["focal_px"] / told["size"][0]
    lens.clip_start, lens.clip_end = 1.0, 2000.0
    camera = bpy.data.objects.new(f"lens{name}", lens)
    camera.matrix_world = mathutils.Matrix(matrix)
    bpy.context.scene.collection.objects.link(camera)
    return camera


def _settings(told: dict[str, Any]) -> None:
    scene = bpy.context.scene
    scene.world = bpy.data.worlds.new("room")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0.05
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = told["size"]
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "Standard"
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", told["threads"]
    scene.cycles.samples, scene.cycles.use_denoising = told["spp"], False
    scene.cycles.max_bounces, scene.cycles.use_adaptive_sampling = 2, False


if __name__ == "__main__":
    main(Path(sys.argv[1]))
