"""A rigid tip on soft tissue: unilateral contact with Coulomb friction, condensed to where the two may meet.

The skin under a tip is divided into P overlapping patches. With y their mean displacement, f the forces on
them and C their compliance by the stiffness at rest,

    y = y0 + C f,    f = f(y - d),    W' f = Q,

y0 being what all else does (other loads, the law's nonlinear part), d the tip's displacement, which is free
along the axes W, where the force Q is given. The contact's law f is stiff springs (penalty): pressure in
proportion to
penetration, none in tension; along the surface a spring up to Coulomb's limit, held between steps by an
anchor (return mapping: Simo & Laursen, Comput. Struct. 42, 1992; Wriggers, Computational Contact Mechanics,
2006,
ch. 5). Solved by a semi-smooth Newton method, each of whose steps is over the patches in contact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem.equilibrium import NoEquilibrium
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System
from synth.job.law_limits import SPHERE

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]

EDGE = 0.25
"""A flat tip's edge is rounded by this part of its radius."""
_CONE = 0.7  # of the rounding's height; above it the tip goes on nearly straight, as a cone
_SPRING = 200.0  # times E/a: what it adds to the depth of a flat tip is 0.76 E/a over it, 0.4%
_NEAR = 0.03  # times a: how deep a tip that has to press, but touches nothing, is set
_ITERATIONS, _LENGTHS = 60, (1.0, 0.5, 0.25, 0.1)
_WORSE = 0.95  # of an error is what a step has to leave at most, or it is shortened
_AT_ONCE = 24  # loads
_CLOSE = 1e-9  # of the tip's radius (gaps) and of the load (forces)


SPREAD = np.outer([1 / 6, 2 / 3, 1 / 6], [1 / 6, 2 / 3, 1 / 6]).ravel()
"""(9,) weights of the places that stand for a patch: Gauss and Hermite's rule, three by three."""


@dataclass(frozen=True)
class Tip:
    """A rigid tip of revolution: flat up to a radius, its edge rounded. A sphere is edge alone.

    Its axes: origin at its lowest point, z towards the hand.
    """

    flat_mm: float
    edge_mm: float
    radius_mm: float
    """a, about how wide it touches when it presses hardest: what the contact's springs go by."""

    @classmethod
    def named(cls, shape: str, radius_mm: float) -> Tip:
        """Of a contact's radius a: `flat`, its edge rounded by `EDGE` a, or `sphere`, of radius `SPHERE`
        a."""
        if shape == "sphere":
            return cls(0.0, SPHERE * radius_mm, radius_mm)
        return cls((1 - EDGE) * radius_mm, EDGE * radius_mm, radius_mm)

    def gap(self, at: Floats) -> tuple[Floats, Floats, Floats]:
        """Distance from the tip.

        Args:
            at: (n, 3) mm in the tip's axes.

        Returns:
            (n,) mm, negative inside; its gradient (n, 3), which points away from the tip; the gradient's
            derivative (n, 3, 3) 1/mm.
        """
        aside = np.hypot(at[:, 0], at[:, 1])
        beyond = np.maximum(aside - self.flat_mm, 0.0)
        level = np.minimum(at[:, 2], _CONE * self.edge_mm)
        down = self.edge_mm - level
        off = np.hypot(beyond, down)
        out = at[:, :2] / np.maximum(aside, 1e-12)[:, None]
        normal = np.column_stack([out * (beyond / off)[:, None], -down / off])
        gap = off - self.edge_mm + normal[:, 2] * (at[:, 2] - level)
        # Principal curvatures: across the rounding 1/off, round the axis beyond/(off aside).
        along = np.column_stack([out * (-down / off)[:, None], -beyond / off])
        around = np.column_stack([-out[:, 1], out[:, 0], np.zeros(len(at))])
        bend = np.where(beyond > 0, 1 / off, 0.0)[:, None, None] * along[:, :, None] * along[:, None]
        hoop = beyond / (off * np.maximum(aside, 1e-12))
        return gap, normal, bend + hoop[:, None, None] * around[:, :, None] * around[:, None]


def mean_gap(tip: Tip, at: Floats, offsets: Floats) -> tuple[Floats, Floats, Floats]:
    """`Tip.gap` as a patch has it, in the mean.

    Args:
        tip: its shape.
        at: (n, 3) mm, the patches' middles in the tip's axes.
        offsets: (n, 9, 3) mm, as `Patches.offsets`, in the tip's axes.

    Returns:
        As `Tip.gap`; the gradient is not quite of length 1.
    """
    parts = tip.gap((at[:, None] + offsets).reshape(-1, 3))
    gap, normal, bend = (part.reshape(len(at), 9, *part.shape[1:]) for part in parts)
    return gap @ SPREAD, np.einsum("s,psi->pi", SPREAD, normal), np.einsum("s,psij->pij", SPREAD, bend)


@dataclass(frozen=True, eq=False)
class Patches:
    """P places of the skin at rest that a tip may touch: tents on a square grid, which add up to 1."""

    share: sp.csr_array
    """(P, S) mm^2: how much of each of S vertices' areas is a patch's."""
    vertices: NDArray[np.int64]
    """(S,) which of the skin's they are."""
    rest: Floats
    """(P, 3) mm, their middles."""
    carry: Embedding
    """Of the S vertices."""
    offsets: Floats
    """(P, 9, 3) mm from there: places that stand for a patch's spread, weighted by `SPREAD`."""
    owner: NDArray[np.int64]
    """(P,) whose tip it is that may touch them."""

    @property
    def area(self) -> Floats:
        """(P,) mm^2."""
        return np.asarray(self.share.sum(axis=1))

    def move(self, u: Floats) -> Floats:
        """Mean displacement (P, 3) mm, from the nodes' (N, 3) mm."""
        return np.asarray((self.share @ self.carry.move(u)) / self.area[:, None])

    def gather(self, force: Floats) -> Floats:
        """Nodal forces (N, 3, ...) mN from those on the patches, (P, 3, ...) mN; the transpose of `move`."""
        flat = (force.T / self.area).T.reshape(len(force), -1)
        return self.carry.gather((self.share.T @ flat).reshape(-1, *force.shape[1:]))

    def traction(self, force: Floats, area: Floats) -> Floats:
        """(S, 3) kPa at the vertices from (P, 3) mN; `area` (V,) mm^2 is the whole skin's."""
        each = self.share.T @ (force / self.area[:, None])
        return np.asarray(each / area[self.vertices, None])


def divide(
    carry: Embedding,
    vertices: Floats,
    area: Floats,
    places: Floats,
    reach_mm: float,
    spacing_mm: float,
    owner: int = 0,
) -> Patches:
    """Patches of the skin within reach of some places.

    Args:
        carry: the skin on the volume.
        vertices: (V, 3) mm at rest.
        area: (V,) mm^2.
        places: (n, 2) world x, y, mm.
        reach_mm: how far from them a tip may touch.
        spacing_mm: of the patches.
        owner: the tip's number.

    Raises:
        UserError: fewer than 3 vertices are within reach.
    """
    around = reach_mm + 1.5 * spacing_mm
    seen = np.flatnonzero(_away(vertices[:, :2], places) <= around)
    if len(seen) < 3:
        raise UserError(
            f"fem.footprint_mm: a tip of {reach_mm:.2g} mm touches fewer than 3 vertices of the surface; "
            "raise it, or anatomy.vertices"
        )
    spot = vertices[seen, :2] / spacing_mm
    low = np.floor(spot).astype(np.int64)
    part = spot - low
    corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    tent = np.where(corners == 1, part[:, None], 1 - part[:, None]).prod(axis=2)
    grid, patch = np.unique((low[:, None] + corners).reshape(-1, 2), axis=0, return_inverse=True)
    value = (tent * area[seen, None]).ravel()
    share = sp.coo_array((value, (patch.ravel(), np.repeat(np.arange(len(seen)), 4)))).tocsr()
    share = share[(_away(spacing_mm * grid, places) <= reach_mm) & (share.sum(axis=1) > 0)]
    own = Embedding(carry.value[seen], carry.corner[seen], carry.mean, carry.spin, carry.arm[seen])
    rest = np.asarray((share @ vertices[seen]) / share.sum(axis=1)[:, None])
    offsets = _spread(share, vertices[seen], rest)
    return Patches(sp.csr_array(share), seen, rest, own, offsets, np.full(len(rest), owner))


def _away(at: Floats, places: Floats) -> Floats:
    """Distance (n,) of points (n, 2) from the nearest of some places (m, 2)."""
    return np.asarray(np.min([np.hypot(*(at - place).T) for place in places], axis=0))


def _spread(share: sp.csr_array, vertices: Floats, rest: Floats) -> Floats:
    """Places (P, 9, 3) mm about patches' middles with the patches' own second moments, in the skin's
    slope."""
    weight = share.sum(axis=1)
    pairs = (vertices[:, :, None] * vertices[:, None]).reshape(-1, 9)
    moment = (share @ pairs / weight[:, None]).reshape(-1, 3, 3) - rest[:, :, None] * rest[:, None]
    size = np.sqrt(np.maximum(moment[:, [0, 1], [0, 1]], 1e-12))
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    flat = np.sqrt(3.0) * steps * size[:, None]
    slope = np.linalg.solve(moment[:, :2, :2] + 1e-9 * np.eye(2), moment[:, :2, 2:])
    return np.concatenate([flat, flat @ slope], axis=2)


def _without_slivers(share: sp.csr_array, least_mm2: float) -> sp.csr_array:
    """Patches at the edge that are hardly any are left out; the others divide their vertices among them."""
    whole = np.asarray(share.sum(axis=0))
    kept = share[np.flatnonzero(share.sum(axis=1) > least_mm2)]
    left = np.asarray(kept.sum(axis=0))
    scale = np.divide(whole, left, out=np.zeros_like(whole), where=left > 1e-12 * whole.max())
    return sp.csr_array(kept @ sp.diags_array(scale))


@dataclass(frozen=True, eq=False)
class Condensed:
    """What forces on all patches do to the nodes and to the patches, by the stiffness at rest, for E = 1
    kPa."""

    patches: tuple[Patches, ...]
    """One set a tip."""
    response: Floats
    """(3 P, 3 N) mm/mN."""
    compliance: Floats
    """(3 P, 3 P) mm/mN."""

    @property
    def owner(self) -> NDArray[np.int64]:
        """(P,) which tip may touch each patch."""
        return np.concatenate([one.owner for one in self.patches])

    @property
    def area(self) -> Floats:
        """(P,) mm^2."""
        return np.concatenate([one.area for one in self.patches])

    @property
    def rest(self) -> Floats:
        """(P, 3) mm."""
        return np.concatenate([one.rest for one in self.patches])

    @property
    def offsets(self) -> Floats:
        """(P, 9, 3) mm."""
        return np.concatenate([one.offsets for one in self.patches])

    def move(self, u: Floats) -> Floats:
        """As `Patches.move`, of all sets."""
        return np.concatenate([one.move(u) for one in self.patches])

    def pushed(self, force: Floats) -> Floats:
        """Displacement (N, 3) mm under (P, 3) mN, by the linear law."""
        on = np.flatnonzero(force.ravel())
        return np.asarray((force.ravel()[on] @ self.response[on]).reshape(-1, 3))

    def gather(self, force: Floats) -> Floats:
        """As `Patches.gather`, of all sets."""
        ends = np.cumsum([len(one.owner) for one in self.patches])[:-1]
        parts = zip(self.patches, np.split(force, ends), strict=True)
        return np.asarray(np.sum([one.gather(f) for one, f in parts], axis=0))


def condense(system: System, patches: tuple[Patches, ...]) -> Condensed:
    """Solves for a unit force on every patch along every axis."""
    response = []
    for one in patches:
        count = len(one.owner)
        unit = np.eye(3 * count).reshape(count, 3, 3 * count)
        # So many at once that they stay in the cache.
        for part in np.array_split(unit, np.ceil(3 * count / _AT_ONCE), axis=2):
            response.append(system.solve(one.gather(part)).reshape(-1, part.shape[2]).T)
    whole = np.ascontiguousarray(np.concatenate(response))
    found = Condensed(patches, whole, np.zeros(0))
    moved = np.stack([found.move(row.reshape(-1, 3)).ravel() for row in whole])
    return replace(found, compliance=0.5 * (moved + moved.T))


@dataclass(frozen=True)
class Pose:
    """Where a tip is and what drives it."""

    tip: Tip
    friction: float
    origin: Floats
    """(3,) mm, of its axes."""
    turn: Floats
    """(3, 3) its axes as rows, in world axes."""
    free: Floats
    """(3, k) unit vectors, world: along them it moves until `force` is met; k = 0: it stays where it is."""
    force: Floats
    """(k,) mN on the tissue along them, for E = 1 kPa."""


@dataclass(frozen=True)
class Hold:
    """What the contact keeps from step to step, in the tips' axes."""

    touching: Flags
    """(P,)."""
    anchor: Floats
    """(P, 3) mm, where a touching patch's spring along the surface has no force."""
    place: Floats
    """(P, 3) mm, where all patches were."""
    gap: Floats
    """(P,) mm from their tip; infinite while it is away."""

    @classmethod
    def none(cls, count: int) -> Hold:
        return cls(np.zeros(count, bool), np.zeros((count, 3)), np.zeros((count, 3)), np.full(count, np.inf))


@dataclass(frozen=True)
class Touch:
    """A solved contact."""

    moved: Floats
    """(P, 3) mm, of the patches."""
    force: Floats
    """(P, 3) mN on the patches, for E = 1 kPa, world axes."""
    drive: tuple[Floats, ...]
    """(k,) mm, what each tip has moved along its free axes."""
    hold: Hold
    """For the next step."""


def touch(
    solid: Condensed,
    poses: tuple[Pose | None, ...],
    y0: Floats,
    hold: Hold,
    drive: tuple[Floats, ...],
    start: Floats | None = None,
) -> Touch:
    """Solves the contact.

    Args:
        solid: the tissue.
        poses: of the tips; None: away.
        y0: (P, 3) mm, displacement of the patches without the tips.
        hold: from the step before.
        drive: (k,) mm a tip, where to begin.
        start: (P, 3) mm, where to begin with the patches; empty: without contact.

    Raises:
        NoEquilibrium: Newton's method has not settled.
    """
    meeting = _Meeting(solid, poses, hold)
    y, q = y0 if start is None else start, np.concatenate([np.zeros(0), *drive])
    q, force, slope = meeting.forces(y, q)
    error = meeting.error(y0, y, force)
    for _ in range(_ITERATIONS):
        if error <= 1:
            return meeting.result(y, q, force)
        new, dq = meeting.newton(y0, y, force, slope)
        dy = y0 + (solid.compliance @ new.ravel()).reshape(-1, 3) - y
        trials = []
        for length in _LENGTHS:
            at = y + length * dy
            by, force, slope = meeting.forces(at, q + length * dq)
            trials.append((meeting.error(y0, at, force), at, by, force, slope))
            if trials[-1][0] < _WORSE * error:
                break
        else:
            trials.sort(key=lambda t: t[0])
        error, y, q, force, slope = trials[-1] if trials[-1][0] < _WORSE * error else trials[0]
    raise NoEquilibrium("the contact between tip and tissue does not settle")


class _Meeting:
    """Tips and tissue of one step: forces, their derivatives, what is out of balance."""

    def __init__(self, solid: Condensed, poses: tuple[Pose | None, ...], hold: Hold) -> None:
        self._solid, self._poses, self._hold = solid, poses, hold
        self._rest, self._area, self._offsets = solid.rest, solid.area, solid.offsets
        self._own = [np.flatnonzero(solid.owner == k) for k in range(len(poses))]
        widths = [0 if pose is None else pose.free.shape[1] for pose in poses]
        ends = np.cumsum([0, *widths])
        self._columns = [slice(a, b) for a, b in pairwise(ends)]
        self._axes = np.zeros((len(self._rest), 3, int(ends[-1])))
        self._asked = np.zeros(int(ends[-1]))
        for own, pose, columns in zip(self._own, poses, self._columns, strict=True):
            if pose is not None:
                self._axes[own, :, columns] = pose.free
                self._asked[columns] = pose.force
        self._size = max([p.tip.radius_mm for p in poses if p is not None], default=1.0)
        self._load = float(np.abs(self._asked).max(initial=0.0))

    def _seen(self, k: int, pose: Pose, y: Floats, q: Floats) -> Floats:
        """The k-th tip's patches in its axes, (n, 3) mm."""
        moved = pose.origin + pose.free @ q[self._columns[k]]
        return np.asarray((self._rest[self._own[k]] + y[self._own[k]] - moved) @ pose.turn.T)

    def _gap(self, k: int, pose: Pose, at: Floats) -> tuple[Floats, Floats, Floats]:
        """Mean over the k-th tip's patches of `Tip.gap`, their middles being at (n, 3) mm in its axes."""
        return mean_gap(pose.tip, at, self._offsets[self._own[k]] @ pose.turn.T)

    def forces(self, y: Floats, q: Floats) -> tuple[Floats, Floats, Floats]:
        """Forces on the patches (P, 3) mN and their derivative by the patches' places (P, 3, 3) mN/mm.

        A tip that has to press, but touches nothing, is moved until it does: the first that is given back is
        the drive with that in it.
        """
        force, slope = np.zeros_like(self._rest), np.zeros((len(self._rest), 3, 3))
        for k, pose in enumerate(self._poses):
            if pose is None:
                continue
            own = self._own[k]
            at = self._seen(k, pose, y, q)
            gap, normal, bend = self._gap(k, pose, at)
            if pose.free.shape[1] and gap.min() >= 0:
                way = -pose.free.T @ pose.turn[2]
                q = q.copy()
                q[self._columns[k]] += (gap.min() + _NEAR * pose.tip.radius_mm) * way / (way @ way)
                at = self._seen(k, pose, y, q)
                gap, normal, bend = self._gap(k, pose, at)
            on = np.flatnonzero(gap < 0)
            spring = _SPRING / pose.tip.radius_mm * self._area[own[on]]
            f, d = _press(gap[on], normal[on], bend[on], spring, self._area[own[on]])
            if pose.friction:
                slid, part = self._slid(k, pose, on, at)
                pressing = np.linalg.norm(f, axis=1)
                rub, d_rub = _rub(slid, part, _unit(normal[on]), pressing, spring, pose.friction)
                f, d = f + rub, d + d_rub
            force[own[on]] = f @ pose.turn
            slope[own[on]] = pose.turn.T @ d @ pose.turn
        return q, force, slope

    def _slid(self, k: int, pose: Pose, on: NDArray[np.int64], at: Floats) -> tuple[Floats, Floats]:
        """What springs along the surface are stretched by (n, 3) mm, and its derivative by the place (n,).

        What was not in touch a step ago is taken to have been for half of it.
        """
        which = self._own[k][on]
        held, known = self._hold.touching[which], np.isfinite(self._hold.gap[which])
        start = np.where(held[:, None], self._hold.anchor[which], self._hold.place[which])
        first = (self._rest[which] - pose.origin) @ pose.turn.T
        part = np.where(held, 1.0, 0.5)
        return part[:, None] * (at[on] - np.where(known[:, None], start, first)), part

    def error(self, y0: Floats, y: Floats, force: Floats) -> float:
        """The larger of the patches' misfit and the force's, in tolerances: 1 is good."""
        misfit = np.abs(self._misfit(y0, y, force)).max() / self._size
        amiss = np.abs(self._amiss(force)).max(initial=0.0) / max(self._load, 1e-300)
        return float(max(misfit, amiss) / _CLOSE)

    def _misfit(self, y0: Floats, y: Floats, force: Floats) -> Floats:
        return np.asarray(y0 + (self._solid.compliance @ force.ravel()).reshape(-1, 3) - y)

    def _amiss(self, force: Floats) -> Floats:
        return np.asarray(self._asked - np.einsum("pik,pi->k", self._axes, force))

    def newton(self, y0: Floats, y: Floats, force: Floats, slope: Floats) -> tuple[Floats, Floats]:
        """Forces (P, 3) mN and change of the drive (k,) mm of one step, over the patches in contact."""
        on = np.flatnonzero(slope.any(axis=(1, 2)))
        n, free = 3 * len(on), self._axes.shape[2]
        dof = (3 * on[:, None] + np.arange(3)).ravel()
        near = self._solid.compliance[np.ix_(dof, dof)].reshape(n, len(on), 3)
        d, axes = slope[on], self._axes[on]
        pushed = np.einsum("api,pij->apj", near, d)
        d_axes = d @ axes
        whole = np.zeros((n + free, n + free))
        whole[:n, :n] = np.eye(n) - pushed.reshape(n, n)
        whole[:n, n:] = np.einsum("api,pik->ak", pushed, axes)
        whole[n:, :n] = np.einsum("pik,pij->kpj", axes, d).reshape(free, n)
        whole[n:, n:] = -np.einsum("pik,pil->kl", axes, d_axes)
        right = np.append(self._misfit(y0, y, force)[on].ravel(), self._amiss(force))
        try:
            step = np.linalg.solve(whole, right)
        except np.linalg.LinAlgError:
            raise NoEquilibrium("the contact between tip and tissue does not settle") from None
        dq = step[n:]
        new = force.copy()
        new[on] += np.einsum("pij,pj->pi", d, step[:n].reshape(-1, 3) - axes @ dq)
        return new, np.asarray(dq, np.float64)

    def result(self, y: Floats, q: Floats, force: Floats) -> Touch:
        """The step's end: patches that slip take their anchors with them."""
        count = len(self._rest)
        touching, gap = np.zeros(count, bool), np.full(count, np.inf)
        anchor, place = np.zeros((count, 3)), np.zeros((count, 3))
        for k, pose in enumerate(self._poses):
            if pose is None:
                continue
            own = self._own[k]
            place[own] = self._seen(k, pose, y, q)
            gap[own], normal, _ = self._gap(k, pose, place[own])
            normal = _unit(normal)
            touching[own] = gap[own] < 0
            seen = force[own] @ pose.turn.T
            along = seen - np.einsum("pi,pi->p", seen, normal)[:, None] * normal
            spring = _SPRING / pose.tip.radius_mm * self._area[own]
            anchor[own] = place[own] + along / spring[:, None]
        drive = tuple(q[columns] for columns in self._columns)
        return Touch(y, force, drive, Hold(touching, anchor, place, gap))


def _unit(vectors: Floats) -> Floats:
    """Of (n, 3)."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _press(gap: Floats, normal: Floats, bend: Floats, spring: Floats, area: Floats) -> tuple[Floats, Floats]:
    """Normal forces (n, 3) mN of patches inside the tip, and their derivative (n, 3, 3) mN/mm.

    In the derivative pressure is at most E, or a tip that starts too deep would throw tissue aside.
    """
    size = np.minimum(-gap * spring, area)
    slope = size[:, None, None] * bend - spring[:, None, None] * normal[:, :, None] * normal[:, None]
    return (-gap * spring)[:, None] * normal, slope


def _rub(
    slid: Floats, part: Floats, normal: Floats, pressing: Floats, spring: Floats, friction: float
) -> tuple[Floats, Floats]:
    """Coulomb's forces along the surface.

    Args:
        slid: (n, 3) mm, what the springs are stretched by.
        part: (n,) its derivative by the patches' places.
        normal: (n, 3).
        pressing: (n,) mN, the normal force.
        spring: (n,) mN/mm.
        friction: the coefficient.

    Returns:
        (n, 3) mN and the derivative (n, 3, 3) mN/mm, the normal's turning left out.
    """
    flat = np.eye(3) - normal[:, :, None] * normal[:, None]
    trial = -spring[:, None] * np.einsum("pij,pj->pi", flat, slid)
    size, limit = np.linalg.norm(trial, axis=1), friction * pressing
    slips = size > limit
    way = trial / np.maximum(size, 1e-300)[:, None]
    share = np.where(slips, limit / np.maximum(size, 1e-300), 1.0)
    across = np.where(slips[:, None, None], way[:, :, None] * way[:, None], 0.0)
    slope = -(share * spring * part)[:, None, None] * (flat - across)
    drop = np.where(slips, friction * spring, 0.0)
    return share[:, None] * trial, slope - drop[:, None, None] * way[:, :, None] * normal[:, None]
