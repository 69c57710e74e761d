"""Surfaces in VTK's formats: legacy (.vtk), text or binary, and XML (.vtp) with arrays of every kind.

Source: The VTK User's Guide, file formats; legacy up to 5.1, whose cells are offsets and connectivity.
"""

from __future__ import annotations

import base64
import io
import re
import zlib
from collections.abc import Iterable
from typing import Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Ints

_TYPES = {"float": ">f4", "double": ">f8", "int": ">i4", "long": ">i8", "vtktypeint64": ">i8"}
_TRIANGLE, _STRIP, _POLYGON, _QUAD = 5, 6, 7, 9


def read_vtk(data: bytes) -> tuple[Floats, Ints]:
    """Vertices (V, 3) and triangles (F, 3) of a file's bytes; polygons are cut into fans.

    Raises ValueError if it is not a legacy VTK file of polygons, other exceptions if it is damaged.
    """
    file = _Reader(data)
    points = np.zeros((0, 3))
    cells: list[tuple[Ints, int]] = []  # with their kinds
    while (words := file.words()) and words[0].upper() not in ("POINT_DATA", "CELL_DATA"):
        key = words[0].upper()
        if key == "DATASET" and words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise ValueError(f"it contains {words[1]}, not polygons")
        if key == "POINTS":
            points = file.numbers(3 * int(words[1]), words[2]).reshape(-1, 3).astype(np.float64)
        elif key in ("POLYGONS", "TRIANGLE_STRIPS", "CELLS", "VERTICES", "LINES"):
            kind = {"POLYGONS": _POLYGON, "TRIANGLE_STRIPS": _STRIP}.get(key, 0)
            cells += [(cell, kind) for cell in file.cells(int(words[1]), int(words[2]))]
        elif key == "CELL_TYPES":
            kinds = file.numbers(len(cells), "int").tolist()
            cells = [(cell, kind) for (cell, _), kind in zip(cells, kinds, strict=True)]
    return points, _triangles(cells)


def read_vtp(data: bytes) -> tuple[Floats, Ints, str]:
    """As `read_vtk`, of VTK's XML format, and the space that 3D Slicer states, as `LPS`; empty: none."""
    head, _, tail = data.partition(b"<AppendedData")
    root = ElementTree.fromstring(head + b"</VTKFile>" if tail else data)
    coding, _, tail = tail.rpartition(b"</AppendedData")[0].partition(b"_")
    order: Literal["<", ">"] = ">" if root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(root.get("header_type", "UInt32").lower()).newbyteorder(order)
    if (packed := root.get("compressor")) not in (None, "vtkZLibDataCompressor"):
        raise ValueError(f"its compressor {packed} is not supported")

    def array(node: ElementTree.Element | None) -> NDArray[np.number]:
        if node is None:
            return np.zeros(0)
        dtype = np.dtype(node.get("type", "").lower().replace("string", "uint8")).newbyteorder(order)
        if node.get("format") == "ascii":
            return np.array((node.text or "").split()).astype(dtype)
        appended = node.get("format") == "appended"
        blob = tail[int(node.get("offset", 0)) :] if appended else (node.text or "").encode()
        if not appended or b"base64" in coding:  # header and data may be coded separately, each with padding
            blob = b"".join(map(base64.b64decode, re.findall(rb"[^=\s]+=*", blob)))
        if packed:
            count, size = np.frombuffer(blob, word, 2).tolist()
            ends = word.itemsize * (3 + count) + np.cumsum([0, *np.frombuffer(blob, word, 3 + count)[3:]])
            parts = zip(ends[:-1].astype(int), ends[1:].astype(int), strict=True)
            blob = b"".join(zlib.decompressobj().decompress(blob[a:b], size) for a, b in parts)
        else:
            blob = blob[word.itemsize :][: int(np.frombuffer(blob, word, 1)[0])]
        return np.frombuffer(blob, dtype)

    points, cells = np.zeros((0, 3)), []
    for piece in root.iter("Piece"):
        for name, kind in (("Polys", _POLYGON), ("Strips", _STRIP)):
            parts = [piece.find(f"{name}/DataArray[@Name='{one}']") for one in ("connectivity", "offsets")]
            links, ends = map(array, parts)
            found = np.split(links.astype(np.int64) + len(points), ends[:-1].astype(int)) if len(ends) else []
            cells += [(cell, kind) for cell in found]
        points = np.concatenate([points, array(piece.find("Points/DataArray")).reshape(-1, 3)])
    space = array(root.find(".//FieldData/Array[@Name='SPACE']"))
    return points, _triangles(cells), bytes(space.astype(np.uint8)).decode("latin-1").strip("\0")


def _triangles(cells: Iterable[tuple[Ints, int]]) -> Ints:
    """Triangles (F, 3) of cells with their kinds. ValueError if there are none."""
    found: list[tuple[int, int, int]] = []
    volumes = 0
    for cell, kind in cells:
        ends = range(1, len(cell) - 1)
        if kind in (_TRIANGLE, _POLYGON, _QUAD):
            found += [(cell[0], cell[k], cell[k + 1]) for k in ends]
        elif kind == _STRIP:  # every second one is turned
            found += [(cell[k - k % 2], cell[k - 1 + k % 2], cell[k + 1]) for k in ends]
        volumes += kind > _QUAD
    faces = np.array(found, np.int64).reshape(-1, 3)
    if not len(faces):
        volume = "it contains volume cells, not a surface: extract it"
        raise ValueError(volume if volumes else "it contains no polygons")
    return faces


class _Reader:
    """The bytes of a file and the current position."""

    def __init__(self, data: bytes) -> None:
        self._file = io.BytesIO(data)
        version, _, kind = (self._file.readline().strip() for _ in range(3))  # the second line is the title
        if not version.startswith(b"# vtk DataFile") or kind.upper() not in (b"ASCII", b"BINARY"):
            raise ValueError("not a legacy VTK file")
        self._binary = kind.upper() == b"BINARY"

    def words(self) -> list[str]:
        """Words of the next non-empty line; none at the end."""
        while line := self._file.readline():
            if found := line.decode("latin-1").split():
                return found
        return []

    def numbers(self, count: int, kind: str) -> NDArray[np.number]:
        """The next `count` numbers of a type."""
        if kind.lower() not in _TYPES:
            raise ValueError(f"unknown type {kind!r}")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self._binary:
            found = np.frombuffer(self._file.read(count * dtype.itemsize), dtype, count)
            return found.astype(dtype.newbyteorder("="))
        words: list[str] = []
        while len(words) < count and (more := self.words()):
            words += more
        if len(words) != count:
            raise ValueError("it is truncated")
        return np.array(words).astype(dtype.newbyteorder("="))

    def cells(self, count: int, size: int) -> list[Ints]:
        """Point numbers of each cell."""
        start = self._file.tell()
        words = self.words()
        if words[:1] == ["OFFSETS"]:  # since 5.1: `count` offsets, then `size` point numbers
            offsets = self.numbers(count, words[1])
            return np.split(self.numbers(size, self.words()[1]).astype(np.int64), offsets[1:-1])
        self._file.seek(start)
        numbers, cells, at = self.numbers(size, "int").astype(np.int64), [], 0
        for _ in range(count):
            cells.append(numbers[at + 1 : at + 1 + int(numbers[at])])
            at += 1 + int(numbers[at])
        return cells
