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
    firmness: tuple[Floats, ...]  # (V,) kPa/mm under each tip, k
    area: Floats  # (V,) mm^2
    springs: sp.csr_array  # (3N, 3N) mN/mm, of all its tips

    def pull(self, travel_mm: float) -> Floats:
        """Nodal forces (N, 3) mN of its springs on tissue at rest, the tips `travel_mm` along their path."""
        out = np.zeros((self.springs.shape[0] // 3, 3))
        for value, firmness, offset in zip(
            self.value, self.firmness, self.gesture.tip_offsets(travel_mm), strict=True
        ):
            out += np.outer(value.T @ (firmness * self.area), offset)
        return out

    def traction(self, u: Floats, travel_mm: float) -> Floats:
        """(V, 3) kPa on the tissue at (N, 3) mm."""
        offsets = self.gesture.tip_offsets(travel_mm)
        tips = zip(self.value, self.firmness, offsets, strict=True)
        return np.asarray(sum(firmness[:, None] * (offset - value @ u) for value, firmness, offset in tips))

    def reaction(self, u: Floats, travel_mm: float) -> Floats:
        """(3,) mN on the tissue."""
        return np.asarray(self.area @ self.traction(u, travel_mm))


@dataclass(frozen=True)
class DrivenPath:
    """States over T frames, as a `LoadPath`, with I instruments' travel and whether they hold tissue."""

    displacement: Floats  # (T, N, 3) mm
    jacobian: Floats  # (T,)
    energy: Floats  # (T,) mN mm for E = 1 kPa, without the layers'
    residual: Floats  # (T,)
    travel: Floats  # (T, I) mm
    in_contact: Mask  # (T, I)


@dataclass
class _Drive:
    """States on the path of one instrument, for E = 1 kPa."""

    travel: list[float]  # mm
    state: list[Floats] = field(repr=False)  # (N, 3) mm
    reaction: list[Floats]  # (3,) mN
    energy: list[float]  # mN mm

    def interpolate(self, travel_mm: float) -> Floats:
        """The state (N, 3) mm by cubic interpolation between the four nearest."""
        first = int(np.clip(np.searchsorted(self.travel, travel_mm) - 2, 0, max(len(self.travel) - 4, 0)))
        neighbours = slice(first, first + 4)
        x = np.array(self.travel[neighbours])
        weights = [np.prod([(travel_mm - b) / (a - b) for b in x if b != a]) for a in x]
        return np.asarray(sum(weight * u for weight, u in zip(weights, self.state[neighbours], strict=True)))


def build_layers(
    gestures: Sequence[Gesture], tissue: Tissue, embedding: Embedding, vertices: Floats, area: Floats
) -> list[Layer]:
    """The layer of each gesture on the surface at rest (V, 3) mm, (V,) mm^2. Raises as `footprint`."""
    layers = []
    for gesture in gestures:
        values, firmnesses = [], []
        for contact in gesture.contacts:
            kernel = tool_gesture.footprint(np.asarray(contact.point_mm), gesture.axes, vertices, area)
            contact_mask = kernel > 0
            radius, sheet_stiffness = gesture.footprint_mm, 0.0
            if tissue.membrane is not None:
                pia = tissue.membrane
                sheet_stiffness = pia.young_kpa * pia.thickness_mm / tissue.young_kpa
            peak_firmness = FIRMNESS / radius + _SHEET_FIRMNESS * sheet_stiffness / radius**2
            values.append(sp.csr_array(sp.diags_array(contact_mask.astype(np.float64)) @ embedding.value))
            firmnesses.append(peak_firmness * kernel / kernel.max())
        nodal = sum(
            (
                value.T @ sp.diags_array(firmness * area) @ value
                for value, firmness in zip(values, firmnesses, strict=True)
            ),
            start=sp.csr_array((values[0].shape[1],) * 2),
        )
        springs = sp.csr_array(sp.kron(nodal, np.eye(3), format="csr"))
        layers.append(Layer(gesture, tuple(values), tuple(firmnesses), area, springs))
    return layers


class Balance:
    """Search for equilibrium of a system with springs, whose stiffness is taken anew where it is slow."""

    def __init__(self, base: System, springs: sp.csr_array, relative_stiffness: float = 1.0) -> None:
        """`base`: the system without them; `springs`: (3N, 3N) mN/mm; `relative_stiffness`: as of `Clock`."""
        self._springs, self.relative_stiffness = springs, relative_stiffness
        slip = springs if base.slip is None else springs + base.slip
        slip, hold = sp.csr_array(slip / relative_stiffness), sp.csr_array(base.hold / relative_stiffness)
        added_stiffness = slip + sp.kron(hold - base.hold, np.eye(3), format="csr")
        if base.slip is not None:
            added_stiffness = added_stiffness - base.slip
        stiffness = sp.csr_array(base.stiffness + added_stiffness)
        factor = factorise(stiffness, base.free)
        self.system = replace(base, hold=hold, slip=slip, stiffness=stiffness, factor=factor)
        self._tangent = self.system

    def find(
        self, load: Floats, start: Floats, fallback: Floats, energy: float, least_jacobian: float
    ) -> tuple[Floats, float, float, float]:
        """Displacement (N, 3) mm under nodal forces (N, 3) mN, the springs' pull included, its least J,
        stored energy [mN mm] without the springs' and residual. `energy`: least that the residual is measured
        by; `least_jacobian`: smallest J that is accepted.

        Raises InvertedElement or NoEquilibrium.
        """
        load = load / self.relative_stiffness
        u, stored_energy = start, self._subtract_springs(start, self.system.state(start).energy)
        if not np.isfinite(stored_energy):
            u, stored_energy = fallback, self._subtract_springs(fallback, self.system.state(fallback).energy)
        for turn in range(_ROUNDS + 1):
            size = float(np.sqrt(2 * max(stored_energy, energy, 1e-12)))
            u, state, norm = minimise_energy(self._tangent, load, u, TOLERANCE * size, fallback, _SEARCH)
            if not np.isfinite(u).all():
                break
            stored_energy = self._subtract_springs(u, state.energy)
            size = float(np.sqrt(2 * max(stored_energy, energy, 1e-12)))
            if norm <= 1.01 * TOLERANCE * size:
                min_jacobian, element = self.system.least_jacobian(u)
                if min_jacobian <= least_jacobian:
                    limit = f"(det F {min_jacobian:.2f}, more than {least_jacobian:.2g} is needed)"
                    raise InvertedElement(f"element {element} is inside out or nearly so {limit}")
                return u, min_jacobian, stored_energy, norm / size
            if turn < _ROUNDS:
                self._tangent = linearise(self.system, u)
        raise NoEquilibrium("no equilibrium")

    def approach(self, u: Floats) -> None:
        """Searches from now on with the stiffness at (N, 3) mm."""
        if np.isfinite(self.system.state(u).energy):
            self._tangent = linearise(self.system, u)

    def _subtract_springs(self, u: Floats, energy: float) -> float:
        """Energy [mN mm] at (N, 3) mm without the springs', of the whole."""
        return energy - 0.5 * float(u.ravel() @ (self._springs @ u.ravel())) / self.relative_stiffness


def drive(balance: Balance, layer: Layer, find_end: Callable[[_Drive], float | None]) -> _Drive:
    """Drives one instrument from rest until `find_end` gives the way at which to end, within what is known.

    `find_end`: from the states so far to the last way [mm]; None, or a way beyond the last state: further. A
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
        end = find_end(path)
        if end is not None and path.travel[-1] >= end - 1e-9:
            return path
        travel = path.travel[-1] + step
        if end is not None:
            remainder = end - path.travel[-1]
            travel = end if remainder <= 1.2 * step else travel
        if travel > _FARTHEST_MM:
            raise ExcessiveLoad(f"the force isn't reached within {_FARTHEST_MM:g} mm ({_describe_end(path)})")
        last_state = path.state[-1]
        start = last_state if len(path.travel) < 2 else path.interpolate(travel)
        limit = LEAST_JACOBIAN
        try:
            u, _, energy, _ = balance.find(layer.pull(travel), start, last_state, path.energy[-1], limit)
        except ExcessiveLoad as error:
            step = 0.5 * (travel - path.travel[-1])
            if step >= shortest:
                continue
            if plan.yields and plan.travel_mm is not None and path.travel[-1] >= _ENOUGH * plan.travel_mm:
                return path
            raise type(error)(f"{error} beyond {_describe_end(path)}") from None
        path.travel.append(travel)
        path.state.append(u)
        path.reaction.append(layer.reaction(u, travel))
        path.energy.append(energy)
        step = min(1.5 * step, _LONGEST_MM)
    raise NoEquilibrium(f"a path of too many steps, {_describe_end(path)}")


def _describe_end(path: _Drive) -> str:
    return f"{path.travel[-1]:.2f} mm, {np.linalg.norm(path.reaction[-1]):.3g} mN for E = 1 kPa"


def find_travel(path: _Drive, force_mn: float, load: Floats, clock: Clock | None) -> float | None:
    """Way [mm] at which the largest reaction over a gesture is `force_mn`; None: beyond the states so far.

    `load`: (T,) the way over time as a part of its largest; `clock`: whose relaxation the reaction has.
    """
    if len(path.travel) < 3:
        return None
    curve = PchipInterpolator(path.travel, np.stack(path.reaction))

    def peak(travel: float) -> float:
        reaction = curve(travel * load)
        if clock is not None and clock.relaxation:
            reaction = relax(reaction, clock)
        return float(np.linalg.norm(reaction, axis=1).max())

    max_travel = path.travel[-1]
    if peak(max_travel) < force_mn:
        return None
    return float(brentq(lambda travel: peak(travel) - force_mn, 0, max_travel, rtol=_REACHED * 0.1))


def relax(force: Floats, clock: Clock) -> Floats:
    """Force (T, ...) after relaxation, of an elastic one at equal steps."""
    history, out = PronyHistory(clock), np.empty_like(force)
    for t, elastic in enumerate(force):
        out[t] = clock.relative_stiffness * elastic - history.add_to(np.zeros_like(elastic))
        history.update(elastic)
    return out


def follow(
    base: System,
    young_kpa: float,
    layers: Sequence[Layer],
    motions: Sequence[ToolMotion],
    clock: Clock,
    extra_loads: Floats,
) -> DrivenPath:
    """Motion under driven instruments over T frames.

    `base`: the system without layers, `young_kpa`: E of its tissue; `layers`: one for each of I gestures
    with its motion; `clock`: frames and relaxation; `extra_loads`: other nodal forces (T, N, 3) mN for
    E = 1 kPa, such as a pulse's. An instrument lets go where, on its way back, it would have to pull what it
    pushed. Raises ExcessiveLoad: the tissue does not bear it, or the force isn't reached; with the frame,
    InvertedElement or NoEquilibrium.
    """
    frames, count = len(extra_loads), len(layers)
    travel, paths, balances = np.zeros((frames, count)), list[_Drive](), dict[tuple[bool, ...], Balance]()
    for k, (layer, motion) in enumerate(zip(layers, motions, strict=True)):
        balance = Balance(base, layer.springs)
        find_end = partial(_find_end, layer.gesture, young_kpa, clock, frames)
        paths.append(drive(balance, layer, find_end))
        travel[:, k] = min(find_end(paths[-1]) or 0.0, paths[-1].travel[-1]) * motion.load
        if count == 1 and not clock.relaxation:
            balances[True,] = balance
    march = _March(base, layers, paths, clock, balances)
    rows = [march.step(travel[t], extra_loads[t], t) for t in range(frames)]
    return DrivenPath(*(np.stack(column) for column in zip(*rows, strict=True)))


def _find_end(gesture: Gesture, young_kpa: float, clock: Clock, frames: int, path: _Drive) -> float | None:
    plan = gesture.drive
    assert plan is not None
    if plan.force_mn is None:
        return plan.travel_mm
    load = tool_gesture.trajectory(gesture, frames).load
    return find_travel(path, plan.force_mn / young_kpa, load, clock)


class _March:
    """Steps in time under several driven instruments."""

    def __init__(
        self,
        base: System,
        layers: Sequence[Layer],
        paths: Sequence[_Drive],
        clock: Clock,
        balances: dict[tuple[bool, ...], Balance],
    ) -> None:
        self._base, self._layers, self._paths, self._clock = base, layers, paths, clock
        self._balances, self._history = balances, PronyHistory(clock)
        self._elastic_system = replace(base, hold=sp.csr_array(base.hold.shape), slip=None)
        self._faint_energy = _FAINT * max((path.energy[-1] for path in paths), default=0.0)
        self._last_u = self._earlier_u = np.zeros((base.mesh.nodes, 3))
        self._last_travel, self._released = np.zeros(len(layers)), np.zeros(len(layers), bool)

    def step(
        self, travel: Floats, extra_load: Floats, frame: int
    ) -> tuple[Floats, float, float, float, Floats, Mask]:
        """Displacement (N, 3) mm, least J, stored energy, residual, the ways (I,) mm and which instruments
        hold tissue, a step later. Raises ExcessiveLoad, with the frame."""
        is_advancing = travel > self._last_travel
        in_contact = (travel > 0) & (~self._released | is_advancing)
        while True:
            try:
                u, min_jacobian, energy, residual = self._settle(travel, extra_load, in_contact)
            except ExcessiveLoad as error:
                raise type(error)(f"frame {frame}: {error}") from None
            is_pulling = np.zeros(len(travel), bool)
            for k in np.flatnonzero(in_contact & (self._released | ~is_advancing)).tolist():
                layer = self._layers[k]
                push = float(layer.reaction(u, travel[k]) @ np.asarray(layer.gesture.direction))
                is_pulling[k] = push < 0
            if not is_pulling.any():
                break
            in_contact &= ~is_pulling
        if self._clock.relaxation:
            self._history.update(self._elastic_system.state(u).force)
        self._released = ~in_contact & (travel > 0)
        self._earlier_u, self._last_u, self._last_travel = self._last_u, u, travel
        return u, min_jacobian, energy, residual, travel, in_contact

    def _settle(
        self, travel: Floats, extra_load: Floats, in_contact: Mask
    ) -> tuple[Floats, float, float, float]:
        rest_u = np.zeros_like(self._last_u)
        if not in_contact.any() and not extra_load.any() and not self._clock.relaxation:
            return rest_u, 1.0, 0.0, 0.0
        key = tuple(in_contact.tolist())
        contacts = [k for k, contact in enumerate(key) if contact]
        if key not in self._balances:
            relative_stiffness = self._clock.relative_stiffness
            springs = sum(
                (self._layers[k].springs for k in contacts), start=sp.csr_array(self._base.stiffness.shape)
            )
            balance = Balance(self._base, springs, relative_stiffness)
            middle = sum(
                (self._paths[k].interpolate(_MIDDLE * self._paths[k].travel[-1]) for k in contacts),
                start=rest_u,
            )
            if contacts:  # most frames are nearer to this state than to rest
                balance.approach(middle)
            self._balances[key] = balance
        base_load = self._history.add_to(extra_load)

        def find(travels: Floats, start: Floats, fallback: Floats) -> tuple[Floats, float, float, float]:
            load = sum((self._layers[k].pull(travels[k]) for k in contacts), start=base_load)
            min_jacobian = _SLACK * LEAST_JACOBIAN
            return self._balances[key].find(load, start, fallback, self._faint_energy, min_jacobian)

        superposition = sum((self._paths[k].interpolate(travel[k]) for k in contacts), start=rest_u)
        prediction = (
            superposition
            + self._last_u
            - sum((self._paths[k].interpolate(self._last_travel[k]) for k in contacts), start=rest_u)
        )
        if not contacts:
            prediction = self._last_u + 0.7 * (self._last_u - self._earlier_u)
        # A surface in compression may crease in several ways; the way that the drive found is one of them.
        for start in (prediction, superposition):
            try:
                return find(travel, start, self._last_u)
            except ExcessiveLoad:
                continue
        u = self._last_u
        for fraction in np.linspace(0, 1, _SUBSTEPS + 1)[1:]:
            state = find(self._last_travel + fraction * (travel - self._last_travel), u, u)
            u = state[0]
        return state
