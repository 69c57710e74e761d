"""Shadows of instruments: the share of the lamps' direct light that they take from each pixel's point.

Rays come from points spread evenly over each lamp's window (H. Vogel, "A better way to construct the
sunflower head", 1979) and are intersected in double precision (T. Moeller, B. Trumbore, "Fast, minimum
storage ray/triangle intersection", 1997).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from synth.arrays import Array, Floats, Indices, Ints, Map
from synth.geometry.triangles import Shape, join_shapes, normals
from synth.render.materials import Lamp
from synth.render.truth import Hits, Size, blend
from synth.system.jit import compiled, inlined

_RAYS = 32  # per lamp
_GOLDEN = np.pi * (3 - np.sqrt(5))
_HIDDEN_MM = 1e-3  # a surface that is nearer to the lamp than a point by more than this shades it
_CELL = 3.0  # side of the cells of points, in mean distances between points
_HAIR_MM = 1e-6  # tolerance of the bounds
_NEAR_MM = 1.0  # from a lamp's plane: triangles that are nearer, or behind it, are left out


def window(lamp: Lamp, rays: int = _RAYS) -> tuple[Floats, Floats]:
    """Points (rays, 2) mm spread evenly over a lamp's window, and the lamp's axes as rows (3, 3), z towards
    its target."""
    z = (lamp.target - lamp.position) / np.linalg.norm(lamp.target - lamp.position)
    x = np.cross(z, np.eye(3)[np.abs(z).argmin()])
    x /= np.linalg.norm(x)
    k = np.arange(rays)
    radius, turn = lamp.radius * np.sqrt((k + 0.5) / rays), k * _GOLDEN
    return np.stack([radius * np.cos(turn), radius * np.sin(turn)], 1), np.stack([x, np.cross(z, x), z])


def shadow_map(hits: Hits, shapes: Sequence[Shape], lamps: Sequence[Lamp], size: Size) -> Map:
    """Share (H, W), 0 to 1, of the lamps' direct light that instruments take from the points at hits.

    It is a share of the light that arrives without them: in the rim's shadow, of the rest. 0 on instruments,
    where nothing is hit, and where no light arrives.

    `hits`: of the pixels of a picture of a size (width, height), on the joined shapes, instruments last.
    """
    scene, vertex_normals = join_shapes(*shapes), np.concatenate([normals(shape) for shape in shapes])
    surroundings, tool = np.split(scene.faces, [len(scene.faces) - len(shapes[-1].faces)])
    pixels = np.flatnonzero((hits.face >= 0) & (hits.face < len(surroundings)))
    points = blend(scene.faces, hits.face[pixels], hits.bary[pixels], scene.vertices)
    views = []  # of each lamp: points on its window, points and vertices in its axes, instruments' shadows
    for lamp in lamps:
        start, axes = window(lamp)
        local = (points - lamp.position) @ axes.T, (scene.vertices - lamp.position) @ axes.T
        views.append((start, axes, *local, _find_blocked(start, *local, tool)))
    shaded = np.flatnonzero(np.any([view[-1] for view in views], axis=0))
    pixels = pixels[shaded]
    normal = blend(scene.faces, hits.face[pixels], hits.bary[pixels], vertex_normals)
    light = np.zeros((len(pixels), 2))  # that arrives without the instruments, and what they take of it
    for lamp, (start, axes, local_points, vertices, tool_bits) in zip(lamps, views, strict=True):
        local_points = np.ascontiguousarray(local_points[shaded])
        rim_bits = _find_blocked(start, local_points, vertices, surroundings)
        power = float(lamp.intensity.sum())
        _add_light(start, local_points, normal @ axes.T, power, rim_bits, tool_bits[shaded], light)
    shares = np.zeros(size[0] * size[1], np.float32)
    shares[pixels] = light[:, 1] / np.maximum(light[:, 0], 1e-300)
    return shares.reshape(size[::-1])


@compiled
def _add_light(
    start: Floats,
    points: Floats,
    normal: Floats,
    power: float,
    rim_bits: Array,
    tool_bits: Array,
    light: Floats,
) -> None:
    """Adds to `light` (N, 2) that of a lamp at points (N, 3), lamp axes, by the rays that are not blocked."""
    for i in range(len(points)):
        for s in range(len(start)):
            x, y, z = points[i, 0] - start[s, 0], points[i, 1] - start[s, 1], points[i, 2]
            facing = -(normal[i, 0] * x + normal[i, 1] * y + normal[i, 2] * z)
            if z <= 0.0 or facing <= 0.0 or (rim_bits[i] >> np.uint64(s)) & np.uint64(1):
                continue
            square = x * x + y * y + z * z
            share = power * facing * z / (square * square)  # cosines at both ends, over the distance's square
            light[i, 0] += share
            if (tool_bits[i] >> np.uint64(s)) & np.uint64(1):
                light[i, 1] += share


def _find_blocked(start: Floats, points: Floats, vertices: Floats, faces: Indices) -> Array:
    """Bits (N,) of the rays from points on a window (S, 2) to points (N, 3) that faces stop, lamp axes.

    All is projected from the window's middle onto a plane across the lamp's axis, where points are sorted
    into cells. There a ray to a point at depth z is, at depth d, within radius (1/d - 1/z) of the point.
    """
    bits, front = np.zeros(len(points), np.uint64), np.flatnonzero(points[:, 2] > _NEAR_MM)
    if not len(front):
        return bits
    plane = points[front, 2].mean()
    radius = plane * np.sqrt((start * start).sum(axis=1).max()) * 1.0001
    flat = points[:, :2] * plane / points[:, 2:]
    low, size = flat[front].min(axis=0), np.ptp(flat[front], axis=0)
    cell = max(_CELL * np.sqrt(size.prod() / len(points)), size.max() / 2000, 1e-9)
    columns, rows = (size / cell).astype(np.int64) + 1
    column, row = ((flat[front] - low) / cell).astype(np.int64).T
    number = row * columns + column
    deepest = np.full(columns * rows, _NEAR_MM)
    np.maximum.at(deepest, number, points[front, 2])
    order = front[np.argsort(number, kind="stable")]
    first = np.append(0, np.cumsum(np.bincount(number, minlength=columns * rows)))
    view, cells = np.array([plane, radius, *low, *size, cell]), (deepest, order, first)
    space = np.ascontiguousarray(start.T), points, np.ascontiguousarray(flat.T), vertices, faces
    _mark_blocked(*space, view, *cells, columns, bits)
    return bits


@compiled
def _mark_blocked(
    start: Floats,
    points: Floats,
    flat: Floats,
    vertices: Floats,
    faces: Indices,
    view: Floats,
    deepest: Floats,
    order: Ints,
    first: Ints,
    columns: int,
    bits: Array,
) -> None:
    """Sets the bits of the rays that faces stop.

    `start` (2, S), `flat` (2, N): points on the window, and on the plane; `view`: the plane's depth, the
    radius, and the cells' left, top, whole width, whole height and side; `deepest` of each cell, `order` of
    the points and `first` of each cell's among them.
    """
    plane, radius, left, top, width, height, cell = view
    start_x, start_y, x, y = start[0], start[1], flat[0], flat[1]
    all_bits = (np.uint64(1) << np.uint64(len(start_x))) - np.uint64(1)
    last = deepest.max()
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        nearest = min(a[2], b[2], c[2])
        if not _NEAR_MM < nearest < last:
            continue
        margin = radius * (1 / nearest - 1 / last) + _HAIR_MM
        sa, sb, sc = plane / a[2], plane / b[2], plane / c[2]
        x0, x1 = min(a[0] * sa, b[0] * sb, c[0] * sc), max(a[0] * sa, b[0] * sb, c[0] * sc)
        y0, y1 = min(a[1] * sa, b[1] * sb, c[1] * sc), max(a[1] * sa, b[1] * sb, c[1] * sc)
        if (
            x1 < left - margin
            or y1 < top - margin
            or x0 > left + width + margin
            or y0 > top + height + margin
        ):
            continue
        u0, u1 = int(max(x0 - margin - left, 0) / cell), int(min(x1 + margin - left, width) / cell)
        for v in range(int(max(y0 - margin - top, 0) / cell), int(min(y1 + margin - top, height) / cell) + 1):
            for u in range(u0, u1 + 1):
                n = v * columns + u
                reach = radius * (1 / nearest - 1 / deepest[n]) + _HAIR_MM
                x2, y2 = left + u * cell - reach, top + v * cell - reach
                is_apart = x1 < x2 or x0 > x2 + cell + 2 * reach or y1 < y2 or y0 > y2 + cell + 2 * reach
                if is_apart or deepest[n] <= nearest:
                    continue
                for k in range(first[n], first[n + 1]):
                    i = order[k]
                    reach = radius * (1 / nearest - 1 / points[i, 2]) + _HAIR_MM
                    is_within = x0 - reach <= x[i] <= x1 + reach and y0 - reach <= y[i] <= y1 + reach
                    if is_within and points[i, 2] > nearest and bits[i] != all_bits:
                        bits[i] |= _intersect(start_x, start_y, points[i], a, b, c)


@inlined
def _intersect(x: Floats, y: Floats, point: Floats, a: Floats, b: Floats, c: Floats) -> np.uint64:
    """Bits of the rays from points x, y (S,) on a window to a point (3,) that a triangle stops."""
    e0, e1, e2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    g0, g1, g2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    n0, n1, n2 = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
    offset = n0 * a[0] + n1 * a[1] + n2 * a[2]
    # Moeller and Trumbore's triple products are linear in the ray's start.
    p0, p1, p2 = point[0] - a[0], point[1] - a[1], point[2] - a[2]
    behind = n0 * p0 + n1 * p1 + n2 * p2
    q0, q1, q2 = p1 * g2 - p2 * g1, p2 * g0 - p0 * g2, p0 * g1 - p1 * g0
    r0, r1, r2 = e1 * p2 - e2 * p1, e2 * p0 - e0 * p2, e0 * p1 - e1 * p0
    q, r = q0 * a[0] + q1 * a[1] + q2 * a[2], r0 * a[0] + r1 * a[1] + r2 * a[2]
    tolerance = _HIDDEN_MM / np.sqrt(point[0] ** 2 + point[1] ** 2 + point[2] ** 2)
    sign = 1.0 if behind >= 0.0 else -1.0  # that of a plane between lamp and point
    bits = np.uint64(0)
    for s in range(len(x)):
        along = sign * (offset - n0 * x[s] - n1 * y[s])
        total = along + sign * behind
        across = sign * (q - q0 * x[s] - q1 * y[s])
        down = sign * (r - r0 * x[s] - r1 * y[s])
        hair = 1e-10 * total  # rays must not slip between faces that share an edge
        inside = (across >= -hair) & (down >= -hair) & (across + down <= total + hair)
        hit = inside & (along > 0.0) & (sign * behind > tolerance * total)
        bits |= np.uint64(hit) << np.uint64(s)
    return bits
