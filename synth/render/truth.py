"""Ground truth by centre rays in double precision: the surface point in each pixel, and its motion.

Independent of the renderer: triangles are intersected with the rays of `camera`, so that labels are the same
on every variant, exact at folds and edges, and in the pixels of the recorded (distorted) picture.
Intersection: T. Moeller, B. Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from synth.arrays import Array, Floats, Indices, Ints, Map, Mask
from synth.geometry.triangles import Shape, join_shapes, lengths, normals
from synth.render.camera import camera as cameras
from synth.render.camera.camera import Camera
from synth.system.jit import argument_types, as_constant, compiled

Size = tuple[int, int]
"""Width, height [px]."""

_HIDDEN_MM = 1e-3  # a surface that is nearer than a point by more than this hides it
_NEAR_MM = 1.0
# Distortion bends triangles, small ones less: margin around their corners in which rays are tested.
_PAD_PX = 1.5
_LEAST_PAD_PX, _PAD_SHARE = 0.25, 1 / 16
_SURELY = 2e-10  # share of a triangle by which a ray surely misses, whatever the rounding


@dataclass(frozen=True)
class Hits:
    """First intersection along each ray."""

    face: Indices  # (N,) index of the triangle; -1 where there is none
    bary: Floats  # (N, 3) weights of its corners; 0 where there is none
    along: Floats  # (N,) distance in units of the ray's direction; inf where there is none


@dataclass(frozen=True)
class RestFrame:
    """Ground truth of the rest frame."""

    tissue: Mask  # (H, W)
    area: Map  # (H, W) mm2 of rest surface in the pixel; 0 off the tissue
    scale_mm_per_px: float  # at the world's origin
    face: Indices  # (H, W) triangle of the fine surface; -1 off the tissue
    bary: Floats  # (H, W, 3)
    directions: Floats  # (H*W, 3) of the pixels' centre rays, camera axes, unit z; the same for any pose
    points: Floats  # (H*W, 3) mm of the tissue at the pixels, camera axes; 0 off the tissue


@dataclass(frozen=True)
class FrameTruth:
    """Ground truth of one frame, at the rest frame's pixels (material points) or at the frame's own."""

    flow: Map  # (H, W, 2) px, rest pixels; 0 off the tissue
    motion: Map  # (H, W, 3) mm, rest pixels, each frame's camera axes; 0 off the tissue
    visible: Mask  # (H, W), rest pixels: the point is in the picture and not hidden
    depth: Map  # (H, W) mm along the optical axis, this frame's pixels; 0 for none
    tool: Mask  # (H, W), this frame's pixels
    hits: Hits  # this frame's pixels, over tissue, static bodies and instruments, in this order


@dataclass(frozen=True)
class ProjectedScene:
    """A scene projected by one camera."""

    points: Floats  # (V, 3) mm, camera axes; NaN at the lens or behind it, which drops their faces
    flat: Floats  # (V, 2) px
    faces: Indices  # (F, 3)
    size: Size

    @classmethod
    def of(cls, camera: Camera, scene: Shape) -> ProjectedScene:
        points = cameras.to_camera(camera, scene.vertices)
        points[points[:, 2] < _NEAR_MM] = np.nan
        return cls(points, cameras.to_pixels(camera, points), scene.faces, camera.size)

    def cast(self, pixels: Floats | None, directions: Floats) -> Hits:
        """First intersections of rays (N, 3) from the lens, camera axes, of any length.

        `pixels`: (N, 2) px that they pass through; those outside have no intersection; None: all pixels'
        centres, row by row.
        """
        width, height = self.size
        if pixels is None:
            order, start = np.arange(width * height), np.arange(width * height + 1)
        else:
            x, y = np.floor(pixels + 0.5).T
            within = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))
            cell = (y[within] * width + x[within]).astype(np.int64)
            order = within[np.argsort(cell, kind="stable")]
            start = np.append(0, np.cumsum(np.bincount(cell, minlength=width * height)))
        directions = np.ascontiguousarray(directions)
        return Hits(*_cast(self.points, self.flat, self.faces, directions, order, start, self.size))


def trace_rest(camera: Camera, surface: Shape, static: Shape) -> RestFrame:
    """Ground truth of the rest frame, from the fine surface at rest and what never moves."""
    width, height = camera.size
    pixels = cameras.pixel_grid(camera.size)
    directions = cameras.rays(camera, pixels)
    hits = ProjectedScene.of(camera, join_shapes(surface, static)).cast(None, directions)
    on_tissue = (hits.face >= 0) & (hits.face < len(surface.faces))
    face = np.where(on_tissue, hits.face, -1).astype(np.int32)
    corners = cameras.to_camera(camera, surface.vertices)[surface.faces[face[on_tissue]]]
    return RestFrame(
        tissue=on_tissue.reshape(height, width),
        area=_picture(on_tissue, _footprint(camera, corners, directions, on_tissue, hits.along), camera),
        scale_mm_per_px=camera.mm_per_px,
        face=face.reshape(height, width),
        bary=np.where(on_tissue[:, None], hits.bary, 0.0).reshape(height, width, 3),
        directions=directions,
        points=directions * np.where(on_tissue, hits.along, 0.0)[:, None],
    )


def trace_frame(camera: Camera, rest: RestFrame, surface: Shape, static: Shape, tool: Shape) -> FrameTruth:
    """Ground truth of one frame, of a camera with the lens of the rest frame: of the fine surface and the
    instruments in this frame, and what never moves."""
    width, height = camera.size
    pixels = cameras.pixel_grid(camera.size)
    scene = ProjectedScene.of(camera, join_shapes(surface, static, tool))
    hits = scene.cast(None, rest.directions)
    depth = np.where(hits.face >= 0, hits.along, 0.0)  # directions have unit z

    tissue = rest.tissue.ravel()
    points = blend(
        surface.faces, rest.face.ravel()[tissue], rest.bary.reshape(-1, 3)[tissue], surface.vertices
    )
    local = cameras.to_camera(camera, points)
    positions = cameras.to_pixels(camera, local)
    first_hits = scene.cast(positions, local)
    unhidden = (1 - first_hits.along) * lengths(local) < _HIDDEN_MM
    inside = ((positions >= -0.5) & (positions < np.array([width, height]) - 0.5)).all(axis=1)
    return FrameTruth(
        flow=_picture(tissue, positions - pixels[tissue], camera),
        motion=_picture(tissue, local - rest.points[tissue], camera),
        visible=_picture(tissue, unhidden & inside, camera, bool),
        depth=depth.reshape(height, width).astype(np.float32),
        tool=(hits.face >= len(surface.faces) + len(static.faces)).reshape(height, width),
        hits=hits,
    )


def forward_flow(hits: Hits, faces: Indices, vertices: Floats, camera: Camera) -> Map:
    """Flow (H, W, 2) px from each pixel of one frame, by its hits, the surface's faces first, to another
    frame, by the surface's vertices (V, 3) mm and the camera in it; 0 off the surface."""
    mask = (hits.face >= 0) & (hits.face < len(faces))
    points = blend(faces, hits.face[mask], hits.bary[mask], vertices)
    return _picture(mask, cameras.project(camera, points) - cameras.pixel_grid(camera.size)[mask], camera)


def normal_map(camera: Camera, hits: Hits, shapes: Sequence[Shape]) -> Map:
    """Smoothed unit normals (H, W, 3), camera axes, at hits of shapes; 0 where there is nothing."""
    vertex = np.concatenate([normals(shape) for shape in shapes]) @ camera.rotation.T
    mask = hits.face >= 0
    vectors = blend(join_shapes(*shapes).faces, hits.face[mask], hits.bary[mask], vertex)
    return _picture(mask, vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12), camera)


def at_rest_pixels(rest: RestFrame, faces: Indices, nodal: Floats) -> Map:
    """A quantity of vertices (V, C) of the fine surface at rest pixels (H, W, C); 0 off the tissue."""
    values = blend(faces, rest.face.ravel(), rest.bary.reshape(-1, 3), nodal)
    return values.reshape(*rest.face.shape, -1).astype(np.float32)


def blend(faces: Indices, face: Indices, bary: Floats, nodal: npt.NDArray[np.floating]) -> Floats:
    """A quantity of vertices (V, C) at points on triangles: indices (N,), weights (N, 3); 0 where `face` is
    negative or beyond `faces`."""
    return _blend(as_constant(faces), face, bary, np.ascontiguousarray(nodal, np.float64))


def _picture(mask: Mask, values: Array, camera: Camera, kind: type = np.float32) -> Array:
    """Values (M, ...) of the pixels in `mask` (H*W,) as a picture (H, W, ...); 0 elsewhere."""
    picture = np.zeros((len(mask), *values.shape[1:]), kind)
    picture[mask] = values
    return picture.reshape(*camera.size[::-1], *values.shape[1:])


def _footprint(camera: Camera, corners: Floats, directions: Floats, mask: Mask, along: Floats) -> Floats:
    """Area (M,) mm2 of the faces' planes in each pixel of `mask`, from the spread of its rays."""
    width, height = camera.size
    grid = cameras.pixel_grid((width + 1, height + 1)) - 0.5
    corner = cameras.rays(camera, grid).reshape(height + 1, width + 1, 3)
    across = 0.5 * ((corner[:-1, 1:] - corner[:-1, :-1]) + (corner[1:, 1:] - corner[1:, :-1]))
    down = 0.5 * ((corner[1:, :-1] - corner[:-1, :-1]) + (corner[1:, 1:] - corner[:-1, 1:]))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ray = directions[mask]
    facing = np.einsum("nc,nc->n", normal, ray)[:, None]
    sides = (across.reshape(-1, 3)[mask], down.reshape(-1, 3)[mask])
    slopes = (np.einsum("nc,nc->n", normal, side)[:, None] / facing for side in sides)
    side_a, side_b = (
        along[mask, None] * (side - ray * slope) for side, slope in zip(sides, slopes, strict=True)
    )
    return np.asarray(np.linalg.norm(np.cross(side_a, side_b), axis=1))


@argument_types("f8[:,::1], f8[:,::1], i4[:,::1], f8[:,::1], i8[::1], i8[::1], UniTuple(i8, 2)")
@compiled
def _cast(
    points: Floats, flat: Floats, faces: Indices, directions: Floats, order: Ints, start: Ints, size: Size
) -> tuple[Indices, Floats, Floats]:
    """Hits of rays (N, 3), sorted by their pixel of a picture, on triangles; see `Hits`."""
    width, height = size
    count = len(directions)
    face = np.full(count, -1, np.int32)
    bary = np.zeros((count, 3))
    best = np.full(count, np.inf)
    for f in range(len(faces)):
        a, b, c = faces[f]
        left, right = min(flat[a, 0], flat[b, 0], flat[c, 0]), max(flat[a, 0], flat[b, 0], flat[c, 0])
        top, bottom = min(flat[a, 1], flat[b, 1], flat[c, 1]), max(flat[a, 1], flat[b, 1], flat[c, 1])
        pad = min(_PAD_PX, _LEAST_PAD_PX + _PAD_SHARE * max(right - left, bottom - top))
        left, right, top, bottom = left - pad, right + pad, top - pad, bottom + pad
        # Written so that a corner behind the lens (NaN) drops the face.
        if not (right >= 0 and bottom >= 0 and left <= width - 1 and top <= height - 1):
            continue
        if np.isnan(flat[a, 0] + flat[b, 0] + flat[c, 0]):  # min and max ignore some NaN
            continue
        x0, x1 = int(max(np.ceil(left), 0)), int(min(np.floor(right), width - 1))
        y0, y1 = int(max(np.ceil(top), 0)), int(min(np.floor(bottom), height - 1))
        a0, a1, a2 = points[a]
        e0, e1, e2 = points[b, 0] - a0, points[b, 1] - a1, points[b, 2] - a2
        g0, g1, g2 = points[c, 0] - a0, points[c, 1] - a1, points[c, 2] - a2
        # With the rays' origin at the lens, all terms but the direction depend on the triangle alone.
        n0, n1, n2 = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
        offset = n0 * a0 + n1 * a1 + n2 * a2
        q0, q1, q2 = g1 * a2 - g2 * a1, g2 * a0 - g0 * a2, g0 * a1 - g1 * a0
        r0, r1, r2 = a1 * e2 - a2 * e1, a2 * e0 - a0 * e2, a0 * e1 - a1 * e0
        for y in range(y0, y1 + 1):
            for k in range(start[y * width + x0], start[y * width + x1 + 1]):
                i = order[k]
                d0, d1, d2 = directions[i, 0], directions[i, 1], directions[i, 2]
                facing = n0 * d0 + n1 * d1 + n2 * d2
                # A small tolerance at edges: rays must not slip between faces that share one.
                # Most rays miss by far more, which one branch without a division detects.
                across, down = q0 * d0 + q1 * d1 + q2 * d2, r0 * d0 + r1 * d1 + r2 * d2
                side = 1.0 if facing >= 0.0 else -1.0
                hair = _SURELY * abs(facing)
                if (side * across < -hair) | (side * down < -hair) | (side * (across + down - facing) > hair):
                    continue
                if facing == 0.0:
                    continue
                inverse = 1.0 / facing
                u = across * inverse
                if u < -1e-10 or u > 1.0 + 1e-10:
                    continue
                v = down * inverse
                if v < -1e-10 or u + v > 1.0 + 1e-10:
                    continue
                t = offset * inverse
                if t <= 0.0 or t >= best[i]:
                    continue
                best[i] = t
                bary[i, 0], bary[i, 1], bary[i, 2] = 1 - u - v, u, v
                face[i] = f
    return face, bary, best


@argument_types("Array(i4, 2, 'C', readonly=True), i4[::1], f8[:,::1], f8[:,::1]")
@compiled
def _blend(faces: Indices, face: Indices, bary: Floats, nodal: Floats) -> Floats:
    out = np.zeros((len(face), nodal.shape[1]))
    for n in range(len(face)):
        if face[n] < 0 or face[n] >= len(faces):
            continue
        a, b, c = faces[face[n]]
        u, v, w = bary[n, 0], bary[n, 1], bary[n, 2]
        for k in range(nodal.shape[1]):
            out[n, k] = u * nodal[a, k] + v * nodal[b, k] + w * nodal[c, k]
    return out
