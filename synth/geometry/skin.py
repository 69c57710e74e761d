"""The outer surface of a mesh of cells, as triangles.

Types of cells, and the order of their nodes, are those of VTK (The VTK User's Guide, file formats).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from synth.arrays import Floats, Ints

TRIANGLE = 5
IGNORED = (0, 1, 2, 3, 4, 21)  # types without a face: empty cells, vertices and lines
_FLAT = (TRIANGLE, 9, 22, 23)  # types that are faces themselves, not volumes


class _Cell(NamedTuple):
    nodes: int
    faces: tuple[tuple[int, ...], ...]  # their corners
    edges: tuple[tuple[int, int], ...] = ()  # ends of the edges that have a node in the middle


_TRI, _QUAD = ((0, 1, 2),), ((0, 1, 2, 3),)
_TET = ((0, 1, 3), (1, 2, 3), (2, 0, 3), (0, 2, 1))
_PYRAMID = ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4))
_WEDGE = ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0))
_HEX = ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7))
_RING3, _RING4 = ((0, 1), (1, 2), (2, 0)), ((0, 1), (1, 2), (2, 3), (3, 0))
_WEDGE_EDGES = (*_RING3, (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5))
_HEX_EDGES = (*_RING4, (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7))

CELLS: Mapping[int, _Cell] = {
    TRIANGLE: _Cell(3, _TRI),
    9: _Cell(4, _QUAD),
    10: _Cell(4, _TET),
    12: _Cell(8, _HEX),
    13: _Cell(6, _WEDGE),
    14: _Cell(5, _PYRAMID),
    22: _Cell(6, _TRI, _RING3),
    23: _Cell(8, _QUAD, _RING4),
    24: _Cell(10, _TET, (*_RING3, (0, 3), (1, 3), (2, 3))),
    25: _Cell(20, _HEX, _HEX_EDGES),
    26: _Cell(15, _WEDGE, _WEDGE_EDGES),
    27: _Cell(13, _PYRAMID, (*_RING4, (0, 4), (1, 4), (2, 4), (3, 4))),
}
"""By VTK's number of the type; from 22 on the quadratic ones."""


def skin(points: Floats, cells: Mapping[int, Ints]) -> Ints:
    """Triangles (F, 3) of the outer surface, counter-clockwise from outside where the cells are volumes.

    `points`: (N, 3) at rest; `cells`: nodes (C, n) by VTK's number of the type. Faces of two cells are
    inside. Cells that are faces themselves are used only where there are no volumes, as they are. ValueError:
    a type without a table here or with other nodes, none with a face, a node that is not among the points.
    """
    face_cells = {kind: nodes for kind, nodes in cells.items() if len(nodes) and kind not in IGNORED}
    if unsupported := sorted(set(face_cells) - set(CELLS)):
        raise ValueError(f"cells of VTK's type {unsupported[0]} are not supported")
    if not face_cells:
        lines = "; it has lines or points only" if any(map(len, cells.values())) else ""
        raise ValueError(f"it has no cells with a surface{lines}")
    for kind, nodes in face_cells.items():
        if nodes.shape[1:] != (CELLS[kind].nodes,):
            raise ValueError(f"cells of VTK's type {kind} have {CELLS[kind].nodes} nodes each")
        if nodes.min() < 0 or nodes.max() >= len(points):
            raise ValueError("a cell refers to a missing point")
    volumes = {kind: nodes for kind, nodes in face_cells.items() if kind not in _FLAT}
    key, parts = list[Ints](), list[Ints]()
    for kind, nodes in (volumes or face_cells).items():
        centre = points[nodes].mean(axis=1)
        for corners in CELLS[kind].faces:
            face = _triangles(kind, corners, nodes)  # (C, k, 3)
            if volumes:
                outer = points[face].mean(axis=(1, 2)) - centre
                a, b, c = (points[nodes[:, corner]] for corner in corners[:3])
                inwards = (np.cross(b - a, c - a) * outer).sum(axis=1) < 0
                face = np.where(inwards[:, None, None], face[..., ::-1], face)
            key.append(np.sort(nodes[:, corners], axis=1)[:, -3:])  # three corners tell it from the others
            parts.append(np.pad(face, ((0, 0), (0, 6 - face.shape[1]), (0, 0)), constant_values=-1))
    faces = np.concatenate(parts)
    if volumes:
        _, first, count = np.unique(np.concatenate(key), axis=0, return_index=True, return_counts=True)
        faces = faces[np.sort(first[count == 1])]
    flat = faces.reshape(-1, 3)
    return flat[flat[:, 0] >= 0]


def _triangles(kind: int, corners: tuple[int, ...], nodes: Ints) -> Ints:
    """Triangles (C, k, 3) of one face of cells with nodes (C, n), through its middle nodes if it has some."""
    n, edges = len(corners), CELLS[kind].edges
    if not edges:
        return nodes[:, [[corners[0], corners[k], corners[k + 1]] for k in range(1, n - 1)]]
    first = max(map(max, edges)) + 1  # middle nodes follow the corners
    place = {frozenset(edge): first + k for k, edge in enumerate(edges)}
    middle = [place[frozenset((corners[k], corners[(k + 1) % n]))] for k in range(n)]
    outer = [(corners[k], middle[k], middle[k - 1]) for k in range(n)]
    return nodes[:, outer + [(middle[0], middle[k], middle[k + 1]) for k in range(1, n - 1)]]
