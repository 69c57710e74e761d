"""The default block of tissue and the dome over its opening, as a fine surface."""

import numpy as np

from synth.fem.mesh import tetrahedra
from synth.geometry.triangles import Shape
from synth.job import schema

ANATOMY = schema.AnatomySection()
OPENING_MM = ANATOMY.craniotomy.radius_mm


def patch(n: int = 61, extent: float = 46.0) -> Shape:
    """The dome over the opening as a fine surface."""
    x = np.linspace(-extent / 2, extent / 2, n)
    xy = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1).reshape(-1, 2)
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return Shape(np.column_stack([xy, tetrahedra.dome(xy, ANATOMY.dome_mm)]), faces.astype(np.int32))


def block(fem: schema.FemSection) -> tetrahedra.Tets:
    return tetrahedra.block(fem.tets)
