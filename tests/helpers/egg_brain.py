"""An egg for a brain: a surface as users have it, as .obj, .stl or .vtk."""

from pathlib import Path

import numpy as np
import trimesh

from synth.job import schema

OPENING = schema.CraniotomySection(point=(31.0, 0.0, 0.0), direction=(1.0, 0.0, 0.0))


def soup() -> np.ndarray:
    """An ellipsoid as users have it, (F, 3, 3): every face has its own vertices, some twice, some not."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.vertices *= (32.0, 26.0, 22.0)
    return np.asarray(ball.vertices[np.concatenate([ball.faces[20:], ball.faces[40:60]])])


def write_triangles(path: Path, corner: np.ndarray) -> Path:
    """Triangles (F, 3, 3) as a file of the format that its name says, vertices unmerged."""
    if path.suffix != ".vtk":
        trimesh.Trimesh(**trimesh.triangles.to_kwargs(corner), process=False).export(path)
        return path
    flat = [f"{x:.6f} {y:.6f} {z:.6f}" for x, y, z in corner.reshape(-1, 3)]
    rows = [f"3 {3 * k} {3 * k + 1} {3 * k + 2}" for k in range(len(corner))]
    lines = ["# vtk DataFile Version 3.0", "egg", "ASCII", "DATASET POLYDATA"]
    lines += [f"POINTS {len(flat)} float", *flat, f"POLYGONS {len(rows)} {4 * len(rows)}", *rows]
    path.write_text("\n".join(lines) + "\n")
    return path
