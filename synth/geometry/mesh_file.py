"""Meshes in VTK's files: points, cells, and data at points.

Legacy (.vtk), text or binary, versions up to 5.1; XML (.vtu, .vtp), inline or appended, text, base64 or raw,
compressed by zlib or LZMA. Source: The VTK User's Guide, file formats.
"""

from __future__ import annotations

import base64
import io
import json
import lzma
import re
import struct
import warnings
import xml.etree.ElementTree as ET
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Ints
from synth.geometry.skin import CELLS, IGNORED, TRIANGLE
from synth.system.resources import refuse_excess

SUFFIXES = ("vtu", "vtk", "vtp")
SURFACES = ("obj", "ply", "glb")  # without data at points
LARGEST_EXPANDED = 2 << 30  # bytes of all arrays of a file that are read, as of a file without compression
Numbers = NDArray[np.number]

_VERTICES, _LINE, _STRIP, _POLYGON = 2, 4, 6, 7
_REGULAR = {8: (9, [0, 1, 3, 2]), 11: (12, [0, 1, 3, 2, 4, 5, 7, 6])}  # pixel, voxel: as quad, hexahedron
_XML_CELLS = {"Cells": None, "Polys": _POLYGON, "Strips": _STRIP, "Lines": _LINE, "Verts": _VERTICES}
_LEGACY_CELLS = {"POLYGONS": _POLYGON, "TRIANGLE_STRIPS": _STRIP, "LINES": _LINE, "VERTICES": _VERTICES}
_PACKERS: dict[str, Callable[[], Any]] = {
    "vtkZLibDataCompressor": zlib.decompressobj,
    "vtkLZMADataCompressor": partial(lzma.LZMADecompressor, memlimit=256 << 20),
}
_XML_TYPES = {
    **{f"{sign}int{8 * size}": f"{sign or 'i'}{size}" for sign in ("", "u") for size in (1, 2, 4, 8)},
    **{"float32": "f4", "float64": "f8", "string": "u1"},
}
_LEGACY_TYPES = {
    "float": "f4", "double": "f8", "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2",
    "int": "i4", "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i8",
    "vtktypeint64": "i8",
}  # fmt: skip
_ATTRIBUTES = {"SCALARS": 1, "VECTORS": 3, "NORMALS": 3, "TENSORS": 9}
_WORD_LINE = re.compile(rb"\n[ \t]*(?!nan\b|inf\b)[A-Za-z_]", re.IGNORECASE)
_LONGEST_LINE = 20_000  # of a surface in text: a polygon's triangles take the square of its corners
_MOST_NODES = 1000  # of a .glb, whose search takes their square
_BLANK = re.compile(rb"\n[ \t\r]*\n")
_TIMES = ("time", "timevalue")


class _Reader(Protocol):
    def __call__(self, node: ET.Element | None, expected: int | None = None) -> Numbers: ...


@dataclass(frozen=True)
class PointArray:
    """An array at the points of a file, which is read when it is asked for."""

    parts: int  # numbers at each point
    read: Callable[[], Numbers]  # (N, parts); raises as `read_mesh`


@dataclass
class MeshFile:
    """The contents of one file."""

    points: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (N, 3), the file's unit
    cells: dict[int, Ints] = field(default_factory=dict)  # nodes (C, n) by VTK's number of the type
    point_data: dict[str, PointArray] = field(default_factory=dict)  # by name
    time: float = np.nan  # as stated in the file
    space: str = ""  # of its axes, such as LPS, as 3D Slicer states it in .vtp


class _Cells:
    """Cells as a file lists them, part by part."""

    def __init__(self) -> None:
        self._parts: dict[int, list[Ints]] = {}

    def add(self, kinds: Numbers | int, nodes: Ints, ends: Ints) -> None:
        """Adds cells of types (C,) or of one: their nodes one after another, and where each cell ends."""
        if np.shape(kinds) not in ((), ends.shape) or (len(ends) and ends[-1] != len(nodes)):
            raise ValueError("numbers of cells, types and nodes differ")
        kinds, sizes = np.broadcast_to(kinds, len(ends)), np.diff(ends, prepend=0)
        if sizes.min(initial=0) < 0 or (len(ends) and not 0 <= kinds.min() <= kinds.max() < 256):
            raise ValueError("a cell's size or type is out of range")
        for kind in np.unique(kinds).tolist():
            members = kinds == kind
            corners, counts = nodes[np.repeat(members, sizes)], sizes[members]
            if kind in IGNORED:
                corners = np.zeros((len(counts), 1), np.int64)  # present, without a face
            elif kind in (_POLYGON, _STRIP):
                kind, corners = TRIANGLE, _triangles(corners, counts, kind == _STRIP)
            else:
                kind, order = _REGULAR.get(kind, (kind, slice(None)))
                size = CELLS[kind].nodes if kind in CELLS else int(counts[0])
                if (counts != size).any():
                    raise ValueError(f"a cell of VTK's type {kind} has {counts[counts != size][0]} nodes")
                corners = corners.reshape(len(counts), size)[:, order]
            self._parts.setdefault(kind, []).append(corners)

    def join(self) -> dict[int, Ints]:
        """Nodes (C, n) of all by type. ValueError: cells of one type differ in size."""
        return {kind: np.concatenate(parts) for kind, parts in self._parts.items()}


def read_mesh(data: bytes) -> MeshFile:
    """The mesh in the bytes of a .vtk, .vtu or .vtp file.

    Raises ValueError if it is none, or damaged, or would need more memory than is free or than 2 GB for all
    arrays that are read; others as parsers of numbers raise them.
    """
    return _read_legacy(data) if data.startswith(b"# vtk DataFile") else _read_xml(data)


def read_surface(data: bytes, suffix: str, *, in_order: bool = True) -> tuple[Floats, Ints]:
    """Points (N, 3) and triangles (F, 3) of a surface in a format that trimesh reads.

    Files that it names (materials, pictures) are not opened. `in_order`: points are in the file's order.
    Raises what trimesh raises for what is none.
    """
    import trimesh  # here, as it is slow to import and most jobs have no mesh

    data = check_surface(data, suffix)
    options = {"maintain_order": True, "skip_materials": True} if in_order else {}
    mesh = trimesh.load(io.BytesIO(data), file_type=suffix, force="mesh", process=False, **options)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def check_surface(data: bytes, suffix: str) -> bytes:
    """The bytes of a surface for trimesh, text in UTF-8; ValueError for what would take it without bound."""
    if suffix == "glb":
        _refuse_hollow(data)
    if suffix == "ply":
        _refuse_overcount(data)
    if suffix == "stl":
        return _complete_stl(data)
    if suffix in ("obj", "off") or (suffix == "ply" and b"format ascii" in data[:1000]):
        if suffix == "obj":
            data = _strip_obj(data)
        if max(map(len, data.splitlines()), default=0) > _LONGEST_LINE:
            raise ValueError(f"a line has over {_LONGEST_LINE} characters; has a face thousands of corners?")
        try:
            data.decode("utf-8")
        except UnicodeDecodeError:  # of names and comments
            return data.decode("latin-1").encode("utf-8")
    return data


def _complete_stl(data: bytes) -> bytes:
    """An STL with the number of faces that its size gives. ValueError if its header counts others."""
    if len(data) < 84 or (data[:5].lower() == b"solid" and b"facet" in data[:1000].lower()):
        return data
    count, face_count = struct.unpack_from("<I", data, 80)[0], (len(data) - 84) // 50
    if count not in (0, face_count):
        raise ValueError(f"its header counts {count} faces, its size {face_count}")
    return data[:80] + struct.pack("<I", face_count) + data[84 : 84 + 50 * face_count]


def _strip_obj(data: bytes) -> bytes:
    """Vertices and faces of an .obj alone, in order: groups, materials and textures split its vertices."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    shape_lines = (line for line in lines if line.split(None, 1)[:1] in ([b"v"], [b"f"]))
    return re.sub(rb"/\S*", b"", b"\n".join(shape_lines)) + b"\n"


def _refuse_hollow(data: bytes) -> None:
    """ValueError for a .glb with arrays that have no bytes in it: they may be of any size."""
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    hollow = [
        accessor
        for accessor in tree.get("accessors", [])
        if "bufferView" not in accessor or "sparse" in accessor
    ]
    if len(tree.get("nodes", [])) > _MOST_NODES:
        raise ValueError(f"it has over {_MOST_NODES} nodes; join its meshes")
    outside = any("uri" in buffer for buffer in tree.get("buffers", []))
    if data[:4] != b"glTF" or hollow or outside or tree.get("extensionsRequired"):
        raise ValueError("it is no plain GLB: sparse, empty, compressed or outer arrays, or another format")


def _refuse_overcount(data: bytes) -> None:
    """ValueError for a .ply whose header counts more elements than it has bytes."""
    head = data.partition(b"end_header")[0]
    for count in re.findall(rb"^element\s+\S+\s+(\S+)", head, re.MULTILINE):
        if not 0 <= int(count) <= len(data) - len(head):
            raise ValueError(f"its header counts {count.decode('latin-1')} elements, its size is less")


def _triangles(nodes: Ints, sizes: Ints, strips: bool) -> Ints:
    """Triangles (F, 3) of polygons, as fans, or of strips, each second of which is turned."""
    count = np.maximum(sizes - 2, 0)  # triangles of each
    first = np.repeat(np.cumsum(sizes) - sizes, count)
    step = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    if strips:
        turned = step % 2
        corners = first + step + np.stack([turned, 1 - turned, np.full_like(step, 2)])
    else:
        corners = np.stack([first, first + step + 1, first + step + 2])
    return np.asarray(nodes[corners.T])


def _read_xml(data: bytes) -> MeshFile:
    head, tag, rest = data.partition(b"<AppendedData")  # what is appended may be raw, thus no XML
    if b"\0" in head or b"<!DOCTYPE" in head or b"<!ENTITY" in head:
        raise ValueError("it declares entities, or is not in UTF-8")
    root = ET.fromstring(head + b"</VTKFile>" if tag else data)
    if root.tag != "VTKFile" or root.get("type") not in ("UnstructuredGrid", "PolyData"):
        raise ValueError(f"it holds {root.get('type') or root.tag}, not an unstructured grid or polygons")
    array, file, cells = _xml_arrays(root, rest), MeshFile(), _Cells()
    points, pieces, point_offset = list[Floats](), list[tuple[int, dict[str, ET.Element]]](), 0
    for piece in root.iter("Piece"):
        expected = piece.get("NumberOfPoints")
        if expected is not None and int(expected) == 0:
            continue
        coordinates = array(piece.find("Points/DataArray"), None if expected is None else 3 * int(expected))
        points.append(coordinates.reshape(-1, 3).astype(np.float64))
        count = len(points[-1])
        for name, kind in _XML_CELLS.items():
            stated = piece.get("NumberOfCells" if kind is None else f"NumberOf{name}")
            number = None if stated is None else int(stated)
            parts = {str(child.get("Name")): child for child in piece.iterfind(f"{name}/DataArray")}
            if {"connectivity", "offsets"} <= set(parts) and number != 0:
                ends = as_integers(array(parts["offsets"], number))
                kinds = as_integers(array(parts["types"], number)) if kind is None else kind
                cells.add(kinds, point_offset + as_integers(array(parts["connectivity"])), ends)
        piece_arrays = {str(child.get("Name")): child for child in piece.iterfind("PointData/DataArray")}
        if count:
            pieces.append((count, piece_arrays))
        point_offset += count
    file.points, file.cells = np.concatenate([np.zeros((0, 3)), *points]), cells.join()
    for name in dict.fromkeys(name for _, arrays in pieces for name in arrays):
        nodes = [(count, arrays.get(name)) for count, arrays in pieces]
        if (parts_of := _count_parts(nodes, array)) is not None:
            file.point_data[name] = PointArray(parts_of, partial(_join, nodes, parts_of, array))
    for child in root.iterfind(".//FieldData/"):
        if str(child.get("Name")).lower() in _TIMES:
            file.time = float(array(child)[0])
        elif child.get("Name") == "SPACE":
            file.space = bytes(array(child).astype(np.uint8)).decode("latin-1").strip("\0").strip().upper()
    return file


_Nodes = list[tuple[int, ET.Element | None]]  # of an array: points of each piece, and its numbers there


def _count_parts(nodes: _Nodes, array: _Reader) -> int | None:
    """Numbers at each point of an array; where it states none, by its length. None: pieces differ."""
    part_counts = {child.get("NumberOfComponents") for _, child in nodes if child is not None}
    if part_counts == {None}:
        count, node = next((count, child) for count, child in nodes if child is not None)
        length = len(array(node))
        return length // count if length and length % count == 0 else None
    return int(part_counts.pop() or 1) if len(part_counts) == 1 else None


def _join(nodes: _Nodes, parts: int, array: _Reader) -> Numbers:
    """An array (N, parts) over all pieces; 0 in those without it."""
    pieces = [
        np.zeros((count, parts)) if child is None else array(child, parts * count).reshape(count, parts)
        for count, child in nodes
    ]
    return pieces[0] if len(pieces) == 1 else np.concatenate(pieces)


def as_integers(numbers: Numbers) -> Ints:
    """Whole numbers (...) as int64. ValueError: one is not whole."""
    if numbers.dtype.kind not in "iu" and not (
        numbers.dtype.kind == "f" and (np.abs(numbers) < 2**53).all() and (numbers == np.rint(numbers)).all()
    ):
        raise ValueError("a number of a point or cell is not whole")
    return numbers.astype(np.int64)


def _xml_arrays(root: ET.Element, rest: bytes) -> _Reader:
    """A function that gives the numbers of an array, one after another; text as the bytes' numbers.

    `rest`: the file after <AppendedData.
    """
    coding, _, tail = rest.rpartition(b"</AppendedData")[0].partition(b"_")
    raw = b"raw" in coding
    order: Literal["<", ">"] = ">" if root.get("byte_order") == "BigEndian" else "<"
    word = np.dtype(root.get("header_type", "UInt32").lower()).newbyteorder(order)
    if word not in (np.dtype(f"{order}u4"), np.dtype(f"{order}u8")):
        raise ValueError("its header_type is neither UInt32 nor UInt64")
    if (packer := root.get("compressor")) not in (None, *_PACKERS):
        raise ValueError(f"it is compressed by {packer}; write it with zlib or uncompressed")
    appended = (element for element in root.iter() if element.get("format") == "appended")
    starts = sorted({int(element.get("offset", 0)) for element in appended})
    if starts and not 0 <= starts[0] <= starts[-1] <= len(tail):
        raise ValueError("an offset is outside of what is appended; is it truncated?")
    ends = dict(zip(starts, [*starts[1:], len(tail)], strict=False))
    budget = [LARGEST_EXPANDED]

    def array(node: ET.Element | None, expected: int | None = None) -> Numbers:
        """`expected`: how many numbers there have to be."""
        if node is None:
            return np.zeros(0)
        if (kind := node.get("type", "").lower()) not in _XML_TYPES:
            raise ValueError(f"unknown type {kind[:20]!r} of an array")
        dtype = np.dtype(_XML_TYPES[kind])
        data, form = (node.text or "").encode(), node.get("format", "ascii")
        if form == "ascii":
            numbers = _parse(data, dtype)
        else:
            if form == "appended":
                data = tail[(offset := int(node.get("offset", 0))) : ends[offset]]
            if form != "appended" or not raw:  # header and data may be coded separately, each with padding
                data = b"".join(map(base64.b64decode, re.findall(rb"[^=]+=*", b"".join(data.split()))))
            limit = budget[0] if expected is None else min(budget[0], expected * dtype.itemsize)
            data = _unpack(data, word, packer, limit)
            budget[0] -= len(data)
            numbers = np.frombuffer(data, dtype.newbyteorder(order)).astype(dtype)
        if expected is not None and len(numbers) != expected:
            raise ValueError(f"an array has {len(numbers)} numbers where {expected} are stated; truncated?")
        return numbers

    return array


def _unpack(data: bytes, word: np.dtype[np.number], packer: str | None, limit: int) -> bytes:
    """The bytes of an array after its header, expanded; ValueError if they are not those that it states, or
    more than `limit`."""
    count, width = int(np.frombuffer(data, word, 1)[0]), word.itemsize
    if packer is None:
        if len(data) < width + count:
            raise ValueError("it is truncated")
        if count > limit:
            raise ValueError(f"an array has {count} bytes, {limit} are expected")
        return data[width : width + count]
    if (count + 3) * width > len(data):
        raise ValueError("it is truncated")
    size, last, *packed = np.frombuffer(data, word, count + 3)[1:].tolist()
    sizes = [size] * (count - 1) + [last or size] * (count > 0)
    total = sum(sizes)
    if total > limit or (count and min(sizes) < 1):
        raise ValueError(f"an array expands to {total} bytes, {limit} are expected at most")
    refuse_excess(total)
    stops, parts = np.cumsum([width * (count + 3), *packed]), list[bytes]()
    for (start, end), block_size in zip(pairwise(stops.tolist()), sizes, strict=True):
        part = _PACKERS[packer]().decompress(data[start:end], block_size + 1)
        if len(part) != block_size:
            raise ValueError("a block has another size than it states; is it truncated?")
        parts.append(part)
    return b"".join(parts)


def _parse(text: bytes, dtype: np.dtype[np.number]) -> Numbers:
    """The numbers in a text."""
    kind = np.int64 if dtype.kind in "iu" else np.float64
    if len(text) < 2000:
        return np.array([kind(word) for word in text.split()], kind)
    is_text = np.frombuffer(text, np.uint8) > ord(" ")
    count = int(is_text[0]) + int(
        (is_text[1:] & ~is_text[:-1]).sum()
    )  # of words; a list of them is 20 times the text
    refuse_excess(8 * count)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a text that ends early
        numbers = np.fromstring(text, kind, sep=" ")
    if len(numbers) != count:
        raise ValueError("a number can't be read")
    return numbers


def _read_legacy(data: bytes) -> MeshFile:
    file, contents, cells = _Legacy(data), MeshFile(), _Cells()
    mixed: tuple[Ints, Ints] | None = None
    target: dict[str, PointArray] | None = None
    rows = 0
    while words := file.words():
        key = words[0].upper()
        if key == "DATASET" and words[1].upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
            raise ValueError(f"it holds {words[1]}, not an unstructured grid or polygons")
        if key == "POINTS":
            contents.points = file.numbers(3 * int(words[1]), words[2])().reshape(-1, 3).astype(np.float64)
        elif key == "CELLS":
            mixed = file.cells(int(words[1]), int(words[2]))
        elif key in _LEGACY_CELLS:
            cells.add(_LEGACY_CELLS[key], *file.cells(int(words[1]), int(words[2])))
        elif key == "CELL_TYPES" and mixed is not None:
            cells.add(file.numbers(int(words[1]), "int")(), *mixed)
        elif key in ("POINT_DATA", "CELL_DATA"):
            rows, target = int(words[1]), contents.point_data if key == "POINT_DATA" else {}
            if target is contents.point_data and rows != len(contents.points):
                raise ValueError(f"it has data of {rows} points, and {len(contents.points)} points")
        elif key in _ATTRIBUTES and target is not None:
            parts = int(words[3]) if key == "SCALARS" and len(words) > 3 else _ATTRIBUTES[key]
            if key == "SCALARS":
                file.words()  # LOOKUP_TABLE
            target[words[1]] = PointArray(parts, file.numbers(rows * parts, words[2], (rows, parts)))
        elif key == "FIELD":
            for _ in range(int(words[2])):
                if len(words := file.words()) < 4:
                    raise ValueError("an array of its field is missing; is it truncated?")
                name, width, tuples, kind = words[:4]
                parts, count = int(width), int(tuples)
                if kind == "string":
                    file.skip_lines(count)
                    continue
                values = file.numbers(parts * count, kind, (count, parts))
                if target is not None:
                    target[name] = PointArray(parts if count == rows else 0, values)
                elif name.lower() in _TIMES and parts * count > 0:
                    contents.time = float(values().ravel()[0])
    contents.cells = cells.join()
    return contents


class _Legacy:
    """The bytes of a legacy file and the current position."""

    def __init__(self, data: bytes) -> None:
        head = data.split(b"\n", 3)
        kind = head[2].strip().upper() if len(head) == 4 else b""  # head[1] is the title
        if kind not in (b"ASCII", b"BINARY"):
            raise ValueError("its third line is neither ASCII nor BINARY")
        self._data, self._position, self._binary = data, len(data) - len(head[3]), kind == b"BINARY"

    def words(self) -> list[str]:
        """Words of the next non-empty line; none at the end. Blocks of metadata are passed over."""
        while self._position < len(self._data):
            end = self._data.find(b"\n", self._position)
            end = len(self._data) if end < 0 else end
            line_words = self._data[self._position : end].decode("latin-1").split()
            self._position = end + 1
            if line_words == ["METADATA"]:
                blank = _BLANK.search(self._data, self._position - 1)
                self._position = blank.end() if blank else len(self._data)
            elif line_words:
                return line_words
        return []

    def skip_lines(self, count: int) -> None:
        """Passes over lines of text. ValueError: there are fewer."""
        for _ in range(count):
            if not self.words():
                raise ValueError(f"it ends before its {count} texts; is it truncated?")

    def numbers(self, count: int, kind: str, shape: tuple[int, ...] = (-1,)) -> Callable[[], Numbers]:
        """Passes over the next `count` numbers of a type; what is returned reads them in a shape."""
        if kind.lower() not in _LEGACY_TYPES:
            raise ValueError(f"unknown type {kind[:20]!r}")
        dtype, start = np.dtype(f">{_LEGACY_TYPES[kind.lower()]}"), self._position
        least = count * dtype.itemsize if self._binary else 2 * count - 1  # digits, and what parts them
        if count < 0 or least > len(self._data) - start:
            raise ValueError(f"it ends before the {count} numbers that are stated; is it truncated?")
        if self._binary:
            self._position += count * dtype.itemsize
            return lambda: (
                np.frombuffer(self._data, dtype, count, start).astype(dtype.newbyteorder("=")).reshape(shape)
            )
        stop = _WORD_LINE.search(self._data, start - 1)
        self._position = end = stop.start() if stop else len(self._data)

        def read() -> Numbers:
            values = _parse(self._data[start:end], dtype)
            if len(values) != count:
                raise ValueError(f"it has {len(values)} numbers where {count} are stated; is it truncated?")
            return values.reshape(shape)

        return read

    def cells(self, count: int, size: int) -> tuple[Ints, Ints]:
        """Nodes of cells one after another, and where each ends."""
        start, words = self._position, self.words()
        if words[:1] == ["OFFSETS"]:  # since 5.1: `count` offsets, then `size` point numbers
            offsets = as_integers(self.numbers(count, words[1])())
            return as_integers(self.numbers(size, self.words()[1])()), offsets[1:]
        self._position = start
        numbers = as_integers(self.numbers(size, "int")())
        if not 0 <= count <= size:
            raise ValueError(f"{count} cells can't consist of {size} numbers")
        if count and size % count == 0 and (numbers[:: size // count] == size // count - 1).all():
            return np.delete(numbers, slice(None, None, size // count)), np.arange(1, count + 1) * (
                size // count - 1
            )
        first, position, lengths = np.empty(count, np.int64), 0, numbers.tolist()
        for k in range(count):
            if position >= size or lengths[position] < 0:
                raise ValueError("a cell has no nodes; is it truncated?")
            first[k] = position
            position += 1 + lengths[position]
        if position != size:
            raise ValueError("numbers of cells and of their nodes differ")
        return np.delete(numbers, first), np.cumsum(numbers[first])
