"""Meshes in VTK's files: points, cells, and data at points.

Legacy (.vtk), text or binary, versions up to 5.1; XML (.vtu, .vtp), inline or appended, text, base64 or raw,
compressed by zlib or LZMA. Source: The VTK User's Guide, file formats.
"""

from __future__ import annotations

import base64
import lzma
import re
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Ints
from synth.geometry.skin import CELLS, IGNORED, TRIANGLE

SUFFIXES = ("vtu", "vtk", "vtp")
Numbers = NDArray[np.number]

_VERTICES, _LINE, _STRIP, _POLYGON = 2, 4, 6, 7
_REGULAR = {8: (9, [0, 1, 3, 2]), 11: (12, [0, 1, 3, 2, 4, 5, 7, 6])}  # pixel, voxel: as quad, hexahedron
_XML_CELLS = {"Cells": None, "Polys": _POLYGON, "Strips": _STRIP, "Lines": _LINE, "Verts": _VERTICES}
_LEGACY_CELLS = {"POLYGONS": _POLYGON, "TRIANGLE_STRIPS": _STRIP, "LINES": _LINE, "VERTICES": _VERTICES}
_PACKERS = {"vtkZLibDataCompressor": zlib, "vtkLZMADataCompressor": lzma}
_LEGACY_TYPES = {
    "float": "f4", "double": "f8", "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i8",
    "vtktypeint64": "i8",
}  # fmt: skip
_ATTRIBUTES = {"SCALARS": 1, "VECTORS": 3, "NORMALS": 3, "TENSORS": 9}
_WORD_LINE = re.compile(rb"\n[ \t]*(?!nan\b|inf\b)[A-Za-z_]", re.IGNORECASE)
_TIMES = ("time", "timevalue")


@dataclass
class MeshFile:
    """The contents of one file."""

    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3), the file's unit
    cells: dict[int, Ints] = field(default_factory=dict)  # nodes (C, n) by VTK's number of the type
    point_data: dict[str, Numbers] = field(default_factory=dict)  # (N, ...) by name
    time: float = np.nan  # as stated in the file
    space: str = ""  # of its axes, such as LPS, as 3D Slicer states it in .vtp

    def add(self, kinds: Numbers | int, nodes: Ints, ends: Ints) -> None:
        """Adds cells of types (C,) or of one: their nodes one after another, and where each cell ends."""
        if np.shape(kinds) not in ((), ends.shape) or (len(ends) and ends[-1] != len(nodes)):
            raise ValueError("numbers of cells, types and nodes differ")
        kinds, sizes = np.broadcast_to(kinds, len(ends)), np.diff(ends, prepend=0)
        for kind in np.unique(kinds).tolist():
            mine = kinds == kind
            own, each = nodes[np.repeat(mine, sizes)], sizes[mine]
            if kind in IGNORED:
                own = np.zeros((len(each), 1), np.int64)  # present, without a face
            elif kind in (_POLYGON, _STRIP):
                kind, own = TRIANGLE, _triangles(own, each, kind == _STRIP)
            else:
                kind, order = _REGULAR.get(kind, (kind, slice(None)))
                size = CELLS[kind].nodes if kind in CELLS else int(each[0])
                if (each != size).any():
                    raise ValueError(f"a cell of VTK's type {kind} has {each[each != size][0]} nodes")
                own = own.reshape(-1, size)[:, order]
            self.cells[kind] = np.concatenate([self.cells.get(kind, own[:0]), own])


def read_mesh(data: bytes) -> MeshFile:
    """The mesh in the bytes of a .vtk, .vtu or .vtp file.

    Raises ValueError if it is none, or damaged; others as parsers of numbers raise them.
    """
    return _read_legacy(data) if data.startswith(b"# vtk DataFile") else _read_xml(data)


def _triangles(nodes: Ints, sizes: Ints, strips: bool) -> Ints:
    """Triangles (F, 3) of polygons, as fans, or of strips, each second of which is turned."""
    parts = [np.zeros((0, 3), np.int64)]
    for size in np.unique(sizes):
        cells = nodes[np.repeat(sizes == size, sizes)].reshape(-1, size)
        for k in range(size - 2):
            strip = [k, k + 1, k + 2] if k % 2 == 0 else [k + 1, k, k + 2]
            parts.append(cells[:, strip if strips else [0, k + 1, k + 2]])
    return np.concatenate(parts)


def _read_xml(data: bytes) -> MeshFile:
    head, tag, rest = data.partition(b"<AppendedData")  # what is appended may be raw, thus no XML
    if b"<!ENTITY" in head:
        raise ValueError("it declares entities")
    root = ET.fromstring(head + b"</VTKFile>" if tag else data)
    if root.tag != "VTKFile" or root.get("type") not in ("UnstructuredGrid", "PolyData"):
        raise ValueError(f"it holds {root.get('type') or root.tag}, not an unstructured grid or polygons")
    array, found = _xml_arrays(root, rest), MeshFile()
    for piece in root.iter("Piece"):
        if piece.get("NumberOfPoints") == "0":
            continue
        before, here = len(found.points), array(piece.find("Points/DataArray")).reshape(-1, 3)
        found.points = np.concatenate([found.points, here.astype(np.float64)])
        for name, kind in _XML_CELLS.items():
            parts = {one.get("Name"): array(one) for one in piece.iterfind(f"{name}/DataArray")}
            if {"connectivity", "offsets"} <= set(parts):
                nodes, ends = (parts[one].astype(np.int64) for one in ("connectivity", "offsets"))
                found.add(parts["types"] if kind is None else kind, before + nodes, ends)
        for one in piece.iterfind("PointData/DataArray"):
            if len(values := array(one)) and len(values) % len(here) == 0:
                name, values = str(one.get("Name")), values.reshape(len(here), -1)
                earlier = found.point_data.get(name, np.zeros((before, values.shape[1]), values.dtype))
                found.point_data[name] = np.concatenate([earlier, values])
    for one in root.iterfind(".//FieldData/"):
        if str(one.get("Name")).lower() in _TIMES:
            found.time = float(array(one)[0])
        elif one.get("Name") == "SPACE":
            found.space = bytes(array(one).astype(np.uint8)).decode("latin-1").strip("\0").strip().upper()
    return found


def _xml_arrays(root: ET.Element, rest: bytes) -> Callable[[ET.Element | None], Numbers]:
    """A function that gives the numbers of an array, one after another; text as the bytes' numbers.

    `rest`: the file after <AppendedData.
    """
    coding, _, tail = rest.rpartition(b"</AppendedData")[0].partition(b"_")
    raw = b"raw" in coding
    order: Literal["<", ">"] = ">" if root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(root.get("header_type", "UInt32").lower()).newbyteorder(order)
    if (packer := root.get("compressor")) not in (None, *_PACKERS):
        raise ValueError(f"it is compressed by {packer}; write it with zlib or uncompressed")
    appended = (one for one in root.iter() if one.get("format") == "appended")
    starts = sorted({int(one.get("offset", 0)) for one in appended})
    ends = dict(zip(starts, [*starts[1:], len(tail)], strict=False))

    def array(node: ET.Element | None) -> Numbers:
        if node is None:
            return np.zeros(0)
        dtype = np.dtype(node.get("type", "").lower().replace("string", "uint8"))
        data, form = (node.text or "").encode(), node.get("format", "ascii")
        if form == "ascii":
            return _parsed(data, dtype)
        if form == "appended":
            data = tail[(at := int(node.get("offset", 0))) : ends[at]]
        if form != "appended" or not raw:  # header and data may be coded separately, each with padding
            data = b"".join(map(base64.b64decode, re.findall(rb"[^=]+=*", b"".join(data.split()))))
        count, width = int(np.frombuffer(data, word, 1)[0]), word.itemsize
        if packer is None:
            if len(data) < width + count:
                raise ValueError("it is truncated")
            data = data[width : width + count]
        else:
            sizes = np.frombuffer(data, word, count + 3)[3:].tolist()
            stops = np.cumsum([width * (count + 3), *sizes])
            data = b"".join(_PACKERS[packer].decompress(data[a:b]) for a, b in pairwise(stops))
        return np.frombuffer(data, dtype.newbyteorder(order)).astype(dtype)

    return array


def _parsed(text: bytes, dtype: np.dtype[np.number]) -> Numbers:
    """The numbers in a text."""
    kind = np.int64 if dtype.kind in "iu" else np.float64
    words = text.split()
    found = np.array(words, "S32").astype(kind) if len(words) < 100 else np.fromstring(text, kind, sep=" ")
    if len(found) != len(words):
        raise ValueError("a number can't be read")
    return found


def _read_legacy(data: bytes) -> MeshFile:
    file, found = _Legacy(data), MeshFile()
    mixed: tuple[Ints, Ints] | None = None
    target: dict[str, Numbers] | None = None
    rows = 0
    while words := file.words():
        key = words[0].upper()
        if key == "DATASET" and words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise ValueError(f"it holds {words[1]}, not an unstructured grid or polygons")
        if key == "POINTS":
            found.points = file.numbers(3 * int(words[1]), words[2]).reshape(-1, 3).astype(np.float64)
        elif key == "CELLS":
            mixed = file.cells(int(words[1]), int(words[2]))
        elif key in _LEGACY_CELLS:
            found.add(_LEGACY_CELLS[key], *file.cells(int(words[1]), int(words[2])))
        elif key == "CELL_TYPES" and mixed is not None:
            found.add(file.numbers(int(words[1]), "int"), *mixed)
        elif key in ("POINT_DATA", "CELL_DATA"):
            rows, target = int(words[1]), found.point_data if key == "POINT_DATA" else {}
        elif key in _ATTRIBUTES and target is not None:
            parts = int(words[3]) if key == "SCALARS" and len(words) > 3 else _ATTRIBUTES[key]
            if key == "SCALARS":
                file.words()  # LOOKUP_TABLE
            target[words[1]] = file.numbers(rows * parts, words[2]).reshape(rows, parts)
        elif key == "FIELD":
            for _ in range(int(words[2])):
                name, width, tuples, kind = file.words()[:4]
                if kind == "string":
                    for _ in range(int(tuples)):
                        file.words()
                    continue
                values = file.numbers(int(width) * int(tuples), kind).reshape(int(tuples), int(width))
                if target is not None:
                    target[name] = values
                elif name.lower() in _TIMES and values.size:
                    found.time = float(values.ravel()[0])
    return found


class _Legacy:
    """The bytes of a legacy file and the current position."""

    def __init__(self, data: bytes) -> None:
        head = data.split(b"\n", 3)
        kind = head[2].strip().upper() if len(head) == 4 else b""  # head[1] is the title
        if kind not in (b"ASCII", b"BINARY"):
            raise ValueError("its third line is neither ASCII nor BINARY")
        self._data, self._at, self._binary = data, len(data) - len(head[3]), kind == b"BINARY"

    def words(self) -> list[str]:
        """Words of the next non-empty line; none at the end. Blocks of metadata are passed over."""
        while self._at < len(self._data):
            end = self._data.find(b"\n", self._at)
            end = len(self._data) if end < 0 else end
            found = self._data[self._at : end].decode("latin-1").split()
            self._at = end + 1
            if found == ["METADATA"]:
                blank = re.compile(rb"\n[ \t\r]*\n").search(self._data, self._at - 1)
                self._at = blank.end() if blank else len(self._data)
            elif found:
                return found
        return []

    def numbers(self, count: int, kind: str) -> Numbers:
        """The next `count` numbers of a type."""
        if kind.lower() not in _LEGACY_TYPES:
            raise ValueError(f"unknown type {kind!r}")
        dtype = np.dtype(f">{_LEGACY_TYPES[kind.lower()]}")
        if self._binary:
            found = np.frombuffer(self._data, dtype, count, self._at)
            self._at += found.nbytes
            return found.astype(dtype.newbyteorder("="))
        stop = _WORD_LINE.search(self._data, self._at - 1)
        end = stop.start() if stop else len(self._data)
        found = _parsed(self._data[self._at : end], dtype)
        if len(found) != count:
            raise ValueError(f"it has {len(found)} numbers where {count} are stated; is it truncated?")
        self._at = end
        return found

    def cells(self, count: int, size: int) -> tuple[Ints, Ints]:
        """Nodes of cells one after another, and where each ends."""
        start, words = self._at, self.words()
        if words[:1] == ["OFFSETS"]:  # since 5.1: `count` offsets, then `size` point numbers
            offsets = self.numbers(count, words[1]).astype(np.int64)
            return self.numbers(size, self.words()[1]).astype(np.int64), offsets[1:]
        self._at = start
        numbers = self.numbers(size, "int").astype(np.int64)
        first, at = np.empty(count, np.int64), 0
        for k in range(count):
            first[k] = at
            at += 1 + int(numbers[at])
        return np.delete(numbers, first), np.cumsum(numbers[first])
