"""A user's surface: how much of it the mesh keeps, and what the displacement in the opening is worth."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import trimesh
import typer
from numpy.typing import NDArray

from evidence.measuring import measuring
from synth.fem import surface_embedding, tool
from synth.fem.mesh import tetrahedra, winding
from synth.fem.mesh.element import bary_slope, quality
from synth.fem.system import assemble
from synth.geometry import brain_surface
from synth.job import schema

Floats = NDArray[np.float64]

_RADIUS_MM = 6.0
_WAYS = {"pull": (0.0, 0.0, 1.0), "aside": (0.87, 0.0, 0.5)}
_FINE_MM = 0.6  # spacing of the surface that is loaded: a coarser one would press on single points


@measuring("brain.obj --direction=-0.4,0.8,0.45", said="Folder for the data.", file="{file}.json")
def surface(
    file: Annotated[Path, typer.Argument(help="A brain's surface: OBJ, STL, PLY or VTK, in mm.")],
    direction: Annotated[
        str, typer.Option(help="Of the opening, outwards, in the file's axes.")
    ] = "-0.4,0.8,0.45",
    tets: Annotated[str, typer.Option(help="Tetrahedra of the meshes measured.")] = "1600,2500,4000",
    refined: Annotated[int, typer.Option(help="Tetrahedra of the reference.")] = 9000,
) -> dict[str, Any]:
    """Volume kept, element quality, time, and error in the opening against a finer mesh."""
    outwards = np.array([float(part) for part in direction.split(",")])
    return measure(file, outwards, [int(n) for n in tets.split(",")], refined)


def measure(file: Path, outwards: Floats, tets: list[int], refined: int) -> dict[str, Any]:
    """Rows by size; the opening is where the surface reaches farthest along `outwards`.

    Errors: relative root mean square of the displacement in the opening (12 mm), linear law, quadratic
    tetrahedra, contact of 6 mm radius, mean of pulling and dragging aside.
    """
    placed = brain_surface.load_brain(file, _opening(file, outwards))
    turns = winding.prepare(placed.vertices, placed.faces)
    low, high = placed.vertices.min(axis=0), placed.vertices.max(axis=0)
    at = np.random.default_rng(0).uniform(low, high, (100_000, 3))
    volume = float((turns(at) > 0.5).mean() * np.prod(high - low))
    anatomy = schema.Anatomy(mesh=file, craniotomy=_opening(file, outwards))
    vertices, faces = _loaded(placed)
    area = surface_embedding.vertex_area(vertices, faces)
    inside = np.hypot(*vertices[:, :2].T) < anatomy.craniotomy.radius_mm
    kernel = area * tool.footprint(np.zeros(2), _RADIUS_MM, vertices, area)

    def moved(count: int) -> tuple[dict[str, Any], list[Floats]]:
        start = time.process_time()
        whole = tetrahedra.from_brain(placed, anatomy, count, 2, ((0.0, 0.0, _RADIUS_MM),))
        spent = time.process_time() - start
        corner = whole.points[whole.cells[:, :4]]
        carry, system = (
            surface_embedding.embed(whole, vertices),
            assemble(whole, "linear", 0.4, averaged=True),
        )
        row = {
            "tets": len(whole.cells),
            "volume_kept": float(bary_slope(corner)[1].sum()) / volume,
            "quality": float(quality(corner).min()),
            "mesh_cpu_s": spent,
        }
        return row, [carry.move(system.solve(carry.gather(np.outer(kernel, way)))) for way in _WAYS.values()]

    reference, exact = moved(refined)
    rows = []
    for count in tets:
        row, got = moved(count)
        errors = [
            np.linalg.norm((u - e)[inside]) / np.linalg.norm(e[inside])
            for u, e in zip(got, exact, strict=True)
        ]
        rows.append(row | {"error": float(np.mean(errors))})
    return {
        "vertices": len(placed.vertices),
        "faces": len(placed.faces),
        "volume_mm3": volume,
        "reference": reference,
        "rows": rows,
    }


def _opening(file: Path, outwards: Floats) -> schema.Craniotomy:
    loose = trimesh.load(file, force="mesh", process=False)
    points = np.asarray(loose.vertices)
    top = points[((points - points.mean(axis=0)) @ outwards).argmax()]
    way = outwards / np.linalg.norm(outwards)
    return schema.Craniotomy.model_validate({"point": top.tolist(), "direction": way.tolist()})


def _loaded(placed: brain_surface.Brain) -> tuple[Floats, NDArray[np.int64]]:
    """The surface round the opening, cut finely."""
    near = (np.hypot(*placed.vertices[:, :2].T) < 26) & (placed.vertices[:, 2] > -25)
    kept = placed.faces[near[placed.faces].all(axis=1)]
    used, faces = np.unique(kept, return_inverse=True)
    vertices, faces = placed.vertices[used], faces.reshape(-1, 3)
    while np.median(np.linalg.norm(np.diff(vertices[faces], axis=1), axis=2)) > _FINE_MM:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    return np.asarray(vertices), np.asarray(faces)
