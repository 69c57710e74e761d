"""The volume mesh: graded tetrahedra of a block or of a user's brain, and the skull's hold on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import scipy.sparse as sp

from synth.arrays import Floats, Ints, Mask
from synth.errors import UserError
from synth.fem.mesh import winding
from synth.fem.mesh.attachments import FIRM_PER_MM, springs
from synth.fem.mesh.element import TRI_POINTS, TRI_WEIGHTS, bary_slope, scatter, shape
from synth.fem.mesh.fit import fit
from synth.fem.mesh.lattice_stuffing import stuff
from synth.fem.mesh.mesh_relief import HeightMap, raise_top
from synth.fem.mesh.refine import edges_of, refine
from synth.geometry.brain_surface import Brain
from synth.geometry.skull import Attachment

Contact = tuple[float, float, float]
"""World x, y of a contact's centre and its radius, mm."""

BLOCK_MM = 100.0, 100.0, 60.0
"""Width, height, depth of a procedural block; below 70 mm the fixed walls would take 10-16% of the peak."""
RIM_MM = 3.0
"""Width over which the skull's hold on the brain grows from none in the opening to firm."""
_EVEN = 0.5  # part of a contact's radius under which elements have one size
_DEPTH = 1.5  # weight of depth against distance: strain fades faster downwards than sideways
_ALL_MM = 25.0  # lattice this near to the opening is refined inside and outside alike
_FLAT = 0.8  # part of the dome's radius up to which it is round; level beyond (under the skull)
_KUHN = np.array([[0, 1, 3, 7], [0, 5, 1, 7], [0, 3, 2, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 6, 4, 7]])
"""Six tetrahedra of a cube with corners numbered x + 2y + 4z, round its diagonal."""

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the four faces of a tetrahedron, each opposite its corner, counter-clockwise from outside."""

_MIDSIDES = np.array([[7, 8, 9], [6, 5, 9], [4, 6, 8], [5, 4, 7]])


@dataclass(frozen=True)
class Tets:
    """A meshed brain, in world axes."""

    points: Floats  # (N, 3) mm: corners first, then nodes on the edges, in their middle but for curved ones
    cells: Ints  # (M, 10), positively oriented; midsides in the order of `refine.EDGES`
    fixed: Mask  # (N,) nodes that cannot move: the walls a block is cut out at
    hold: sp.csr_array  # (N, N) mm, for E = 1 kPa: springs of the skull and of attachments
    slip: sp.csr_array | None = None  # (3N, 3N) mm: springs along the normal alone, where tissue slips


def block(
    tets: int,
    focus: Sequence[Contact] = (),
    height: HeightMap | None = None,
    *,
    opening_mm: float = 12.0,
    dome_mm: float = 70.0,
    attachments: Sequence[Attachment] = (),
    slips: bool = False,
    size_mm: tuple[float, float, float] = BLOCK_MM,
) -> Tets:
    """A domed block, fixed at its sides and bottom, held by the skull around the opening.

    Args:
        tets: about how many tetrahedra, finest under the contacts.
        focus: contacts; the whole opening if none.
        height: of the surface over opening and rim; None: the bare dome.
        opening_mm: radius of the opening in the skull.
        dome_mm: radius of curvature of the surface.
        attachments: regions inside in which the tissue is fixed too, world axes.
        slips: along the skull, rather than bonded to it.
        size_mm: width, height, depth.

    Raises:
        UserError: too round a dome; an attachment holds nothing.
    """
    size = np.asarray(size_mm)
    fall = -dome(np.array([size[:2] / 2]), dome_mm)[0]
    if fall > 0.8 * size[2]:
        fault = f"the dome falls by {fall:.0f} mm, too much for a block of {size[2]:g} mm depth"
        raise UserError(f"anatomy.dome_mm: {fault}")
    points, cells = bricks(size, tets / 60)
    points, cells = refine(points, cells, _grading(opening_mm, focus), tets)
    wall = (np.abs(np.abs(points[:, :2]) - size[:2] / 2) < 1e-9).any(axis=1) | (points[:, 2] < 1e-9 - size[2])
    points, cells = with_midsides(points, cells)
    faces, ground = boundary(cells), partial(dome, radius_mm=dome_mm)
    top = faces[(points[faces, 2] > -1e-9).all(axis=1)]
    points = raise_top(points, cells, top, ground, ground if height is None else height.blend_into(ground))
    # A face is on a wall if its three corners are; the upper edge of the walls belongs to both.
    return _hold(points, cells, wall, opening_mm, attachments, slips)


def from_brain(
    brain: Brain,
    tets: int,
    focus: Sequence[Contact] = (),
    *,
    opening_mm: float = 12.0,
    slips: bool = False,
) -> Tets:
    """A user's whole brain, held by the skull everywhere but in the opening; arguments as in `block`.

    UserError: the surface encloses no volume that can be meshed, or none under the opening; an attachment
    holds nothing.
    """
    points, cells = _fill(brain, _grading(opening_mm, focus), tets)
    if len(cells) < 0.2 * tets:
        raise UserError("anatomy.mesh: the surface encloses no volume that tetrahedra fit into")
    top = points[np.hypot(points[:, 0], points[:, 1]) < opening_mm, 2].max(initial=-np.inf)
    if top < -opening_mm:
        raise UserError("anatomy.craniotomy: there is no volume under the opening")
    points, cells = with_midsides(points, cells)
    return _hold(points, cells, np.zeros(len(points), bool), opening_mm, brain.attachments, slips)


def dome(xy: Floats, radius_mm: float) -> Floats:
    """Height of the procedural brain's surface, (n,) mm, at (n, 2) mm; 0 at the craniotomy's centre."""
    reach = np.minimum((xy**2).sum(axis=1), (_FLAT * radius_mm) ** 2)
    return np.asarray(np.sqrt(radius_mm**2 - reach) - radius_mm)


def with_midsides(points: Floats, cells: Ints) -> tuple[Floats, Ints]:
    """Adds the midside nodes: cells (M, 4) become (M, 10)."""
    pairs, cell_edges = edges_of(cells)
    return np.vstack([points, points[pairs].mean(axis=1)]), np.hstack([cells, len(points) + cell_edges])


def boundary(cells: Ints) -> Ints:
    """Faces with one tetrahedron, counter-clockwise from outside.

    (F, 3) corners of cells (M, 4); of cells (M, 10) also midsides 01, 02, 12, (F, 6).
    """
    owner, apex = outer_faces(cells)
    local = FACES if cells.shape[1] == 4 else np.hstack([FACES, _MIDSIDES])
    return np.asarray(cells[owner[:, None], local[apex]])


def outer_faces(cells: Ints) -> tuple[Ints, Ints]:
    """Tetrahedra (F,) of the faces with one tetrahedron, and their corners (F,) that are off these faces."""
    key = np.sort(cells[:, FACES].reshape(-1, 3), axis=1)
    _, first, count = np.unique(key, axis=0, return_index=True, return_counts=True)
    outer = np.sort(first[count == 1])
    return outer // 4, outer % 4


def _grading(opening_mm: float, focus: Sequence[Contact]) -> Callable[[Floats], Floats]:
    """Wanted size: constant under the contacts (or the opening), growing with the distance from them.

    Measured: growth in proportion to the distance, a constant size over half the contact's radius and depth
    counting 1.5 times give the smallest error; a focus under the contact gives a third of the error of one
    under the whole opening.
    """

    def size(xyz: Floats) -> Floats:
        if not focus:
            distance = np.maximum(np.hypot(xyz[:, 0], xyz[:, 1]) - opening_mm, 0)
            return np.asarray((1 + np.hypot(distance, xyz[:, 2]) / (0.5 * opening_mm)) ** 2)
        depth_sq = (_DEPTH * xyz[:, 2]) ** 2
        distances = [np.sqrt((xyz[:, 0] - x) ** 2 + (xyz[:, 1] - y) ** 2 + depth_sq) for x, y, _ in focus]
        sizes = [np.maximum(_EVEN * a, distance) for distance, (*_, a) in zip(distances, focus, strict=True)]
        return np.asarray(np.min(sizes, axis=0))

    return size


def bricks(size: Floats, count: float) -> tuple[Floats, Ints]:
    """A box cut into about `count` near-cubes of six tetrahedra each, z from -depth to 0."""
    edge = float((size.prod() / max(count, 2)) ** (1 / 3))
    n = np.maximum(np.round(size / edge).astype(int), 1)
    n[:2] += n[:2] % 2  # the opening's centre on a corner, not in the middle of a brick
    axes = [np.linspace(-size[i] / 2, size[i] / 2, n[i] + 1) for i in (0, 1)]
    axes.append(np.linspace(-size[2], 0, n[2] + 1))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    node_grid = np.arange(len(grid)).reshape(n + 1)
    corners = product((0, 1), repeat=3)
    cube = [node_grid[x : x + n[0], y : y + n[1], z : z + n[2]].ravel() for z, y, x in corners]
    cells = np.stack(cube, axis=1)[:, _KUHN].reshape(-1, 4)
    volume = bary_slope(grid[cells])[1]
    cells[volume < 0] = cells[volume < 0][:, [0, 2, 1, 3]]
    return grid, cells


def _fill(brain: Brain, grading: Callable[[Floats], Floats], tets: int) -> tuple[Floats, Ints]:
    """Graded tetrahedra inside a surface, about as many as wanted after up to four tries."""
    winding_number = winding.prepare(*brain.shape)
    low, high = brain.shape.vertices.min(axis=0), brain.shape.vertices.max(axis=0)
    size = 1.1 * (high - low)

    def grade(xyz: Floats) -> Floats:
        """The grading, coarser well outside the surface, where refining gains nothing."""
        is_outside = winding_number(xyz) < 0.01
        is_far = np.linalg.norm(xyz, axis=1) > _ALL_MM
        return np.asarray(grading(xyz) * np.where(is_outside & is_far, 4.0, 1.0))

    lattice = 2 * tets
    for _ in range(4):
        points, cells = bricks(size, lattice / 18)
        points += 0.5 * (low + high) + [0, 0, 0.5 * size[2]]
        points, cells = refine(points, cells, grade, lattice)
        points, cells = stuff(points, cells, lambda xyz: winding_number(xyz) - 0.5)
        if 0.9 * tets <= len(cells) <= 1.1 * tets or len(cells) == 0:
            break
        lattice = int(lattice * tets / len(cells))
    if len(cells):
        points = fit(points, cells, boundary(cells), lambda xyz: winding_number(xyz) - 0.5)
    return points, cells


def _hold(
    points: Floats,
    cells: Ints,
    wall: Mask,
    opening_mm: float,
    attachments: Sequence[Attachment],
    slips: bool,
) -> Tets:
    """The mesh with what holds it: nodes (N,) on a wall, the skull around the opening, attachments."""
    faces = boundary(cells)
    on_wall = wall[faces[:, :3]].all(axis=1)
    fixed = np.zeros(len(points), bool)
    fixed[faces[on_wall]] = True
    bonded, slip = _springs(points, faces[~on_wall], opening_mm, slips)
    hold = bonded + springs(points, cells, attachments)
    return Tets(points, cells, fixed, sp.csr_array(hold), slip)


def _springs(
    points: Floats, faces: Ints, opening_mm: float, slips: bool
) -> tuple[sp.csr_array, sp.csr_array | None]:
    """The skull's springs on the surface, which grow over the rim's width from none in the opening to firm:
    (N, N) mm of those that hold in every direction, and (3N, 3N) mm of those along the normal alone. Deep
    below, where nerves and vessels tether the brain, all hold in every direction."""
    corner = points[faces[:, :3]]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = 0.5 * np.linalg.norm(facing, axis=1)
    place = np.einsum("qc,fcd->fqd", TRI_POINTS, corner)
    rim_distance = np.hypot(place[..., 0], place[..., 1]) - opening_mm
    firmness = np.clip(rim_distance / RIM_MM, 0, 1)
    # Deep below lies the far side of the brain, which no opening exposes.
    deep = place[..., 2] < -2 * opening_mm
    firmness[deep] = 1
    value = shape(TRI_POINTS)
    stiffness = FIRM_PER_MM * firmness * firmness * (3 - 2 * firmness) * area[:, None] * TRI_WEIGHTS

    def gather(part: Floats) -> sp.csr_array:
        return scatter(np.einsum("fq,qi,qj->fij", part, value, value), faces, len(points))

    if not slips:
        return gather(stiffness), None
    normal = facing / (2 * area)[:, None]
    slip = sp.csr_array((3 * len(points),) * 2)
    for i, j in product(range(3), repeat=2):
        unit = np.zeros((3, 3))
        unit[i, j] = 1
        part = np.where(deep, 0, stiffness) * (normal[:, i] * normal[:, j])[:, None]
        slip = slip + sp.kron(gather(part), unit, format="csr")
    return gather(np.where(deep, stiffness, 0)), sp.csr_array(slip)
