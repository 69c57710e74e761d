"""Surfaces in VTK's legacy format (.vtk): polygons of PolyData or an unstructured grid, text or binary.

Source: The VTK User's Guide, file formats; versions up to 5.1, whose cells are offsets and connectivity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Ints

_TYPES = {"float": ">f4", "double": ">f8", "int": ">i4", "long": ">i8", "vtktypeint64": ">i8"}
_TRIANGLE, _POLYGON, _QUAD = 5, 7, 9


def read_vtk(data: bytes) -> tuple[Floats, Ints]:
    """Vertices (V, 3) and triangles (F, 3) of a file's bytes; polygons are cut into fans.

    Raises ValueError if it is not a legacy VTK file of polygons, other exceptions if it is damaged.
    """
    file = _Reader(data)
    points, cells, kinds = np.zeros((0, 3)), None, None
    while (cells is None or kinds is None) and (words := file.words()):
        key = words[0].upper()
        if key == "DATASET" and words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise ValueError(f"it contains {words[1]}, not polygons")
        if key == "POINTS":
            points = file.numbers(3 * int(words[1]), words[2]).reshape(-1, 3).astype(np.float64)
        elif key in ("POLYGONS", "CELLS", "VERTICES", "LINES"):
            found = file.cells(int(words[1]), int(words[2]))
            if key in ("POLYGONS", "CELLS"):
                cells, kinds = found, np.full(len(found), _POLYGON) if key == "POLYGONS" else None
        elif key == "TRIANGLE_STRIPS":
            raise ValueError("it contains triangle strips; write triangles")
        elif key == "CELL_TYPES":
            kinds = file.numbers(int(words[1]), "int")
    if cells is None or kinds is None:
        raise ValueError("it contains no polygons")
    flat = [c for c, kind in zip(cells, kinds, strict=True) if kind in (_TRIANGLE, _POLYGON, _QUAD)]
    fans = [(cell[0], cell[k], cell[k + 1]) for cell in flat for k in range(1, len(cell) - 1)]
    faces = np.array(fans, np.int64).reshape(-1, 3)
    if len(faces) and not 0 <= faces.min() <= faces.max() < len(points):
        raise ValueError("a polygon refers to a missing point")
    return points, faces


class _Reader:
    """The bytes of a file and the current position."""

    def __init__(self, data: bytes) -> None:
        head = data.split(b"\n", 3)
        kind = head[2].strip().upper() if len(head) == 4 else b""  # head[1] is the title
        if not head[0].startswith(b"# vtk DataFile") or kind not in (b"ASCII", b"BINARY"):
            raise ValueError("not a legacy VTK file")
        self._data, self._at, self._binary = data, len(data) - len(head[3]), kind == b"BINARY"

    def words(self) -> list[str]:
        """Words of the next non-empty line; none at the end."""
        while self._at < len(self._data):
            end = self._data.find(b"\n", self._at)
            end = len(self._data) if end < 0 else end
            found = self._data[self._at : end].decode("latin-1").split()
            self._at = end + 1
            if found:
                return found
        return []

    def numbers(self, count: int, kind: str) -> NDArray[np.number]:
        """The next `count` numbers of a type."""
        if kind.lower() not in _TYPES:
            raise ValueError(f"unknown type {kind!r}")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self._binary:
            found = np.frombuffer(self._data, dtype, count, self._at)
            self._at += found.nbytes
            return found.astype(dtype.newbyteorder("="))
        words: list[str] = []
        while len(words) < count and (more := self.words()):
            words += more
        if len(words) != count:
            raise ValueError("it is truncated")
        return np.array(words).astype(dtype.newbyteorder("="))

    def cells(self, count: int, size: int) -> list[Ints]:
        """Point numbers of each cell."""
        start = self._at
        words = self.words()
        if words[:1] == ["OFFSETS"]:  # since 5.1: `count` offsets, then `size` point numbers
            offsets = self.numbers(count, words[1])
            return np.split(self.numbers(size, self.words()[1]).astype(np.int64), offsets[1:-1])
        self._at = start
        numbers, cells, at = self.numbers(size, "int").astype(np.int64), [], 0
        for _ in range(count):
            cells.append(numbers[at + 1 : at + 1 + int(numbers[at])])
            at += 1 + int(numbers[at])
        return cells
