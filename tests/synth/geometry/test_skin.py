"""The outer surface of every kind of cell."""

import numpy as np
import pytest
import trimesh

from synth.arrays import Ints
from synth.geometry.skin import CELLS, skin

HEXAHEDRON = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)
SHAPES = {  # corners and volume
    (10, 24): (HEXAHEDRON[[0, 1, 3, 4]], 1 / 6),
    (12, 25): (HEXAHEDRON, 1.0),
    (13, 26): (HEXAHEDRON[[0, 3, 1, 4, 7, 5]], 0.5),
    (14, 27): (np.concatenate([HEXAHEDRON[:4], [[0.5, 0.5, 1.0]]]), 1 / 3),
}


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("kinds", SHAPES)
@pytest.mark.parametrize("quadratic", [0, 1])
def test_of_one_cell_is_closed_and_turned_outwards(
    kinds: tuple[int, int], quadratic: int, mirrored: bool
) -> None:
    corners, volume = SHAPES[kinds]
    cell = CELLS[kinds[quadratic]]
    points = np.array([*corners, *(corners[list(edge)].mean(axis=0) for edge in cell.edges)])
    assert len(points) == cell.nodes
    points = points * [1, 1, -1] if mirrored else points
    faces = skin(points, {kinds[quadratic]: np.arange(len(points))[None]})
    surface = trimesh.Trimesh(points, faces, process=False)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(volume)
    assert set(surface.faces.ravel()) == set(range(len(points)))


def test_faces_between_cells_are_inside() -> None:
    points = np.array([[x, y, z] for z in range(4) for y in range(4) for x in range(4)], float)
    corner_nodes = np.array([x + 4 * y + 16 * z for z in range(3) for y in range(3) for x in range(3)])
    nodes = corner_nodes[:, None] + np.array([0, 1, 5, 4, 16, 17, 21, 20])
    faces = skin(points, {12: nodes, 3: nodes[:, :2]})
    assert len(faces) == 2 * 6 * 9
    assert trimesh.Trimesh(points, faces, process=False).volume == pytest.approx(27)


@pytest.mark.parametrize(
    "cells", [{}, {3: np.array([[0, 1]])}, {10: np.array([[0, 1, 2, 9]])}, {42: np.array([[0, 1]])}]
)
def test_what_has_no_surface_is_refused(cells: dict[int, Ints]) -> None:
    with pytest.raises(ValueError, match=r"surface|point|42"):
        skin(HEXAHEDRON, cells)
