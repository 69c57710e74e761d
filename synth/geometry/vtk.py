"""Surfaces in VTK's legacy format (.vtk): polygons of PolyData or an unstructured grid, text or binary.

After the file format chapter of The VTK User's Guide; versions up to 5.1, whose cells are offsets and
connectivity.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_TYPES = {"float": ">f4", "double": ">f8", "int": ">i4", "long": ">i8", "vtktypeint64": ">i8"}
_TRIANGLE, _POLYGON, _QUAD = 5, 7, 9


def read_vtk(data: bytes) -> tuple[Floats, Ints]:
    """Vertices (V, 3) and triangles (F, 3) of a file's bytes; polygons are cut into fans.

    Raises:
        ValueError: no legacy VTK file of polygons.
    """
    return _Reader(data).surface()


class _Reader:
    """The file's bytes, and how far they have been read."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0
        if not self._line().startswith("# vtk DataFile"):
            raise ValueError("no legacy VTK file")
        self._line(empty=True)  # the title
        kind = self._line().strip().upper()
        if kind not in ("ASCII", "BINARY"):
            raise ValueError(f"{kind[:20]!r} is neither ASCII nor BINARY")
        self._binary = kind == "BINARY"

    def surface(self) -> tuple[Floats, Ints]:
        points, cells, kinds = np.zeros((0, 3)), None, None
        while self._at < len(self._data) and (cells is None or kinds is None):
            words = self._line().split()
            key = words[0].upper() if words else ""
            if key == "DATASET" and words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
                raise ValueError(f"it holds {words[1]}, no polygons")
            if key == "POINTS":
                points = self._numbers(3 * int(words[1]), words[2]).reshape(-1, 3).astype(np.float64)
            elif key in ("POLYGONS", "CELLS"):
                cells = self._cells(int(words[1]), int(words[2]))
                kinds = np.full(len(cells), _POLYGON) if key == "POLYGONS" else None
            elif key in ("VERTICES", "LINES"):
                self._cells(int(words[1]), int(words[2]))
            elif key == "TRIANGLE_STRIPS":
                raise ValueError("it holds triangle strips; write triangles")
            elif key == "CELL_TYPES":
                kinds = self._numbers(int(words[1]), "int")
        if cells is None or kinds is None:
            raise ValueError("it holds no polygons")
        flat = [
            cell
            for cell, kind in zip(cells, kinds, strict=True)
            if kind in (_TRIANGLE, _POLYGON, _QUAD) and len(cell) >= 3
        ]
        faces = [(cell[0], cell[k], cell[k + 1]) for cell in flat for k in range(1, len(cell) - 1)]
        found = np.array(faces, np.int64).reshape(-1, 3)
        if len(found) and not 0 <= found.min() <= found.max() < len(points):
            raise ValueError("a polygon names a point that is not there")
        return points, found

    def _cells(self, count: int, size: int) -> list[Ints]:
        """Point numbers of each cell."""
        start = self._at
        words = self._line().split()
        if words and words[0].upper() == "OFFSETS":  # since 5.1: `count` offsets, then `size` point numbers
            offsets = self._numbers(count, words[1])
            words = self._line().split()
            return np.split(self._numbers(size, words[1]).astype(np.int64), offsets[1:-1])
        self._at = start
        numbers, cells, at = self._numbers(size, "int").astype(np.int64), [], 0
        for _ in range(count):
            cells.append(numbers[at + 1 : at + 1 + int(numbers[at])])
            at += 1 + int(numbers[at])
        return cells

    def _line(self, empty: bool = False) -> str:
        """The next line; one that is empty only if asked for."""
        while self._at < len(self._data):
            end = self._data.find(b"\n", self._at)
            end = len(self._data) if end < 0 else end
            line = self._data[self._at : end].decode("latin-1").strip()
            self._at = end + 1
            if line or empty:
                return line
        return ""

    def _numbers(self, count: int, kind: str) -> NDArray[np.number]:
        try:
            dtype = np.dtype(_TYPES[kind.lower()])
        except KeyError:
            raise ValueError(f"numbers of the type {kind!r}") from None
        if self._binary:
            found = np.frombuffer(self._data, dtype, count, self._at)
            self._at += found.nbytes
            return found.astype(dtype.newbyteorder("="))
        words: list[bytes] = []
        while len(words) < count and self._at < len(self._data):
            words += self._line().encode().split()
        if len(words) != count:
            raise ValueError("it ends early")
        return np.array(words).astype(dtype.newbyteorder("="))
