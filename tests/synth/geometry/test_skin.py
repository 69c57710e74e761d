"""The outer surface of every kind of cell."""

import numpy as np
import pytest
import trimesh

from synth.arrays import Floats, Ints
from synth.geometry.skin import CELLS, FLAT, skin

HEXAHEDRON = np.array(
    [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float
)
CORNERS = {
    "hexahedron": HEXAHEDRON,
    "wedge": HEXAHEDRON[[0, 3, 1, 4, 7, 5]],
    "pyramid": np.concatenate([HEXAHEDRON[:4], [[0.5, 0.5, 1.0]]]),
    "tetrahedron": HEXAHEDRON[[0, 1, 3, 4]],
}
VOLUME = {"hexahedron": 1.0, "wedge": 0.5, "pyramid": 1 / 3, "tetrahedron": 1 / 6}
VOLUMES = [kind for kind in CELLS if kind not in FLAT]


def cell(kind: int) -> tuple[Floats, Ints]:
    name, size, _, edges = CELLS[kind]
    corners = CORNERS[name.removeprefix("quadratic ")]
    middle = [corners[list(edge)].mean(axis=0) for edge in edges]
    points = np.array([*corners, *middle])
    assert len(points) == size
    return points, np.arange(size)[None]


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("kind", VOLUMES)
def test_of_one_cell_is_closed_and_turned_outwards(kind: int, mirrored: bool) -> None:
    points, nodes = cell(kind)
    points = points * [1, 1, -1] if mirrored else points
    surface = trimesh.Trimesh(points, skin(points, {kind: nodes}), process=False)
    assert surface.is_watertight
    assert surface.volume == pytest.approx(VOLUME[CELLS[kind][0].removeprefix("quadratic ")])
    assert set(surface.faces.ravel()) == set(range(len(points)))


def test_faces_between_cells_are_inside() -> None:
    points = np.array([[x, y, z] for z in range(4) for y in range(4) for x in range(4)], float)
    first = np.array([x + 4 * y + 16 * z for z in range(3) for y in range(3) for x in range(3)])
    nodes = first[:, None] + np.array([0, 1, 5, 4, 16, 17, 21, 20])
    faces = skin(points, {12: nodes, 3: nodes[:, :2]})
    assert len(faces) == 2 * 6 * 9
    assert trimesh.Trimesh(points, faces, process=False).volume == pytest.approx(27)


@pytest.mark.parametrize(
    "cells", [{}, {3: np.array([[0, 1]])}, {10: np.array([[0, 1, 2, 9]])}, {42: np.array([[0, 1]])}]
)
def test_what_has_no_surface_is_refused(cells: dict[int, Ints]) -> None:
    with pytest.raises(ValueError, match=r"surface|point|42"):
        skin(HEXAHEDRON, cells)
