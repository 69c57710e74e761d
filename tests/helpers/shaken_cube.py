"""A small mesh on which elements and laws are tested."""

import numpy as np
import scipy.sparse as sp
import skfem

from synth.fem.mesh import tetrahedra
from synth.fem.mesh.tetrahedra import Tets


def cube(n: int = 3) -> Tets:
    """A unit cube of tetrahedra whose inner corners are shaken, all its boundary fixed, no springs."""
    grid = skfem.MeshTet.init_tensor(*[np.linspace(0, 1, n + 1)] * 3)
    points, cells = grid.p.T.copy(), grid.t.T.astype(np.int64)
    inside = ((points > 0) & (points < 1)).all(axis=1)
    points[inside] += np.random.default_rng(1).uniform(-0.06, 0.06, (inside.sum(), 3))
    corner = points[cells]
    flipped = np.linalg.det(corner[:, 1:] - corner[:, :1]) < 0
    cells[flipped] = cells[flipped][:, [0, 2, 1, 3]]
    points, cells = tetrahedra.with_midsides(points, cells)
    edge = ((points < 1e-9) | (points > 1 - 1e-9)).any(axis=1)
    return Tets(points, cells, edge, sp.csr_array((len(points), len(points))))
