"""Ground truth by centre rays of our own, in double precision: what each pixel sees, and where that goes.

The renderer has no part in this: triangles are cast here against the very rays of `camera`, so every label is
the same on every variant, exact at folds and edges, and in the pixels of the recorded (distorted) picture.
Intersection: T. Moeller, B. Trumbore, "Fast, minimum storage ray/triangle intersection", 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

from synth.render import camera as cameras
from synth.render.camera import Camera

Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int32]
Mask = npt.NDArray[np.bool_]

_HIDDEN_MM = 1e-3  # nearer to the lens than a point by more than this hides it
_PAD_PX = 1.5  # triangles bow a little under distortion


@dataclass(frozen=True)
class Hits:
    """First surface along each ray."""

    face: Indices
    """(N,) index of the triangle; -1 where there is none."""
    bary: Floats
    """(N, 3) weights of its corners; 0 where there is none."""
    along: Floats
    """(N,) distance in units of the ray's direction; inf where there is none."""


@dataclass(frozen=True)
class Still:
    """Truth of the rest frame."""

    tissue: Mask
    """(H, W): brain, in the opening."""
    area: npt.NDArray[np.float32]
    """(H, W) mm2: rest surface that the pixel sees; 0 off the tissue."""
    scale_mm_per_px: float
    """At the craniotomy's centre."""
    face: Indices
    """(H, W) triangle of the fine surface; -1 off the tissue."""
    bary: Floats
    """(H, W, 3)."""


@dataclass(frozen=True)
class Now:
    """Truth of one frame, at the rest frame's pixels (material points) or at the frame's own."""

    flow: npt.NDArray[np.float32]
    """(H, W, 2) px, rest pixels; 0 off the tissue."""
    visible: Mask
    """(H, W), rest pixels: the point is in the picture and nothing hides it."""
    depth: npt.NDArray[np.float32]
    """(H, W) mm along the optical axis, this frame's pixels; 0 where there is nothing."""
    tool: Mask
    """(H, W), this frame's pixels."""
    hits: Hits
    """This frame's pixels, over tissue, rim and tool, in this order."""


def cast(camera: Camera, triangles: Floats, pixels: Floats, directions: Floats) -> Hits:
    """First triangle that each ray from the lens meets.

    Args:
        camera: the camera.
        triangles: (F, 3, 3) mm, camera axes.
        pixels: (N, 2) px where the rays pierce the picture; those outside it meet nothing.
        directions: (N, 3) in camera axes, of any length, each through its pixel.
    """
    width, height = camera.size
    order, start = _bins(pixels, width, height)
    flat = np.zeros((len(triangles), 3, 2))
    front = triangles[:, :, 2].min(axis=1) > 1.0
    identity = Camera(
        camera.K, camera.distortion, np.eye(3), np.zeros(3), camera.size, 0.0, 0.0, camera.mm_per_px
    )
    flat[front] = cameras.project(identity, triangles[front].reshape(-1, 3)).reshape(-1, 3, 2)
    low = np.ceil(flat.min(axis=1) - _PAD_PX).astype(np.int64)
    high = np.floor(flat.max(axis=1) + _PAD_PX).astype(np.int64)
    face, u, v, along = _cast(
        triangles, low, high, front, np.ascontiguousarray(directions), order, start, width, height
    )
    hit = face >= 0
    bary = np.where(hit[:, None], np.stack([1 - u - v, u, v], axis=1), 0.0)
    return Hits(face, bary, along)


def still(camera: Camera, vertices: Floats, faces: Indices, rim: Floats) -> Still:
    """Truth of the rest frame.

    Args:
        camera: the camera.
        vertices: (V, 3) mm, fine surface at rest, world axes.
        faces: (F, 3).
        rim: (R, 3, 3) mm, triangles of what frames the opening, world axes.
    """
    width, height = camera.size
    tissue = cameras.to_camera(camera, vertices)[faces]
    scene = np.concatenate([tissue, _local(camera, rim)])
    pixels = cameras.pixel_grid(camera.size)
    directions = _forward(camera, pixels)
    hits = cast(camera, scene, pixels, directions)
    on_tissue = (hits.face >= 0) & (hits.face < len(faces))
    face = np.where(on_tissue, hits.face, -1).astype(np.int32)
    area = np.zeros(len(pixels), np.float32)
    area[on_tissue] = _footprint(camera, tissue[face[on_tissue]], directions, on_tissue, hits.along)
    return Still(
        tissue=on_tissue.reshape(height, width),
        area=area.reshape(height, width),
        scale_mm_per_px=camera.mm_per_px,
        face=face.reshape(height, width),
        bary=np.where(on_tissue[:, None], hits.bary, 0.0).reshape(height, width, 3),
    )


def now(
    camera: Camera, rest: Still, before: Camera, vertices: Floats, faces: Indices, rim: Floats, tool: Floats
) -> Now:
    """Truth of one frame.

    Args:
        camera: the camera of this frame.
        rest: truth of the rest frame.
        before: the camera of the rest frame.
        vertices: (V, 3) mm, fine surface in this frame, world axes.
        faces: (F, 3).
        rim: (R, 3, 3) mm, world axes.
        tool: (K, 3, 3) mm, world axes; may be empty.
    """
    width, height = camera.size
    scene = np.concatenate(
        [cameras.to_camera(camera, vertices)[faces], _local(camera, rim), _local(camera, tool)]
    )
    pixels = cameras.pixel_grid(camera.size)
    hits = cast(camera, scene, pixels, _forward(camera, pixels))
    seen = hits.face >= 0
    depth = np.where(seen, hits.along, 0.0)  # directions have unit z

    on = rest.tissue.ravel()
    points = np.einsum("nk,nkc->nc", rest.bary.reshape(-1, 3)[on], vertices[faces[rest.face.ravel()[on]]])
    local = cameras.to_camera(camera, points)
    pierced = cameras.project(camera, points)
    blocked = cast(camera, scene, pierced, local)
    clear = (1 - blocked.along) * np.linalg.norm(local, axis=1) < _HIDDEN_MM
    inside = ((pierced >= -0.5) & (pierced < np.array([width, height]) - 0.5)).all(axis=1)
    flow = np.zeros((len(pixels), 2), np.float32)
    flow[on] = pierced - pixels[on]
    visible = np.zeros(len(pixels), bool)
    visible[on] = clear & inside
    return Now(
        flow=flow.reshape(height, width, 2),
        visible=visible.reshape(height, width),
        depth=depth.reshape(height, width).astype(np.float32),
        tool=(hits.face >= len(faces) + len(rim)).reshape(height, width),
        hits=hits,
    )


def at_rest_pixels(rest: Still, faces: Indices, nodal: Floats) -> npt.NDArray[np.float32]:
    """A quantity of the fine surface's vertices (V, C) at rest pixels (H, W, C); 0 off the tissue."""
    values = np.einsum("hwk,hwkc->hwc", rest.bary, nodal[faces[rest.face]])
    return np.where(rest.tissue[..., None], values, 0.0).astype(np.float32)


def _forward(camera: Camera, pixels: Floats) -> Floats:
    """Directions (N, 3) of centre rays in camera axes with unit z, so that distance along them is depth."""
    flat = cameras.undistort((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2], camera.distortion)
    return np.concatenate([flat, np.ones((len(flat), 1))], axis=1)


def _local(camera: Camera, triangles: Floats) -> Floats:
    return cameras.to_camera(camera, triangles.reshape(-1, 3)).reshape(-1, 3, 3)


def _footprint(camera: Camera, corners: Floats, directions: Floats, on: Mask, along: Floats) -> Floats:
    """Area (M,) mm2 of the faces' planes that each pixel in `on` covers, from how the rays spread over it."""
    width, height = camera.size
    grid = cameras.pixel_grid((width + 1, height + 1)) - 0.5
    corner = _forward(camera, grid).reshape(height + 1, width + 1, 3)
    across = 0.5 * ((corner[:-1, 1:] - corner[:-1, :-1]) + (corner[1:, 1:] - corner[1:, :-1]))
    down = 0.5 * ((corner[1:, :-1] - corner[:-1, :-1]) + (corner[1:, 1:] - corner[:-1, 1:]))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ray = directions[on]
    facing = np.einsum("nc,nc->n", normal, ray)[:, None]
    spread = []
    for side in (across.reshape(-1, 3)[on], down.reshape(-1, 3)[on]):
        spread.append(along[on, None] * (side - ray * np.einsum("nc,nc->n", normal, side)[:, None] / facing))
    return np.asarray(np.linalg.norm(np.cross(*spread), axis=1))


def _bins(pixels: Floats, width: int, height: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rays sorted by the pixel they pierce: order (M,) and where each pixel's rays start (H*W + 1,)."""
    cell = np.floor(pixels + 0.5).astype(np.int64)
    inside = ((cell >= 0) & (cell < np.array([width, height]))).all(axis=1)
    key = cell[:, 1] * width + cell[:, 0]
    which = np.flatnonzero(inside)
    order = which[np.argsort(key[which], kind="stable")]
    start = np.concatenate([[0], np.cumsum(np.bincount(key[which], minlength=width * height))])
    return order, start


def _cast_loop(triangles, low, high, front, directions, order, start, width, height):  # type: ignore[no-untyped-def]
    count = len(directions)
    face = np.full(count, -1, np.int32)
    best_u, best_v = np.zeros(count), np.zeros(count)
    best = np.full(count, np.inf)
    for f in range(len(triangles)):
        if not front[f]:
            continue
        x0, x1 = max(low[f, 0], 0), min(high[f, 0], width - 1)
        y0, y1 = max(low[f, 1], 0), min(high[f, 1], height - 1)
        if x1 < x0 or y1 < y0:
            continue
        a0, a1, a2 = triangles[f, 0]
        e0, e1, e2 = triangles[f, 1, 0] - a0, triangles[f, 1, 1] - a1, triangles[f, 1, 2] - a2
        g0, g1, g2 = triangles[f, 2, 0] - a0, triangles[f, 2, 1] - a1, triangles[f, 2, 2] - a2
        # With the ray's origin at the lens, everything but the direction is the triangle's own.
        n0, n1, n2 = e1 * g2 - e2 * g1, e2 * g0 - e0 * g2, e0 * g1 - e1 * g0
        offset = n0 * a0 + n1 * a1 + n2 * a2
        q0, q1, q2 = g1 * a2 - g2 * a1, g2 * a0 - g0 * a2, g0 * a1 - g1 * a0
        r0, r1, r2 = a1 * e2 - a2 * e1, a2 * e0 - a0 * e2, a0 * e1 - a1 * e0
        for y in range(y0, y1 + 1):
            for k in range(start[y * width + x0], start[y * width + x1 + 1]):
                i = order[k]
                d0, d1, d2 = directions[i]
                facing = n0 * d0 + n1 * d1 + n2 * d2
                if facing == 0.0:
                    continue
                t = offset / facing
                if t <= 0.0 or t >= best[i]:
                    continue
                u = (q0 * d0 + q1 * d1 + q2 * d2) / facing
                v = (r0 * d0 + r1 * d1 + r2 * d2) / facing
                # A hair over the edge still counts: rays through shared edges must not slip between faces.
                if u < -1e-10 or v < -1e-10 or u + v > 1.0 + 1e-10:
                    continue
                best[i] = t
                best_u[i] = u
                best_v[i] = v
                face[i] = f
    return face, best_u, best_v, best


_cast = numba.njit(cache=True)(_cast_loop)
