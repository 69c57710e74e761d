"""Rigid tips over the frames of a sequence: where they are driven, the tissue's equilibrium, what they press
with.

The law's nonlinear part goes into the contact's free displacement and is corrected from outside: with K the
stiffness at rest, u <- K^-1 (load + contact's forces + K u - force(u)), sped up by Anderson's mixing (Walker
& Ni,
SIAM J. Numer. Anal. 49, 2011) in the norm of K.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.fem import contact, tool
from synth.fem.contact import Condensed, Hold, Patches, Pose, Tip, Touch, mean_gap
from synth.fem.equilibrium import TOLERANCE, NoEquilibrium, Path, check_state, interpolate_states, on_free
from synth.fem.material import Tissue
from synth.fem.surface_embedding import Embedding
from synth.fem.system import State, System
from synth.fem.tool import Course, Gesture
from synth.job import schema
from synth.job.law_limits import RIGID_GESTURES, depth_of_load
from synth.job.law_plugins import largest_load

Floats = NDArray[np.float64]

# Of patches, as a part of the radius; coarser where a slide would need more of them.
_SPACING, _MOST = 0.17, 110.0
_REACH = 1.05  # of the radius: where a tip may touch
_MEMORY, _ROUNDS, _CUTS = 6, 40, 4


@dataclass(frozen=True)
class Drive:
    """One tip over T frames."""

    tip: Tip
    friction: float
    pressing: NDArray[np.bool_]
    """(T,) whether it is there."""
    origin: Floats
    """(T, 3) mm where it would just touch the tissue at rest."""
    turn: Floats
    """(T, 3, 3) its axes as rows."""
    way: Floats
    """(3,) unit vector along which it is pressed in."""
    force: Floats | None
    """(T,) mN along it, for E = 1 kPa; None: the depth is given."""
    depth: Floats | None
    """(T,) mm along it."""

    def part(self, t: int) -> float:
        """How much of its largest force or depth is asked for in frame t."""
        course = self.force if self.depth is None else self.depth
        assert course is not None
        return float(course[t] / max(course.max(), 1e-300))

    def pose(self, t: int) -> Pose | None:
        """In frame t; None while it is away."""
        if not self.pressing[t]:
            return None
        if self.force is not None:
            free, asked = self.way[:, None], self.force[t : t + 1]
            return Pose(self.tip, self.friction, self.origin[t], self.turn[t], free, asked)
        assert self.depth is not None
        place = self.origin[t] + self.depth[t] * self.way
        return Pose(self.tip, self.friction, place, self.turn[t], np.zeros((3, 0)), np.zeros(0))


@dataclass(frozen=True)
class Skin:
    """The fine surface at rest."""

    carry: Embedding
    vertices: Floats
    """(V, 3) mm."""
    area: Floats
    """(V,) mm^2."""


@dataclass(frozen=True)
class Pressed:
    """What K rigid tips have done over T frames."""

    path: Path
    traction: Floats
    """(T, V, 3) kPa on the surface at rest."""
    force: Floats
    """(T, K, 3) mN on the tissue."""
    tips: Floats
    """(T, K, 2, 3) mm, two places of each tip; while it is away, where it would touch."""


def applies(fem: schema.Fem, gesture: Gesture) -> bool:
    """Whether a gesture is carried out by a rigid tip in this job."""
    return fem.contact == "rigid" and gesture.kind in RIGID_GESTURES


def press_skin(
    fem: schema.Fem,
    tissue: Tissue,
    played: Sequence[tuple[Gesture, Course]],
    skin: Skin,
    system: System,
    loads: Floats,
    named: Floats,
) -> Pressed:
    """Carries out gestures by rigid tips.

    Args:
        fem: the job's section.
        tissue: its E.
        played: K gestures, all of `RIGID_GESTURES`.
        skin: what they touch.
        system: the tissue's equations.
        loads: (T, N, 3) mN of other gestures, for E = 1 kPa.
        named: (T,) P = F/(E a^2), for messages.

    Raises:
        UserError: a tip touches fewer than 3 vertices, or a depth given takes a load past the law's range.
        InvertedElement, NotFinite, NoEquilibrium: as `press`.
    """
    patches = tuple(cover(fem, g, over, skin, k) for k, (g, over) in enumerate(played))
    solid = contact.condense(system, patches)
    tips = [drive(fem, tissue, g, over, own) for (g, over), own in zip(played, patches, strict=True)]
    most = np.zeros_like(solid.rest)
    for k, ((g, _), one) in enumerate(zip(played, tips, strict=True)):
        own = solid.owner == k
        share = solid.area[own] / solid.area[own].sum()
        most[own] = np.outer(share, g.load * g.footprint_mm**2 * one.way)
    peak = loads[np.abs(loads).max(axis=(1, 2)).argmax()] + solid.gather(most)
    path, found, middle = press(system, solid, tips, loads, named, peak)
    traction = np.zeros((len(loads), *skin.vertices.shape))
    force = np.zeros((len(loads), len(tips), 3))
    ends = np.zeros((len(loads), len(tips), 2, 3))
    for k, ((g, _), own) in enumerate(zip(played, patches, strict=True)):
        for t, on in enumerate(found[:, solid.owner == k]):
            traction[t, own.vertices] += tissue.young_kpa * own.traction(on, skin.area)
        force[:, k] = tissue.young_kpa * found[:, solid.owner == k].sum(axis=1)
        _check_depth(fem, tissue, g, force[:, k])
        aside = 0.5 * g.spread_mm * tool.across(g)
        ends[:, k] = middle[:, k, None] + np.array([[-1.0], [1.0]]) * _within(tips[k].turn, aside)[:, None]
    return Pressed(path, traction, force, ends)


def _check_depth(fem: schema.Fem, tissue: Tissue, gesture: Gesture, force: Floats) -> None:
    """Refuses forces (T, 3) mN, found under a given depth, that are past the law's range."""
    size = np.linalg.norm(force, axis=1) / (tissue.young_kpa * gesture.footprint_mm**2)
    t, largest = int(size.argmax()), largest_load(tissue.law)
    if fem.depth_mm is not None and size[t] > largest:
        raise UserError(
            f"frame {t}: the depth asked for takes a load of {size[t]:.3g}, past the range of the "
            f"{tissue.law} law, {largest:g}; lower fem.depth_mm"
        )


def _within(turn: Floats, aside: Floats) -> Floats:
    """A direction (3,) laid into the planes of tips (T, 3, 3), its length kept: (T, 3)."""
    flat = aside - (turn[:, 2] @ aside)[:, None] * turn[:, 2]
    return np.asarray(flat * (np.linalg.norm(aside) / np.linalg.norm(flat, axis=1))[:, None])


def cover(fem: schema.Fem, gesture: Gesture, over: Course, skin: Skin, owner: int = 0) -> Patches:
    """Patches wherever a gesture's tip may touch the skin; `owner` is the tip's number."""
    radius = gesture.footprint_mm
    reach = _REACH * radius
    length = float(np.hypot(*gesture.path_mm))
    swept = np.pi * reach**2 + 2 * reach * length
    places = np.asarray(gesture.contacts[0].point_mm) + np.unique(over.shift, axis=0)
    spacing = max(_SPACING * radius, float(np.sqrt(swept / _MOST)))
    return contact.divide(skin.carry, skin.vertices, skin.area, places, reach, spacing, owner)


def drive(fem: schema.Fem, tissue: Tissue, gesture: Gesture, over: Course, skin: Patches) -> Drive:
    """How a gesture drives its tip.

    A push or tap moves along its direction until the force along it is met, held aside by the hand; a slide
    is pressed straight down and moved along its path. The tip's axis is the normal of the surface's mean
    plane
    under it.

    Args:
        fem: the job's section.
        tissue: its E.
        gesture: one of `RIGID_GESTURES`.
        over: its course.
        skin: what it may touch.
    """
    tip = Tip.named(fem.tip, gesture.footprint_mm)
    start = np.asarray(gesture.contacts[0].point_mm)
    whole = np.asarray(gesture.contacts[0].force_mn) / tissue.young_kpa
    way = np.array([0.0, 0.0, -1.0]) if gesture.kind == "slide" else whole / np.linalg.norm(whole)
    stops, of = np.unique(over.shift, axis=0, return_inverse=True)
    laid = [_lay(tip, start + stop, skin) for stop in stops]
    origin = np.stack([laid[k][0] for k in of.ravel()])
    turn = np.stack([laid[k][1] for k in of.ravel()])
    force: Floats | None = over.load * float(whole @ way)
    depth = None
    if fem.depth_mm is not None:
        most = depth_of_load(fem.tip, gesture.load, tissue.poisson) * gesture.footprint_mm
        force, depth = None, over.load * most
    return Drive(tip, fem.friction, over.load > 0, origin, turn, way, force, depth)


def _lay(tip: Tip, at: Floats, skin: Patches) -> tuple[Floats, Floats]:
    """Origin (3,) mm and axes (3, 3) of a tip that just touches the skin at rest over a place (2,)."""
    away = np.hypot(*(skin.rest[:, :2] - at).T) / (1.2 * tip.radius_mm)
    weight = skin.area * np.maximum(1 - away**2, 0) ** 2
    spot = skin.rest - np.average(skin.rest, axis=0, weights=weight)
    plane = np.column_stack([spot[:, :2], np.ones(len(spot))]) * np.sqrt(weight)[:, None]
    slope = np.linalg.lstsq(plane, spot[:, 2] * np.sqrt(weight), rcond=None)[0][:2]
    up = np.append(-slope, 1.0) / np.sqrt(slope @ slope + 1)
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    turn = np.stack([x, np.cross(up, x), up])
    origin = np.append(at, skin.rest[:, 2].max() + tip.radius_mm)
    for _ in range(50):  # lowered by Newton's method; a gap is a convex function of height
        gap, normal, _ = mean_gap(tip, (skin.rest - origin) @ turn.T, skin.offsets @ turn.T)
        first = int(gap.argmin())
        if abs(gap[first]) <= 1e-9 * tip.radius_mm:
            break
        origin[2] += gap[first] / float(normal[first] @ turn[:, 2])
    return origin, turn


def press(
    system: System, solid: Condensed, tips: Sequence[Drive], loads: Floats, named: Floats, peak: Floats
) -> tuple[Path, Floats, Floats]:
    """Equilibrium of tissue, tips and other loads, frame by frame.

    Args:
        system: the tissue's equations.
        solid: the same, condensed to what the tips may touch.
        tips: K, one for each of the patches' owners.
        loads: (T, N, 3) mN of whatever else there is, for E = 1 kPa.
        named: (T,) P = F/(E a^2) of each frame, for messages.
        peak: (N, 3) mN, about what the largest load is; equilibrium is to a part of it.

    Returns:
        The volume's states; forces on the patches (T, P, 3) mN for E = 1 kPa; where the tips' lowest points
        were (T, K, 3) mm, or, while they are away, would touch.

    Raises:
        InvertedElement, NotFinite: as `equilibrium.solve_path`.
        NoEquilibrium: the iteration stalled; names frame and load.
    """
    count = len(solid.owner)
    at_peak = system.solve(peak)
    scale = float(np.sqrt(np.vdot(peak, at_peak))) or 1.0
    known = [(0.0, np.zeros_like(peak))]
    at = _Standing(np.zeros_like(loads[0]), None, Hold.none(count), tuple(np.zeros(0) for _ in tips), 0.0)
    before: _Asked = _Asked(tuple(None for _ in tips), np.zeros_like(loads[0]))
    steps: list[tuple[Floats, State, float, float]] = []
    forces = np.zeros((len(loads), count, 3))
    middle = np.stack([one.origin for one in tips], axis=1)
    for t, load in enumerate(loads):
        asked = _Asked(tuple(one.pose(t) for one in tips), load)
        factor = tips[0].part(t)
        if len(tips) == 1 and not load.any() and not np.ptp(tips[0].origin, axis=0).any():
            # But for friction's past, elastic states depend on the load alone.
            at = replace(at, guess=interpolate_states(known, factor, at_peak))
        try:
            at = _advance(system, solid, at, before, asked, TOLERANCE * scale, _CUTS)
        except NoEquilibrium as stalled:
            raise NoEquilibrium(f"frame {t}: {stalled} at load {named[t]:.3g}; lower the load") from None
        assert at.state is not None
        least = check_state(system, at.u, at.state, t, float(named[t]))
        steps.append((at.u, at.state, least, at.norm / scale))
        forces[t] = at.force(count)
        if all(abs(factor - one) > 1e-3 for one, _ in known):
            known.append((factor, at.u))
        for k, pose in enumerate(asked.poses):
            if pose is not None:
                middle[t, k] = pose.origin + pose.free @ at.drive[k]
        before = asked
    path = Path(
        np.stack([u for u, _, _, _ in steps]),
        np.array([least for _, _, least, _ in steps]),
        np.array([state.energy for _, state, _, _ in steps]),
        np.array([norm for _, _, _, norm in steps]),
    )
    return path, forces, middle


@dataclass(frozen=True)
class _Asked:
    """What a step asks for."""

    poses: tuple[Pose | None, ...]
    load: Floats

    def after(self, before: _Asked, share: float) -> _Asked:
        """A part of the way here."""
        poses: list[Pose | None] = []
        for old, new in zip(before.poses, self.poses, strict=True):
            if new is None:
                poses.append(None)
                continue
            start = old or replace(new, force=0 * new.force)
            u, _, v = np.linalg.svd((1 - share) * start.turn + share * new.turn)
            poses.append(
                replace(
                    new,
                    origin=(1 - share) * start.origin + share * new.origin,
                    turn=u @ v,
                    force=(1 - share) * start.force + share * new.force,
                )
            )
        return _Asked(tuple(poses), (1 - share) * before.load + share * self.load)


@dataclass(frozen=True)
class _Standing:
    """Equilibrium: nodes (N, 3) mm, the contact, and what is out of balance."""

    u: Floats
    state: State | None
    hold: Hold
    drive: tuple[Floats, ...]
    norm: float
    touch: Touch | None = None
    guess: Floats | None = None
    """(N, 3) mm, where to look for the next."""

    def force(self, count: int) -> Floats:
        """(P, 3) mN."""
        return np.zeros((count, 3)) if self.touch is None else self.touch.force


def _advance(
    system: System,
    solid: Condensed,
    at: _Standing,
    before: _Asked,
    asked: _Asked,
    tolerance: float,
    cuts: int,
) -> _Standing:
    """One step; where it finds no balance, in two halves, and so on."""
    try:
        return _settle(system, solid, at, asked, tolerance)
    except NoEquilibrium:
        if cuts == 0:
            raise
    at = replace(at, guess=None)
    half = asked.after(before, 0.5)
    middle = _advance(system, solid, at, before, half, tolerance, cuts - 1)
    return _advance(system, solid, middle, half, asked, tolerance, cuts - 1)


def _settle(system: System, solid: Condensed, at: _Standing, asked: _Asked, tolerance: float) -> _Standing:
    """Equilibrium of one step.

    Raises:
        NoEquilibrium: not reached.
    """
    drive = tuple(
        np.zeros(0 if pose is None else pose.free.shape[1])
        if pose is None or len(old) != pose.free.shape[1]
        else old
        for pose, old in zip(asked.poses, at.drive, strict=True)
    )
    u = at.u if at.guess is None else at.guess
    state = system.state(u)
    if not np.isfinite(state.energy):
        u, state = at.u, system.state(at.u)
    mixed: list[tuple[Floats, Floats, Floats]] = []
    start = None if at.touch is None else at.touch.moved
    for _ in range(_ROUNDS):
        free = system.solve(asked.load - state.force)
        met = contact.touch(solid, asked.poses, solid.move(u + free), at.hold, drive, start)
        drive, start = met.drive, met.moved
        step = free + solid.pushed(met.force)
        out = on_free(system, asked.load + solid.gather(met.force) - state.force)
        norm = max(float(np.vdot(out, step)), 0.0) ** 0.5
        if norm <= tolerance:
            return _Standing(u, state, met.hold, drive, norm, met)
        mixed.append((u, step, out))
        del mixed[:-_MEMORY]
        u, state = _finite(system, u, _mix(mixed))
    raise NoEquilibrium("no equilibrium of tip and tissue")


def _mix(mixed: list[tuple[Floats, Floats, Floats]]) -> Floats:
    """Anderson's next state (N, 3) mm from states, the fixed-point steps there, and these times the
    stiffness."""
    u, step, out = mixed[-1]
    if len(mixed) == 1:
        return u + step
    steps = [step - w for _, w, _ in mixed[:-1]]
    outs = [out - r for _, _, r in mixed[:-1]]
    gram = np.array([[float(np.vdot(w, r)) for r in outs] for w in steps])
    right = np.array([float(np.vdot(step, r)) for r in outs])
    gram = 0.5 * (gram + gram.T)
    share = np.linalg.lstsq(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)), right, rcond=None)[0]
    new = u + step
    for part, (old, _, _), w in zip(share, mixed[:-1], steps, strict=True):
        new = new - part * (u - old + w)
    return np.asarray(new)


def _finite(system: System, u: Floats, trial: Floats) -> tuple[Floats, State]:
    """The trial, or a state on the way there, whose energy is finite."""
    for _ in range(12):
        state = system.state(trial)
        if np.isfinite(state.energy):
            return trial, state
        trial = u + 0.5 * (trial - u)
    raise NoEquilibrium("no equilibrium of tip and tissue")
