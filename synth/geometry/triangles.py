"""Triangle meshes."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from synth.arrays import Array, Floats, Indices
from synth.system.jit import argument_types, as_constant, compiled


class Shape(NamedTuple):
    """A triangle mesh, world axes."""

    vertices: Floats  # (V, 3) mm
    faces: Indices  # (F, 3)


def join_shapes(*shapes: Shape) -> Shape:
    """One mesh of several, in their order."""
    first = np.cumsum([0] + [len(shape.vertices) for shape in shapes])
    faces = [shape.faces + offset for shape, offset in zip(shapes, first, strict=False)]
    vertices = np.concatenate([shape.vertices for shape in shapes])
    return Shape(vertices, np.concatenate(faces).astype(np.int32))


def grid_faces(rows: int, columns: int, closed: Literal["", "rows", "columns"] = "") -> Indices:
    """Faces of a grid of vertices, row by row: both halves of its cells, (2, cells, 3).

    `closed`: the last row or column is joined to the first.
    """
    cells = np.arange(rows - (closed != "rows")), np.arange(columns - (closed != "columns"))
    row, column = (index.ravel() for index in np.meshgrid(*cells, indexing="ij"))
    below, right = (row + 1) % rows * columns, (column + 1) % columns
    a, b, c, d = row * columns + column, row * columns + right, below + column, below + right
    return np.stack([np.stack([a, b, d], 1), np.stack([a, d, c], 1)]).astype(np.int32)


def side_areas(point: Floats, vertices: Floats, faces: Array) -> Floats:
    """Doubled signed areas (F, 3) in x and y between a point (2,) and the sides of faces (F, 3), each in the
    column of the corner opposite its side."""
    a, b, c = (vertices[faces[:, i], :2] - point for i in range(3))
    return np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((b, c), (c, a), (a, b))], axis=1)


def lengths(vectors: Array) -> Array:
    """Length (...) of short vectors (..., C): bit-identical to `norm`, but ten times as fast."""
    total = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        total += vectors[..., k] * vectors[..., k]
    return np.asarray(np.sqrt(total, out=total))


def normals(shape: Shape) -> Floats:
    """Unit normals (V, 3) of vertices, faces weighted by area; the z axis if the area is 0.

    Summed in the order of the faces: the renderer's own sum over threads is not reproducible.
    """
    vertices = np.ascontiguousarray(shape.vertices, np.float64)
    total = _weigh_by_area(as_constant(vertices), as_constant(shape.faces))
    length = lengths(total)[:, None]
    flat = length[:, 0] < 1e-12
    total[flat] = [0.0, 0.0, 1.0]
    length[flat] = 1.0
    return np.asarray(total / length)


@argument_types("Array(f8, 2, 'C', readonly=True), Array(i4, 2, 'C', readonly=True)")
@compiled
def _weigh_by_area(vertices: Floats, faces: Indices) -> Floats:
    total = np.zeros(vertices.shape)
    # One corner after the other, to round like a sum over all first corners, all second and all third.
    for corner in range(3):
        for f in range(len(faces)):
            a, b, c = faces[f]
            x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            d0, d1, d2 = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
            e0, e1, e2 = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
            vertex = faces[f, corner]
            total[vertex, 0] += d1 * e2 - d2 * e1
            total[vertex, 1] += d2 * e0 - d0 * e2
            total[vertex, 2] += d0 * e1 - d1 * e0
    return total
