"""Mechanics by felupe and images by Blender's Cycles, for `evidence.foreign.recordings`.

    foreign_worker.py mechanics FOLDER   in a Python that has felupe and pypardiso
    foreign_worker.py pictures FOLDER    in a Python that has bpy

It imports nothing of this project. `mechanics` reads `mechanics.json` and writes `mechanics.npz`: positions
of the surface's nodes, and their displacement under every contact at rising shares of its force and at the
peak of the pulse. `pictures` reads `pictures.npz` and `pictures.json` and writes `NNNNN.png` and
`right-NNNNN.png`, 8 bits sRGB.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

if "mechanics" in sys.argv:
    import felupe as fem  # type: ignore[import-not-found]
    from pypardiso import spsolve  # type: ignore[import-not-found]
else:
    import bpy  # type: ignore[import-not-found]
    import mathutils  # type: ignore[import-not-found]

_GROWTH = 2.5  # factor by which elements at the block's centre and top are finer


def mechanics(folder: Path) -> None:
    """Solves one specimen."""
    specimen = json.loads((folder / "mechanics.json").read_text("utf-8"))
    width_mm, depth_mm = specimen["block_mm"]
    x, z = _lines(width_mm, depth_mm, *specimen["elements"])
    mesh = fem.mesh.Grid(x, x, z).convert(order=2, calc_points=True, calc_midfaces=True, calc_midvolumes=True)
    field = fem.FieldContainer([fem.Field(fem.RegionTriQuadraticHexahedron(mesh), dim=3)])
    young, poisson = specimen["young_kpa"], specimen["poisson"]
    law = fem.NeoHookeCompressible(
        mu=young / (2 * (1 + poisson)), lmbda=young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    )
    items: list[Any] = [fem.SolidBody(law, field)]
    top = np.flatnonzero(np.isclose(mesh.points[:, 2], 0.0))
    top = top[np.lexsort(np.round(mesh.points[top, :2], 6).T)]  # row by row
    if specimen["membrane_mn_per_mm"]:
        items.append(_membrane(mesh, field, top, specimen["membrane_mn_per_mm"]))
    dof = _partition_dof(field, width_mm, depth_mm)
    displacements = [
        _press(mesh, field, items, top, dof, contact, specimen["levels"]) for contact in specimen["contacts"]
    ]
    pulse = _lift_ground(mesh, field, items, top, dof, specimen["pulse_mm"], width_mm, depth_mm)
    np.savez(folder / "mechanics.npz", at=mesh.points[top, :2], moved=np.array(displacements), pulse=pulse)


def _lines(width_mm: float, depth_mm: float, across: int, down: int) -> tuple[Any, Any]:
    """Coordinates x and z of element borders: finer at the centre and at the top, z = 0."""
    edge, depth = np.linspace(-1, 1, across + 1), np.linspace(0, 1, down + 1)
    x = width_mm / 2 * np.sign(edge) * (np.abs(edge) + (_GROWTH - 1) * np.abs(edge) ** 3) / _GROWTH
    z = -depth_mm * (depth + (_GROWTH - 1) * depth**3) / _GROWTH
    return x, z[::-1]


def _partition_dof(field: Any, width_mm: float, depth_mm: float) -> tuple[Any, Any]:
    """Degrees of freedom of the fixed sides and ground, and the free ones."""
    walls = {"fx": (-width_mm / 2, width_mm / 2), "fy": (-width_mm / 2, width_mm / 2), "fz": (-depth_mm,)}
    bounds = {
        f"{axis} {position}": fem.Boundary(field[0], **{axis: position})
        for axis, ends in walls.items()
        for position in ends
    }
    fixed, free = fem.dof.partition(field, bounds)
    return fixed, free


def _membrane(mesh: Any, field: Any, top: Any, stiffness: float) -> Any:
    """A net of trusses over the surface's nodes; a truss has the stiffness of a strip of the membrane."""
    side = round(len(top) ** 0.5)
    net = top.reshape(side, side)
    gap = np.diff(mesh.points[net[0], 0])
    widths = np.concatenate([gap[:1] / 2, (gap[1:] + gap[:-1]) / 2, gap[-1:] / 2])
    rows = np.stack([net[:, :-1], net[:, 1:]], axis=-1)
    columns = np.stack([net[:-1], net[1:]], axis=-1)
    area = np.concatenate([np.repeat(widths, side - 1), np.broadcast_to(widths, (side - 1, side)).ravel()])
    cells = np.concatenate([rows.reshape(-1, 2), columns.reshape(-1, 2)])
    lines = fem.Mesh(mesh.points, cells, "line")
    strung = fem.FieldContainer([fem.Field(fem.RegionTruss(lines), dim=3)])
    strung[0].values = field[0].values  # the net moves with the block
    return fem.TrussBody(fem.LinearElastic1D(E=stiffness), strung, area=area)


def _press(mesh: Any, field: Any, items: list[Any], top: Any, dof: Any, contact: Any, levels: int) -> Any:
    """Displacement (levels, nodes, 3) mm at equal steps of the tools' force, each by Hertz's pressure."""
    field[0].values[:] = 0
    points = mesh.points[top, :2]
    force: Any = 0.0
    line = _simpson(points[: round(len(top) ** 0.5), 0])
    for tool in contact:
        distance = np.linalg.norm(points - tool["at_mm"], axis=1) / tool["radius_mm"]
        share = np.outer(line, line).ravel() * np.sqrt(np.clip(1 - distance**2, 0, None))
        force = force + np.outer(share / share.sum(), tool["force_mn"])
    out = []
    for level in np.linspace(0, 1, levels + 1)[1:]:
        load = fem.PointLoad(field, top, values=level * force)
        _solve([*items, load], dof, np.zeros(len(dof[0])))
        out.append(field[0].values[top].copy())
    return out


def _simpson(x: Any) -> Any:
    """Simpson's weights over a line of nodes, two at the ends of an element and one at its centre."""
    weight = np.zeros(len(x))
    for start in range(0, len(x) - 2, 2):
        weight[start : start + 3] += (x[start + 2] - x[start]) / 6 * np.array([1, 4, 1])
    return weight


def _lift_ground(
    mesh: Any,
    field: Any,
    items: list[Any],
    top: Any,
    dof: Any,
    lift_mm: float,
    width_mm: float,
    depth_mm: float,
) -> Any:
    """Displacement (nodes, 3) mm when the ground's centre is lifted until the surface rises by `lift_mm`."""
    if not lift_mm:
        return np.zeros((len(top), 3))
    field[0].values[:] = 0
    ground = np.isclose(mesh.points[:, 2], -depth_mm)
    distance = np.linalg.norm(mesh.points[:, :2], axis=1) / (width_mm / 2)
    fixed = np.zeros_like(mesh.points)
    fixed[:, 2] = np.where(
        ground & (distance < 1), lift_mm * np.cos(np.pi / 2 * np.clip(distance, 0, 1)) ** 2, 0.0
    )
    _solve(items, dof, fixed.ravel()[dof[0]])
    displacement = field[0].values[top].copy()
    return displacement * lift_mm / max(float(displacement[:, 2].max()), 1e-9)


def _solve(items: list[Any], dof: tuple[Any, Any], fixed: Any) -> None:
    """Newton's method with displacement `fixed` at the held degrees of freedom."""
    fem.newtonraphson(items=items, dof0=dof[0], dof1=dof[1], ext0=fixed, solver=spsolve, verbose=0)


def pictures(folder: Path) -> None:
    """Renders one video."""
    arrays = np.load(folder / "pictures.npz")
    settings = json.loads((folder / "pictures.json").read_text("utf-8"))
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    tissue = _sheet(arrays["rest"])
    tissue.data.materials.append(_wet(arrays["albedo"], arrays["bumps"]))
    tools = [(_rod(settings["tool_mm"]), mathutils.Vector(shaft.tolist())) for shaft in arrays["shafts"]]
    for k, position in enumerate(settings["lamps_mm"]):
        light = bpy.data.lights.new(f"lamp{k}", "AREA")
        light.shape, light.size, light.energy = "DISK", 25.0, settings["watts"]
        lamp = _link(f"lamp{k}", light)
        lamp.location = position
        lamp.rotation_euler = (-mathutils.Vector(position)).to_track_quat("-Z", "Y").to_euler()
    cameras = {}
    for name, matrix in settings["cameras"].items():
        lens = bpy.data.cameras.new(f"lens{name}")
        lens.sensor_width, lens.lens = 36.0, 36.0 * settings["focal_px"] / settings["size"][0]
        lens.clip_start, lens.clip_end = 1.0, 2000.0
        cameras[name] = _link(f"lens{name}", lens)
        cameras[name].matrix_world = mathutils.Matrix(matrix)
    _apply_settings(scene, settings)
    for k, displacement in enumerate(arrays["moved"]):
        tissue.data.vertices.foreach_set("co", (arrays["rest"] + displacement).astype(np.float32).ravel())
        tissue.data.update()
        for (tool, shaft), tip in zip(tools, arrays["tips"][k], strict=True):
            tool.location, tool.rotation_euler = tip.tolist(), shaft.to_track_quat("Z", "Y").to_euler()
        for number, (name, camera) in enumerate(cameras.items()):
            scene.camera = camera
            scene.cycles.seed = 2 * k + number  # noise common to both cameras would be matched
            scene.render.filepath = str(folder / f"{name}{k:05d}.png")
            bpy.ops.render.render(write_still=True)


def _link(name: str, data: Any) -> Any:
    """A new object, linked to the scene."""
    linked = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(linked)
    return linked


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
    return _link("tissue", mesh)


def _wet(albedo: Any, bumps: Any) -> Any:
    material = bpy.data.materials.new("wet")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    coat = nodes["Principled BSDF"]
    coat.inputs["Roughness"].default_value, coat.inputs["IOR"].default_value = 0.3, 1.36
    links.new(_image(nodes, "albedo", albedo).outputs["Color"], coat.inputs["Base Color"])
    bump = nodes.new("ShaderNodeBump")
    bump.inputs["Distance"].default_value = 0.15  # mm
    height = _image(nodes, "bumps", np.repeat(bumps[..., None], 3, -1))
    links.new(height.outputs["Color"], bump.inputs["Height"])
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
    middle = (0, 0, 40 + radius_mm)
    bpy.ops.mesh.primitive_cylinder_add(radius=radius_mm, depth=80.0, location=middle, vertices=48)
    shaft = bpy.context.object
    bpy.ops.mesh.primitive_uv_sphere_add(radius=radius_mm, location=(0, 0, radius_mm))
    steel = bpy.data.materials.new("steel")
    steel.use_nodes = True
    coat = steel.node_tree.nodes["Principled BSDF"]
    coat.inputs["Base Color"].default_value = (0.6, 0.6, 0.62, 1.0)
    coat.inputs["Metallic"].default_value, coat.inputs["Roughness"].default_value = 1.0, 0.35
    tool = _link("tool", None)
    for part in (shaft, bpy.context.object):
        part.data.materials.append(steel)
        part.parent = tool
    return tool


def _apply_settings(scene: Any, settings: dict[str, Any]) -> None:
    scene.world = bpy.data.worlds.new("surroundings")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs[1].default_value = 0.05
    scene.render.engine = "CYCLES"
    scene.render.resolution_x, scene.render.resolution_y = settings["size"]
    scene.render.resolution_percentage = 100
    scene.render.image_settings.file_format = "PNG"
    scene.view_settings.view_transform = "Standard"
    scene.render.use_persistent_data = True
    scene.render.threads_mode, scene.render.threads = "FIXED", settings["threads"]
    scene.cycles.samples, scene.cycles.use_denoising = settings["spp"], False
    scene.cycles.max_bounces, scene.cycles.use_adaptive_sampling = 2, False


if __name__ == "__main__":
    {"mechanics": mechanics, "pictures": pictures}[sys.argv[1]](Path(sys.argv[2]))
