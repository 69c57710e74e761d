"""Motion and load of a surface as another program computed them: states over time, checked, in mm and mN."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from synth.arrays import Floats, Ints, Map
from synth.errors import UserError, as_user_error
from synth.fem.external import plausibility
from synth.fem.surface_embedding import vertex_area
from synth.geometry.skin import skin
from synth.system.csv_table import read_csv, read_header
from synth.system.resources import refuse_excess

_LENGTHS = {1.0: "mm", 1000.0: "m", 10.0: "cm"}
_LIKELY_MM, _POSSIBLE_MM = (20.0, 400.0), (1.0, 2000.0)  # largest extent of a specimen
_ROUNDING = 1e-5  # relative to an extent or a largest force: files are in single precision
_LATEST_S = 1e9
_LARGEST = 1e30  # of a displacement or force: its square is summed in double precision
_MOST_STRETCH = 3.0  # of the width of a specimen
_DISPLACED = 0.3  # share of the largest displacement
_LEAST_LOAD = 0.01  # share of the largest load below which a surface counts as unloaded


@dataclass(frozen=True)
class Units:
    """What files of this kind do not state; None: not stated by the user either."""

    mm: float | None = None  # millimetres in the files' unit of length
    mn: float | None = None  # millinewtons in their unit of force
    dt_s: float | None = None  # seconds from state to state, where the files carry no time
    guess: bool = False  # whether millimetres are taken from the size of the surface


@dataclass(frozen=True, eq=False)
class MeshSeries:
    """Motion and load of an outer surface of N nodes over S states; axes are those of the files."""

    points: Floats  # (N, 3) mm at rest
    faces: Ints  # (F, 3)
    time: Floats  # (S,) s, from 0
    displacement: Map  # (S, N, 3) mm
    tip: Floats  # (S, I, 3) mm of the instruments
    shaft: Floats  # (S, I, 3) unit vectors from tip to hand
    unit_mm: float  # millimetres in the files' unit of length
    fields: tuple[str, ...]  # names of the vector fields at nodes
    timed: bool  # whether the files state times
    force: Map | None = None  # (S, N, 3) mN at nodes, on the surface from outside; None: not known
    cautions: tuple[str, ...] = ()  # what can't be right, or is unlikely for soft tissue; see `plausibility`

    @property
    def summary(self) -> str:
        """What it is, in one line."""
        size = " x ".join(f"{extent:.3g}" for extent in np.ptp(self.points, axis=0))
        max_mm = float(np.sqrt(np.einsum("snd,snd->sn", self.displacement, self.displacement).max()))
        load = "no force"
        if self.force is not None:
            load = f"force up to {np.linalg.norm(self.force.sum(axis=1), axis=1).max():.4g} mN"
        count = f"{len(self.time)} states over {self.time[-1]:.4g} s, {len(self.points)} nodes on the surface"
        return f"{count}, {size} mm, displacement up to {max_mm:.3g} mm, {load}"

    def at(self, time_s: float, name: str) -> Floats:
        """An array at a time, linear between states: float64 of the shape of one state."""
        values = getattr(self, name)
        after = int(np.clip(np.searchsorted(self.time, time_s), 1, len(self.time) - 1))
        before, span = self.time[after - 1], self.time[after] - self.time[after - 1]
        part = float(np.clip((time_s - before) / span, 0, 1))
        return np.asarray((1 - part) * values[after - 1] + part * values[after], np.float64)


class State(NamedTuple):
    """One state of all M points of a mesh, in the units of its file."""

    file: Path  # named in messages
    time: float  # s; NaN: not stated
    displacement: Floats  # (M, 3)
    force: Floats | None  # (M, 3) on the nodes, or per area at rest; None: not known


class OuterSurface(NamedTuple):
    """The outer surface among M points of a mesh; coincident points count once."""

    points: Floats  # (N, 3) at rest
    nodes: Ints  # (N,) their numbers in the mesh
    faces: Ints  # (F, 3) of the N
    place: Ints  # (M,) for each point the first one at the same place


def find_surface(points: Floats, cells: Mapping[int, Ints], file: Path) -> OuterSurface:
    """The outer surface of cells (see `skin`) of points (M, 3) at rest. UserError: there is none, or points
    are not finite or belong to several bodies."""
    if not len(points):
        raise UserError(f"{file}: has no points")
    if not np.abs(points).max() < _LARGEST:
        raise UserError(f"{file}: has coordinates that are not finite, or above {_LARGEST:g}")
    step = _ROUNDING * max(float(np.ptp(points, axis=0).max(initial=0)), 1e-12)
    _, first, place = np.unique(np.round(points / step), axis=0, return_index=True, return_inverse=True)
    place = first[place.ravel()]
    with as_user_error(str(file)):
        if any(cell.min(initial=0) < 0 for cell in cells.values()):
            raise ValueError("a cell refers to a missing point")
        cells = {kind: place[cell] for kind, cell in cells.items()}
        shell = skin(points, cells)
        sides = np.cross(points[shell[:, 1]] - points[shell[:, 0]], points[shell[:, 2]] - points[shell[:, 0]])
        area = np.linalg.norm(sides, axis=1)  # cells may be collapsed
        if not area.max(initial=0) > 0:
            raise ValueError("its surface has no area")
        nodes, faces = np.unique(shell[area > _ROUNDING**2 * area.max()], return_inverse=True)
    links = [np.stack([cell[:, :-1], cell[:, 1:]]).reshape(2, -1) for cell in cells.values()]
    graph = sp.coo_array((np.ones(sum(link.shape[1] for link in links)), np.hstack(links)), [len(points)] * 2)
    bodies = np.unique(connected_components(graph, directed=False)[1][nodes])
    if len(bodies) > 1:
        raise UserError(f"{file}: has {len(bodies)} separate bodies; write the tissue alone")
    return OuterSurface(points[nodes], nodes, faces.reshape(-1, 3), place)


def assemble(
    source: Path,
    surface: OuterSurface,
    units: Units,
    count: int,
    states: Iterable[State],
    fields: Sequence[str],
    per_area: bool = False,
) -> MeshSeries:
    """The series of `count` states, two at least, of a surface at rest, checked, and converted from units.

    `source` is named in messages; `fields`: names of vector fields at nodes; `per_area`: forces are those per
    area at rest. UserError: times that don't rise, a surface not at rest at first, points that part, values
    that are not finite, units that are missing or can't be, a force that can't be one of contact.
    """
    place, nodes = surface.place, surface.nodes
    files, times = list[Path](), list[float]()
    with as_user_error(f"{source}: {count} states"):
        refuse_excess(12 * count * len(nodes))
    displacement, force = np.empty((count, len(nodes), 3), np.float32), None
    for k, (file, time_s, u, load) in enumerate(states):
        _refuse_wild(surface.points, u[nodes], file)
        if np.abs(u - u[place]).max(initial=0) > _ROUNDING * max(float(np.abs(u).max()), 1e-9):
            raise UserError(f"{file}: points at one place move apart; write one body, with its nodes once")
        files.append(file)
        times.append(time_s)
        displacement[k] = u[nodes]
        if load is not None:
            force, nodal_force = np.zeros_like(displacement) if force is None else force, np.zeros_like(u)
            np.add.at(nodal_force, place, load)
            force[k] = _to_single(
                nodal_force[nodes] / (np.bincount(place)[nodes][:, None] if per_area else 1), file
            )
    _refuse_blank(displacement, files)
    timed, time = not np.isnan(times).all(), _check_times(times, files, units)
    scale = _find_unit_mm(surface.points, units, source)
    points = scale * surface.points
    displacement *= np.float32(scale)  # in place: series may be large
    extent, largest = float(np.ptp(points, axis=0).max()), float(max(displacement.max(), -displacement.min()))
    if not np.isfinite(extent + largest + (0.0 if force is None else float(force.sum()))):
        raise UserError(f"{source}: has values that are not finite")
    if (offset_mm := float(np.abs(displacement[0]).max())) > _ROUNDING * extent:
        raise UserError(f"{source}: the first state is displaced by {offset_mm:.3g} mm; it has to be at rest")
    displacement -= displacement[0].copy()
    if largest < 1e-4 * extent:
        names = ", ".join(fields) or "none"
        hint = f"is unit_mm right, and which of its vectors ({names}) displacement?"
        raise UserError(f"{source}: its surface of {extent:.3g} mm moves by {largest:.2g} mm only; {hint}")
    no_instruments = np.zeros((len(time), 0, 3))  # instruments
    cautions = plausibility.find_permutations(points, surface.faces, displacement, nodes, files)
    cautions += plausibility.find_speed_doubts(displacement, time)
    cautions += plausibility.find_exchanged_states(displacement, time)
    metadata = scale, tuple(fields), timed, None, tuple(cautions)
    series = MeshSeries(points, surface.faces, time, displacement, no_instruments, no_instruments, *metadata)
    if force is None:
        return series
    area = vertex_area(points, surface.faces)[:, None] / scale**2 if per_area else 1.0
    with np.errstate(over="ignore", invalid="ignore"):  # `add_force` refuses what is infinite
        force *= np.asarray(_require_unit_mn(units, source) * area, np.float32)
    return add_force(series, force, source)


def _to_single(values: Floats, file: Path) -> Map:
    """Values (N, 3) in single precision. UserError: they are too large for it, or not finite."""
    if not np.abs(values).max(initial=0) < _LARGEST:
        raise UserError(f"{file}: has values that are not finite, or above {_LARGEST:g}")
    return values.astype(np.float32)


def _refuse_wild(points: Floats, displacement: Floats, file: Path) -> None:
    """Raises UserError for displacement (N, 3) of points (N, 3) that isn't finite, or no motion of tissue."""
    _to_single(displacement, file)
    extent, largest = float(np.ptp(points, axis=0).max()), float(np.abs(displacement).max(initial=0))
    if largest > extent:
        ratio = f"{largest / max(extent, 1e-300):.3g} times the width of its surface"
        what = f"is displaced by {largest:.3g}, {ratio}"
        raise UserError(f"{file}: {what}; are they in one unit, and do nodes keep their numbers?")
    width = float(np.ptp(points + displacement, axis=0).max())
    if not extent / _MOST_STRETCH <= width <= _MOST_STRETCH * extent:
        raise UserError(f"{file}: its surface is {width:.3g} wide, at rest {extent:.3g}; are values missing?")


def _refuse_blank(displacement: Map, files: list[Path]) -> None:
    """Raises UserError for a state at rest between two that are displaced: one that wasn't written."""
    size = np.abs(displacement).max(axis=(1, 2), initial=0)
    is_displaced = size > _DISPLACED * size.max()
    for k in np.flatnonzero((size[1:-1] == 0) & is_displaced[:-2] & is_displaced[2:]) + 1:
        hint = "is one missing? Leave it out, or store states next to it"
        raise UserError(f"{files[k]}: state {k} is at rest, those before and after it are displaced; {hint}")


def _check_times(times: list[float], files: list[Path], units: Units) -> Floats:
    """Times (S,) s from 0, as stated by the files or `dt_s`. UserError: none, or they don't rise."""
    if (is_late := np.abs(times) > _LATEST_S).any():
        raise UserError(f"{files[state := int(is_late.argmax())]}: its time is {times[state]:g} s")
    if np.isnan(times).all():
        if units.dt_s is None:
            raise UserError(f"{files[0]}: states no time; mechanics.dt_s is needed, seconds between states")
        return np.arange(len(times), dtype=np.float64) * units.dt_s
    if not (is_rising := np.diff(times) > 0).all():
        state = int(np.argmin(is_rising)) + 1
        raise UserError(f"{files[state]}: its time {times[state]:g} s does not follow {times[state - 1]:g} s")
    return np.asarray(times, np.float64) - times[0]


def _require_unit_mn(units: Units, source: Path) -> float:
    """Millinewtons in the unit of force. UserError if it is not stated."""
    if units.mn is None:
        raise UserError(f"{source}: mechanics.unit_mn is needed, the unit of forces: 1000 for N, 1 for mN")
    return units.mn


def add_force(series: MeshSeries, force: Map, source: Path) -> MeshSeries:
    """The series with forces (S, N, 3) mN on its nodes. UserError: they can't be those of a contact."""
    size, motion = np.sqrt(np.einsum("snd,snd->sn", force, force)).sum(axis=1), series.displacement
    peak = int(np.maximum(motion.max(axis=(1, 2)), -motion.min(axis=(1, 2))).argmax())
    if not size.max() < _LARGEST:
        raise UserError(f"{source}: has forces that are not finite, or above {_LARGEST:g} mN")
    if size[0] > 1e-3 * size.max():
        raise UserError(f"{source}: the first state bears {size[0]:.3g} mN; it has to be at rest")
    if size[peak] <= _LEAST_LOAD * size.max():
        raise UserError(
            f"{source}: where the surface is displaced most the force is {size[peak]:.2g} mN; a net force "
            "is 0 wherever the tissue is held (as that of SOFA's Monitor): give the force of the contact"
        )
    if plausibility.is_rigid(series.points, motion[k := int(size.argmax())]):
        raise UserError(
            f"{source}: state {k} bears {size[k]:.3g} mN and moves as a rigid body: no tissue is deformed by "
            "that force; is the displacement that of the tissue?"
        )
    force[0] = 0.0
    return replace(series, force=force)


def press(series: MeshSeries, table: Path, units: Units, patch_mm: float) -> MeshSeries:
    """The series with the total force of a table, spread as 1 - (r/a)^2 over the nodes within `patch_mm`, a.

    `table`: .csv with columns time [s, that of the first state first], fx, fy, fz, and x, y, z of the
    contact's centre at rest, in the files' units and axes. UserError: no such table, or no node near a point.
    """
    unit_mn = _require_unit_mn(units, table)
    rows = _interpolate_table(series, table, ("fx", "fy", "fz", "x", "y", "z"))
    area, force = vertex_area(series.points, series.faces), np.zeros_like(series.displacement)
    for k, row in enumerate(rows):
        distance = np.linalg.norm(series.points - series.unit_mm * row[3:], axis=1)
        share = area * np.maximum(1 - np.square(distance / patch_mm), 0)
        if not share.any() and row[:3].any():
            fault = f"no node within {patch_mm:g} mm of the contact at {series.time[k]:g} s"
            raise UserError(f"{table}: {fault}; is its unit that of the files?")
        with np.errstate(over="ignore", invalid="ignore"):
            force[k] = unit_mn * row[:3] * (share / max(share.sum(), 1e-12))[:, None]
    return add_force(series, force, table)


def equip(series: MeshSeries, table: Path) -> MeshSeries:
    """The series with instruments: columns time, and for each I from 0 on xI, yI, zI of the tip and uI, vI,
    wI from it to the hand. UserError: no such table."""
    if (count := sum(name.startswith("x") for name in read_header(table))) not in (1, 2, 3):
        raise UserError(
            f"{table}: has the tips x0, x1, ... of {count} instruments, one to three are possible"
        )
    names = [f"{axis}{k}" for k in range(count) for axis in "xyzuvw"]
    rows = _interpolate_table(series, table, names).reshape(len(series.time), count, 6)
    size = np.linalg.norm(rows[..., 3:], axis=2, keepdims=True)
    if not size.all():
        raise UserError(f"{table}: a direction to the hand, u v w, is 0")
    return replace(series, tip=series.unit_mm * rows[..., :3], shaft=rows[..., 3:] / size)


def _interpolate_table(series: MeshSeries, table: Path, names: Sequence[str]) -> Floats:
    """Columns (S, len(names)) of a table, linear between rows. UserError: it does not cover the states."""
    columns = read_csv(table, ("time", *names))
    time = columns["time"] - columns["time"][0]
    rows = np.stack([columns[name] for name in names], axis=1)
    if not np.isfinite([*rows.ravel(), *time]).all() or not (np.diff(time) > 0).all():
        raise UserError(f"{table}: times don't rise, or a value is missing")
    if series.time[-1] > time[-1] + 1e-6:
        raise UserError(f"{table}: lasts {time[-1]:g} s, the series {series.time[-1]:g} s")
    return np.stack([np.interp(series.time, time, column) for column in rows.T], axis=1)


def _find_unit_mm(points: Floats, units: Units, source: Path) -> float:
    """Millimetres in the unit of length. UserError if it is not stated, or can't be that of a specimen."""
    extent = float(np.ptp(points, axis=0).max())
    (low, high), (least, most) = _LIKELY_MM, _POSSIBLE_MM
    candidates = {mm: name for mm, name in _LENGTHS.items() if low <= mm * extent <= high}
    hint = " or ".join(f"{mm:g} for {name}" for mm, name in candidates.items()) or "1 for mm, 1000 for m"
    if units.mm is None:
        if units.guess and candidates:
            return next(iter(candidates))
        text = f"its surface is {extent:.3g} units wide"
        raise UserError(f"{source}: mechanics.unit_mm is needed; {text}: {hint}?")
    if not least <= units.mm * extent <= most:
        text = f"its surface is {units.mm * extent:.3g} mm wide"
        raise UserError(f"{source}: with mechanics.unit_mm {units.mm:g} {text}; {hint}?")
    return units.mm
