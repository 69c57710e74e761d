"""Triangle meshes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


class Shape(NamedTuple):
    """A triangle mesh, world axes."""

    vertices: Floats
    """(V, 3) mm."""
    faces: npt.NDArray[np.int32]
    """(F, 3)."""


def normals(shape: Shape) -> Floats:
    """Unit normals (V, 3) of vertices, faces weighted by area; z where faces have none.

    Summed in the faces' own order: the renderer's own sum over threads would not be the same twice.
    """
    corners = shape.vertices[shape.faces]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros_like(shape.vertices)
    for axis in range(3):
        for corner in range(3):
            total[:, axis] += np.bincount(
                shape.faces[:, corner], face[:, axis], minlength=len(shape.vertices)
            )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    flat = length[:, 0] < 1e-12
    total[flat] = [0.0, 0.0, 1.0]
    length[flat] = 1.0
    return np.asarray(total / length)
