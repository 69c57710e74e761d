"""Instruments that hold the tissue under them and move it: the load is the reaction.

A pressure that is given beforehand turns elements inside out where tissue strains by a third; a contact that
is driven does not. Under each tip a layer of springs joins the surface at rest to the instrument,

    W = 1/2 int k(X) |u(X) - d|^2 dA,    k(X) = k0 (1 - r^2)^2,

r the distance from the middle of the contact over its half axes, d (3,) mm the way of the tip. The layer is
so stiff that tissue lags by some per cent of the way, and softens towards the contact's border, as rounded
edges do: a rigid punch that sticks has infinite traction there. Traction is k (d - u), its sum the reaction:
both are exact, on the fine surface. The springs are a part of the system's, so the solver is the one of given
loads.

First each instrument is driven alone, without time, along its path, in steps that shorten where the search
for equilibrium fails. That finds how far a force needs, what the tissue bears, and states to begin from in
time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import scipy.sparse as sp
from scipy.interpolate import PchipInterpolator
from scipy.optimize import brentq

from synth.arrays import Floats, Mask
from synth.fem import tool_gesture
from synth.fem.equilibrium import ExcessiveLoad, InvertedElement, NoEquilibrium, minimise_energy
from synth.fem.law_choice import LEAST_JACOBIAN
from synth.fem.material import Tissue
from synth.fem.motion import Clock, PronyHistory
from synth.fem.surface_embedding import Embedding
from synth.fem.system import System, factorise
from synth.fem.tangent import linearise
from synth.fem.tool_gesture import Gesture, ToolMotion

FIRMNESS = 40.0
"""k0 over E/a: tissue under a flat punch has 0.8 E/a, so that it lags by some 3% of the way."""
_SHEET_FIRMNESS = 20.0  # the same over S/a^2, S the membrane's stiffness

TOLERANCE = 4e-4
"""Residual's norm, as a part of that of the stored energy, at which a state is in equilibrium."""
_FAINT = 0.05  # part of the peak below which it is a part of this share of the peak's
_SEARCH, _ROUNDS = 20, 6  # iterations until the stiffness is taken anew, and how often
_FIRST_MM, _LONGEST_MM, _SHORTEST_MM = 0.25, 1.0, 0.02  # steps of a drive
_YIELDING, _ENOUGH = 0.06, 0.3  # shortest step of a plan that yields, and least way, as parts of its way
_SLACK = (
    0.7  # part of the drive's least J that is accepted in time, where several instruments and history act
)
_FARTHEST_MM = 15.0  # path of an instrument whose force isn't reached
_MIDDLE = 0.7  # part of the way at whose state the stiffness is taken for the steps in time
_SUBSTEPS = 4  # of a frame in which the search fails
_REACHED = 0.005  # relative difference from the wanted force


@dataclass(frozen=True)
class Layer:
    """The springs between one instrument's tips and the surface, for E = 1 kPa."""

    gesture: Gesture
    value: tuple[sp.csr_array, ...]  # (V, N) shape functions under each tip, 0 beyond it
    firm: tuple[Floats, ...]  # (V,) kPa/mm under each tip, k
    area: Floats  # (V,) mm^2
    springs: sp.csr_array  # (3N, 3N) mN/mm, of all its tips

    def pull(self, way_mm: float) -> Floats:
        """Nodal forces (N, 3) mN of its springs on tissue at rest, the instrument `way_mm` along its path."""
        out = np.zeros((self.springs.shape[0] // 3, 3))
        for value, firm, way in zip(self.value, self.firm, self.gesture.ways(way_mm), strict=True):
            out += np.outer(value.T @ (firm * self.area), way)
        return out

    def traction(self, u: Floats, way_mm: float) -> Floats:
        """(V, 3) kPa on the tissue at (N, 3) mm."""
        ways = self.gesture.ways(way_mm)
        each = zip(self.value, self.firm, ways, strict=True)
        return np.asarray(sum(firm[:, None] * (way - value @ u) for value, firm, way in each))

    def reaction(self, u: Floats, way_mm: float) -> Floats:
        """(3,) mN on the tissue."""
        return np.asarray(self.area @ self.traction(u, way_mm))


@dataclass(frozen=True)
class DrivenPath:
    """States over T frames, as a `LoadPath`, with the ways of I instruments and whether they hold tissue."""

    displacement: Floats  # (T, N, 3) mm
    jacobian: Floats  # (T,)
    energy: Floats  # (T,) mN mm for E = 1 kPa, without the layers'
    residual: Floats  # (T,)
    way: Floats  # (T, I) mm
    holds: Mask  # (T, I)


@dataclass
class _Drive:
    """States on the path of one instrument, for E = 1 kPa."""

    way: list[float]  # mm
    state: list[Floats] = field(repr=False)  # (N, 3) mm
    reaction: list[Floats]  # (3,) mN
    energy: list[float]  # mN mm

    def at(self, way_mm: float) -> Floats:
        """The state (N, 3) mm by cubic interpolation between the four nearest."""
        first = int(np.clip(np.searchsorted(self.way, way_mm) - 2, 0, max(len(self.way) - 4, 0)))
        near = slice(first, first + 4)
        x = np.array(self.way[near])
        factor = [np.prod([(way_mm - b) / (a - b) for b in x if b != a]) for a in x]
        return np.asarray(sum(f * u for f, u in zip(factor, self.state[near], strict=True)))


def layers(
    gestures: Sequence[Gesture], tissue: Tissue, embedding: Embedding, vertices: Floats, area: Floats
) -> list[Layer]:
    """The layer of each gesture on the surface at rest (V, 3) mm, (V,) mm^2. Raises as `footprint`."""
    made = []
    for gesture in gestures:
        values, stiff = [], []
        for contact in gesture.contacts:
            shape = tool_gesture.footprint(np.asarray(contact.point_mm), gesture.axes, vertices, area)
            held = shape > 0
            radius, sheet = gesture.footprint_mm, 0.0
            if tissue.membrane is not None:
                pia = tissue.membrane
                sheet = pia.young_kpa * pia.thickness_mm / tissue.young_kpa
            most = FIRMNESS / radius + _SHEET_FIRMNESS * sheet / radius**2
            values.append(sp.csr_array(sp.diags_array(held.astype(np.float64)) @ embedding.value))
            stiff.append(most * shape / shape.max())
        nodal = sum(
            (
                value.T @ sp.diags_array(firm * area) @ value
                for value, firm in zip(values, stiff, strict=True)
            ),
            start=sp.csr_array((values[0].shape[1],) * 2),
        )
        springs = sp.csr_array(sp.kron(nodal, np.eye(3), format="csr"))
        made.append(Layer(gesture, tuple(values), tuple(stiff), area, springs))
    return made


class Balance:
    """Search for equilibrium of a system with springs, whose stiffness is taken anew where it is slow."""

    def __init__(self, base: System, springs: sp.csr_array, firm: float = 1.0) -> None:
        """`base`: the system without them; `springs`: (3N, 3N) mN/mm; `firm`: `Clock.relative_stiffness`."""
        self._springs, self.firm = springs, firm
        slip = springs if base.slip is None else springs + base.slip
        slip, hold = sp.csr_array(slip / firm), sp.csr_array(base.hold / firm)
        added = slip + sp.kron(hold - base.hold, np.eye(3), format="csr")
        if base.slip is not None:
            added = added - base.slip
        whole = sp.csr_array(base.stiffness + added)
        factor = factorise(whole, base.free)
        self.system = replace(base, hold=hold, slip=slip, stiffness=whole, factor=factor)
        self._near = self.system

    def find(
        self, load: Floats, start: Floats, safe: Floats, energy: float, least_jacobian: float
    ) -> tuple[Floats, float, float, float]:
        """Displacement (N, 3) mm under nodal forces (N, 3) mN, the springs' pull included, its least J,
        stored energy [mN mm] without the springs' and residual. `energy`: least that the residual is measured
        by; `least_jacobian`: smallest J that is accepted.

        Raises InvertedElement or NoEquilibrium.
        """
        load = load / self.firm
        u, stored = start, self._stored(start, self.system.state(start).energy)
        if not np.isfinite(stored):
            u, stored = safe, self._stored(safe, self.system.state(safe).energy)
        for turn in range(_ROUNDS + 1):
            size = float(np.sqrt(2 * max(stored, energy, 1e-12)))
            u, state, norm = minimise_energy(self._near, load, u, TOLERANCE * size, safe, _SEARCH)
            if not np.isfinite(u).all():
                break
            stored = self._stored(u, state.energy)
            size = float(np.sqrt(2 * max(stored, energy, 1e-12)))
            if norm <= 1.01 * TOLERANCE * size:
                least, element = self.system.least_jacobian(u)
                if least <= least_jacobian:
                    limit = f"(det F {least:.2f}, more than {least_jacobian:.2g} is needed)"
                    raise InvertedElement(f"element {element} is inside out or nearly so {limit}")
                return u, least, stored, norm / size
            if turn < _ROUNDS:
                self._near = linearise(self.system, u)
        raise NoEquilibrium("no equilibrium")

    def approach(self, u: Floats) -> None:
        """Searches from now on with the stiffness at (N, 3) mm."""
        if np.isfinite(self.system.state(u).energy):
            self._near = linearise(self.system, u)

    def _stored(self, u: Floats, energy: float) -> float:
        """Energy [mN mm] at (N, 3) mm without the springs', of the whole."""
        return energy - 0.5 * float(u.ravel() @ (self._springs @ u.ravel())) / self.firm


def drive(balance: Balance, layer: Layer, wanted: Callable[[_Drive], float | None]) -> _Drive:
    """Drives one instrument from rest until `wanted` gives the way at which to end, within what is known.

    `wanted`: from the states so far to the last way [mm]; None, or a way beyond the last state: further. A
    plan that yields ends where tissue bears no more, if that is `_ENOUGH` of its way. Raises ExcessiveLoad,
    with the way and the force that were reached.
    """
    plan = layer.gesture.drive
    assert plan is not None
    rest = np.zeros((layer.springs.shape[0] // 3, 3))
    path = _Drive([0.0], [rest], [np.zeros(3)], [0.0])
    step, shortest = _FIRST_MM, _SHORTEST_MM
    if plan.yields and plan.travel_mm is not None:
        shortest = _YIELDING * plan.travel_mm
    for _ in range(200):
        end = wanted(path)
        if end is not None and path.way[-1] >= end - 1e-9:
            return path
        way = path.way[-1] + step
        if end is not None:
            left = end - path.way[-1]
            way = end if left <= 1.2 * step else way
        if way > _FARTHEST_MM:
            raise ExcessiveLoad(f"the force isn't reached within {_FARTHEST_MM:g} mm ({_reached(path)})")
        last = path.state[-1]
        start = last if len(path.way) < 2 else path.at(way)
        limit = LEAST_JACOBIAN
        try:
            u, _, energy, _ = balance.find(layer.pull(way), start, last, path.energy[-1], limit)
        except ExcessiveLoad as error:
            step = 0.5 * (way - path.way[-1])
            if step >= shortest:
                continue
            if plan.yields and plan.travel_mm is not None and path.way[-1] >= _ENOUGH * plan.travel_mm:
                return path
            raise type(error)(f"{error} beyond {_reached(path)}") from None
        path.way.append(way)
        path.state.append(u)
        path.reaction.append(layer.reaction(u, way))
        path.energy.append(energy)
        step = min(1.5 * step, _LONGEST_MM)
    raise NoEquilibrium(f"a path of too many steps, {_reached(path)}")


def _reached(path: _Drive) -> str:
    return f"{path.way[-1]:.2f} mm, {np.linalg.norm(path.reaction[-1]):.3g} mN for E = 1 kPa"


def way_of_force(path: _Drive, force_mn: float, load: Floats, clock: Clock | None) -> float | None:
    """Way [mm] at which the largest reaction over a gesture is `force_mn`; None: beyond the states so far.

    `load`: (T,) the way over time as a part of its largest; `clock`: whose relaxation the reaction has.
    """
    if len(path.way) < 3:
        return None
    curve = PchipInterpolator(path.way, np.stack(path.reaction))

    def peak(way: float) -> float:
        over = curve(way * load)
        if clock is not None and clock.relaxation:
            over = relaxed(over, clock)
        return float(np.linalg.norm(over, axis=1).max())

    most = path.way[-1]
    if peak(most) < force_mn:
        return None
    return float(brentq(lambda way: peak(way) - force_mn, 0, most, rtol=_REACHED * 0.1))


def relaxed(force: Floats, clock: Clock) -> Floats:
    """Force (T, ...) after relaxation, of an elastic one at equal steps."""
    history, out = PronyHistory(clock), np.empty_like(force)
    for t, now in enumerate(force):
        out[t] = clock.relative_stiffness * now - history.add_to(np.zeros_like(now))
        history.update(now)
    return out


def follow(
    base: System,
    young_kpa: float,
    held: Sequence[Layer],
    motions: Sequence[ToolMotion],
    clock: Clock,
    further: Floats,
) -> DrivenPath:
    """Motion under driven instruments over T frames.

    `base`: the system without layers, `young_kpa`: E of its tissue; `held`: a layer for each of I gestures
    with its motion; `clock`: frames and relaxation; `further`: other nodal forces (T, N, 3) mN for E = 1 kPa,
    such as a pulse's. An instrument lets go where, on its way back, it would have to pull what it pushed.
    Raises ExcessiveLoad: the tissue does not bear it, or the force isn't reached; with the frame,
    InvertedElement or NoEquilibrium.
    """
    frames, count = len(further), len(held)
    way, paths, first = np.zeros((frames, count)), list[_Drive](), dict[tuple[bool, ...], Balance]()
    for k, (layer, motion) in enumerate(zip(held, motions, strict=True)):
        alone = Balance(base, layer.springs)
        end = partial(_end_of, layer.gesture, young_kpa, clock, frames)
        paths.append(drive(alone, layer, end))
        way[:, k] = min(end(paths[-1]) or 0.0, paths[-1].way[-1]) * motion.load
        if count == 1 and not clock.relaxation:
            first[True,] = alone
    march = _March(base, held, paths, clock, first)
    rows = [march.step(way[t], further[t], t) for t in range(frames)]
    return DrivenPath(*(np.stack(column) for column in zip(*rows, strict=True)))


def _end_of(gesture: Gesture, young_kpa: float, clock: Clock, frames: int, path: _Drive) -> float | None:
    plan = gesture.drive
    assert plan is not None
    if plan.force_mn is None:
        return plan.travel_mm
    load = tool_gesture.trajectory(gesture, frames).load
    return way_of_force(path, plan.force_mn / young_kpa, load, clock)


class _March:
    """Steps in time under several driven instruments."""

    def __init__(
        self,
        base: System,
        held: Sequence[Layer],
        paths: Sequence[_Drive],
        clock: Clock,
        balances: dict[tuple[bool, ...], Balance],
    ) -> None:
        self._base, self._held, self._paths, self._clock = base, held, paths, clock
        self._balances, self._past = balances, PronyHistory(clock)
        self._elastic = replace(base, hold=sp.csr_array(base.hold.shape), slip=None)
        self._faint = _FAINT * max((path.energy[-1] for path in paths), default=0.0)
        self._u = self._before = np.zeros((base.mesh.nodes, 3))
        self._way, self._gone = np.zeros(len(held)), np.zeros(len(held), bool)

    def step(
        self, way: Floats, further: Floats, frame: int
    ) -> tuple[Floats, float, float, float, Floats, Mask]:
        """Displacement (N, 3) mm, least J, stored energy, residual, the ways (I,) mm and which instruments
        hold tissue, a step later. Raises ExcessiveLoad, with the frame."""
        rising = way > self._way
        holds = (way > 0) & (~self._gone | rising)
        while True:
            try:
                u, least, energy, residual = self._settle(way, further, holds)
            except ExcessiveLoad as error:
                raise type(error)(f"frame {frame}: {error}") from None
            back = np.zeros(len(way), bool)
            for k in np.flatnonzero(holds & (self._gone | ~rising)).tolist():
                layer = self._held[k]
                forward = float(layer.reaction(u, way[k]) @ np.asarray(layer.gesture.direction))
                back[k] = forward < 0
            if not back.any():
                break
            holds &= ~back
        if self._clock.relaxation:
            self._past.update(self._elastic.state(u).force)
        self._gone = ~holds & (way > 0)
        self._before, self._u, self._way = self._u, u, way
        return u, least, energy, residual, way, holds

    def _settle(self, way: Floats, further: Floats, holds: Mask) -> tuple[Floats, float, float, float]:
        still = np.zeros_like(self._u)
        if not holds.any() and not further.any() and not self._clock.relaxation:
            return still, 1.0, 0.0, 0.0
        key = tuple(holds.tolist())
        active = [k for k, on in enumerate(key) if on]
        if key not in self._balances:
            firm = self._clock.relative_stiffness
            springs = sum(
                (self._held[k].springs for k in active), start=sp.csr_array(self._base.stiffness.shape)
            )
            balance = Balance(self._base, springs, firm)
            middle = sum((self._paths[k].at(_MIDDLE * self._paths[k].way[-1]) for k in active), start=still)
            if active:  # most frames are nearer to this state than to rest
                balance.approach(middle)
            self._balances[key] = balance
        history = self._past.add_to(further)

        def find(ways: Floats, start: Floats, safe: Floats) -> tuple[Floats, float, float, float]:
            load = sum((self._held[k].pull(ways[k]) for k in active), start=history)
            least = _SLACK * LEAST_JACOBIAN
            return self._balances[key].find(load, start, safe, self._faint, least)

        alone = sum((self._paths[k].at(way[k]) for k in active), start=still)
        shifted = alone + self._u - sum((self._paths[k].at(self._way[k]) for k in active), start=still)
        if not active:
            shifted = self._u + 0.7 * (self._u - self._before)
        # A surface in compression may crease in several ways; the way that the drive found is one of them.
        for start in (shifted, alone):
            try:
                return find(way, start, self._u)
            except ExcessiveLoad:
                continue
        u = self._u
        for part in np.linspace(0, 1, _SUBSTEPS + 1)[1:]:
            state = find(self._way + part * (way - self._way), u, u)
            u = state[0]
        return state
