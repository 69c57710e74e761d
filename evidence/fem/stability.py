"""Where the physics breaks: sweeps of load, Poisson's ratio, slivers, ramp, mesh size; random scenes."""

from __future__ import annotations

import multiprocessing
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench.output import charts, result_page
from evidence.fem import case as fem_case
from evidence.measuring import measuring
from synth.checks import physics
from synth.errors import UserError
from synth.fem import equilibrium, motion, solver, surface_embedding, tool
from synth.fem.laws import NUMBER
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.element import quality
from synth.fem.mesh.tetrahedra import Tets
from synth.fem.system import assemble
from synth.job import schema
from synth.job.law_limits import LEAST_JACOBIAN
from synth.sequence import pipeline, scenario

Floats = NDArray[np.float64]
Row = dict[str, Any]

_LOADS = (0.01, 0.05, 0.1, 0.2, 0.4, 0.8, 1.5, 3.0)
_POISSONS = (0.0, 0.3, 0.4, 0.45, 0.49, 0.495, 0.499)
_CONTACT = fem_case.CONTACTS[0]
_VERTICES, _CHUNK = 10_000, 50
_SMALL: dict[str, Any] = {"anatomy": {"vertices": 10_000}}


@measuring(
    "--scenes 100 --out runs/fem",
    said="Folder for data, picture and page.",
    file="stability.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
def stability(
    scenes: Annotated[int, typer.Option(help="Random scenes of the default ranges.", min=0)] = 1000,
    tets: Annotated[int, typer.Option(help="Tetrahedra of every scene and sweep.", min=100)] = 700,
    seed: Annotated[int, typer.Option(help="Of the random scenes.")] = 0,
    workers: Annotated[int, typer.Option(help="Processes.", min=1)] = 1,
) -> dict[str, Any]:
    """Where each law leaves its tolerance, loses equilibrium or inverts, and which guard caught it."""
    sweeps: list[Callable[[int], list[Row]]] = [loads, poissons, ramps, sizes, slivers, steps]
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=context) as pool:
        chunks = [
            pool.submit(random_scenes, min(_CHUNK, scenes - first), tets, seed, first)
            for first in range(0, scenes, _CHUNK)
        ]
        living = [
            pool.submit(random_scenes, min(_CHUNK, scenes - first), tets, seed, first, everything=True)
            for first in range(0, scenes, _CHUNK)
        ]
        rows = [row for part in pool.map(_run, sweeps, [tets] * len(sweeps)) for row in part]
        return {
            "rows": rows,
            "random_scenes": _added([chunk.result() for chunk in chunks]),
            "with_everything": _added([chunk.result() for chunk in living]),
        }


def _run(sweep: Callable[[int], list[Row]], tets: int) -> list[Row]:
    return sweep(tets)


def attempt(sweep: str, law: str, way: str, value: float, run: Callable[[], tuple[Floats, float]]) -> Row:
    """One row: what came of a run that gives displacement and its error; a refusal is an outcome too."""
    row: Row = {"sweep": sweep, "law": law, "way": way, "value": value, "error": None, "guard": None}
    try:
        u, error = run()
    except UserError as refusal:
        return row | {"guard": type(refusal).__name__, "outcome": str(refusal)}
    if not np.isfinite(u).all():
        return row | {"outcome": "SILENT NaN"}
    return row | {"error": error, "outcome": f"error {100 * error:.2f}%"}


def loads(tets: int) -> list[Row]:
    """P from 0.01 to 3 for every law, against neo-Hookean on the same mesh."""
    on = fem_case.patch(_VERTICES)
    cases = {law: fem_case.brain(on, law, 2, tets, _CONTACT) for law in NUMBER}
    rows = []
    for load in _LOADS:
        for way in fem_case.WAYS:
            try:
                true: Floats | None = fem_case.moved(cases["neo-hookean"], load, way, 8)
            except UserError:
                true = None
            for law in NUMBER:

                def run(
                    law: str = law, way: str = way, load: float = load, true: Floats | None = true
                ) -> tuple[Floats, float]:
                    u = fem_case.moved(cases[law], load, way, 8)
                    return u, float("nan") if true is None else fem_case.error(u, true, on)

                rows.append(attempt("load", law, way, load, run))
    return rows


def poissons(tets: int) -> list[Row]:
    """Poisson's ratio up to 0.499 for both orders: linear elements lock, quadratic ones do not."""
    on, rows = fem_case.patch(_VERTICES), []
    for poisson in _POISSONS:
        fine = fem_case.moved(fem_case.brain(on, "linear", 2, 4 * tets, _CONTACT, poisson), 0.1, "push", 1)
        for order in (1, 2):

            def run(
                order: int = order, fine: Floats = fine, poisson: float = poisson
            ) -> tuple[Floats, float]:
                case = fem_case.brain(on, "linear", order, tets, _CONTACT, poisson)
                u = fem_case.moved(case, 0.1, "push", 1)
                return u, fem_case.error(u, fine, on)

            rows.append(attempt("poisson", f"linear P{order}", "push", poisson, run))
    return rows


def ramps(tets: int) -> list[Row]:
    """The load at once or in many steps: elastic equilibrium must not know."""
    on, rows = fem_case.patch(_VERTICES), []
    for law in ("corotational", "stable", "neo-hookean"):
        case = fem_case.brain(on, law, 2, tets, _CONTACT)
        for load in (0.15, 0.4, 0.8):
            try:
                slow: Floats | None = fem_case.moved(case, load, "push", 40)
            except UserError:
                slow = None
            for steps in (1, 2, 5, 20):

                def run(
                    steps: int = steps,
                    slow: Floats | None = slow,
                    load: float = load,
                    case: fem_case.Brain = case,
                ) -> tuple[Floats, float]:
                    u = fem_case.moved(case, load, "push", steps)
                    return u, float("nan") if slow is None else fem_case.error(u, slow, on)

                rows.append(attempt("ramp", f"{law} P={load:g}", "push", steps, run))
    return rows


def sizes(tets: int) -> list[Row]:
    """Mesh size: coarse meshes are stiff, fine ones feel more of the strain under the contact."""
    on, rows = fem_case.patch(_VERTICES), []
    fine = fem_case.moved(fem_case.brain(on, "neo-hookean", 2, 6 * tets, _CONTACT), 0.4, "push", 4)
    for law in NUMBER:
        for count in (tets // 4, tets // 2, tets, 2 * tets, 3 * tets):

            def run(law: str = law, count: int = count) -> tuple[Floats, float]:
                u = fem_case.moved(fem_case.brain(on, law, 2, count, _CONTACT), 0.4, "push", 4)
                return u, fem_case.error(u, fine, on)

            rows.append(attempt("size", law, "push", count, run))
    return rows


def steps(tets: int) -> list[Row]:
    """Time step of the paper's dynamics (1 kg, damping 2), to 1 s: where a ramp and 6 s of hold end.

    The error is against quasi-static equilibrium; what is left at small steps has not died out yet.
    """
    rows = []
    whole = tetrahedra.block(fem_case.ANATOMY, tets, 2, (_CONTACT,))
    on = fem_case.patch(3600)
    pressure = tool.footprint(np.array(_CONTACT[:2]), _CONTACT[2], on.vertices, on.area)
    force = 0.15 * _CONTACT[2] ** 2 * np.outer(on.area * pressure, [0.0, 0.0, 1.0])
    peak = surface_embedding.embed(whole, on.vertices).gather(force)
    for law in NUMBER:
        case = assemble(whole, law, 0.4, averaged=True)
        still = equilibrium.solve_path(case, np.stack([0.5 * peak, peak]), np.full(2, 0.15)).displacement[-1]
        for step in (0.03, 0.1, 0.3, 1.0):

            def run(step: float = step, law: str = law, still: Floats = still) -> tuple[Floats, float]:
                at = np.minimum(np.arange(0, 7 + step / 2, step), 1.0)
                clock = motion.Clock(step, 1, 1.0, 2.0)
                loads = at[:, None, None] * peak
                path = motion.march_in_time(whole, law, 0.4, 0.5, loads, 0.15 * at, clock, averaged=True)
                gap = path.displacement[-1] - still
                return path.displacement[-1], float(np.linalg.norm(gap) / np.linalg.norm(still))

            rows.append(attempt("dt", law, "pull", step, run))
    return rows


def slivers(tets: int) -> list[Row]:
    """A corner of one tetrahedron under the contact pressed towards its opposite face.

    The corner nearest to 6 mm under the contact that can be pressed flat without turning another inside out.
    """
    on, rows = fem_case.patch(_VERTICES), []
    whole = tetrahedra.block(fem_case.ANATOMY, tets, 1, (_CONTACT,))
    carry = surface_embedding.embed(whole, on.vertices)
    pressure = tool.footprint(np.array(_CONTACT[:2]), _CONTACT[2], on.vertices, on.area)
    centre = whole.points[whole.cells].mean(axis=1)
    nearest = np.linalg.norm(centre - [0, 0, -6.0], axis=1).argsort()
    cell, corner = next((m, k) for m in nearest for k in range(4) if _alone(_pressed(whole, m, k, 0.0), m))
    for law in NUMBER:
        true = None
        for flat in (1.0, 0.3, 0.1, 0.03, 0.01, 1e-3, 1e-4, 1e-8):

            def run(flat: float = flat, law: str = law, true: Floats | None = true) -> tuple[Floats, float]:
                system = assemble(_pressed(whole, cell, corner, flat), law, 0.4)
                case = fem_case.Brain(system, carry, on.area * pressure, _CONTACT[2])
                u = fem_case.moved(case, 0.2, "pull", 3)
                return u, 0.0 if true is None else fem_case.error(u, true, on)

            rows.append(attempt("sliver", law, "pull", flat, run))
            if true is None:
                true = run()[0]
    return rows


def _pressed(whole: Tets, cell: int, corner: int, flat: float) -> Tets:
    """The mesh with one corner of a tetrahedron at the part `flat` of its height."""
    points, at = whole.points.copy(), whole.cells[cell, corner]
    base = points[np.delete(whole.cells[cell], corner)].mean(axis=0)
    points[at] = base + flat * (points[at] - base)
    return replace(whole, points=points)


def _alone(bent: Tets, cell: int) -> bool:
    """Whether all the others are of a fair shape."""
    return bool(np.delete(quality(bent.points[bent.cells]), cell).min() > 0.05)


def living(seed: int, index: int) -> Row:
    """Keys of `fem` that put in all there is: membrane, pulse, nu, skull, elements, how tools touch."""
    rng = np.random.default_rng((seed, index))
    return {
        "membrane": {"intact": 0.7},
        "pulse": {"heart_mm": (0.0, 0.5), "breath_mm": (0.0, 0.6)},
        "poisson": (0.4, 0.49),
        "skull": ("bonded", "slip"),
        "volume": str(rng.choice(["auto", "pointwise"], p=[0.8, 0.2])),
        "contact": str(rng.choice(["traction", "rigid"])),
        "tip": str(rng.choice(["flat", "sphere"])),
        "friction": round(float(rng.uniform(0, 1)), 3),
        "instruments": (1, 2),
    }


def random_scenes(
    count: int, tets: int, seed: int, first: int = 0, frames: int = 12, *, everything: bool = False
) -> Row:
    """Scenes of the default job: each ends whole or refused by a named guard, or is counted as silent.

    With `everything`, of one that has all that can be asked for, drawn scene by scene (`living`).
    """
    outcome: Counter[str] = Counter()
    least, kinds, refusals, largest, over = np.inf, Counter[str](), [], 0.0, 0.0
    for index in range(first, first + count):
        asked = {"tets": tets} | (living(seed, index) if everything else {})
        job = schema.Job.model_validate(
            {"seed": seed, "sequences": 10**6, "frames": frames, "fem": asked} | _SMALL
        )
        case = scenario.draw(job, index)
        try:
            motion = pipeline.move(job, case, *pipeline.build(job, case))
        except UserError as refusal:
            outcome[type(refusal).__name__] += 1
            gesture = case.gesture
            refusals.append({"index": index, "kind": gesture.kind, "load": gesture.load, "why": str(refusal)})
            continue
        total = np.einsum("v,tvd->td", motion.area, motion.traction)
        numbers = (motion.displacement, motion.traction, motion.tip, motion.energy)
        if not all(np.isfinite(n).all() for n in numbers):
            outcome["silent NaN"] += 1
        elif motion.min_jacobian.min() <= LEAST_JACOBIAN:
            outcome["silent inversion"] += 1
        elif np.abs(total - motion.force).max() > 1e-9 * np.abs(motion.force).max():
            outcome["force not kept"] += 1
        else:
            outcome["whole"] += 1
        kinds[case.gesture.kind] += 1
        least = min(least, float(motion.min_jacobian.min()))
        over = max(over, over_verify(motion, case, rigid=job.fem.contact == "rigid"))
        if case.pulse is None:
            largest = max(largest, *compliance_steps(motion).values())
    return {
        "scenes": count,
        "tets": tets,
        "frames": frames,
        "outcome": dict(outcome),
        "whole_by_gesture": dict(kinds),
        "least_jacobian": least,
        "largest_step": largest,
        "over_verify": over,
        "refusals": refusals,
    }


def over_verify(motion: solver.Deformation, case: scenario.Scenario, *, rigid: bool) -> float:
    """Largest step of displacement per force over what `synth verify` allows: 1 is its limit."""
    work = motion.energy if case.pulse is None else motion.tool_work
    pulse = None if case.pulse is None else motion.pulse_work
    tips, footprint = motion.tip if rigid else None, case.gesture.footprint_mm
    steps = physics.compliance_steps(work, motion.by_instrument, tips, footprint, pulse)
    return max((step / limit for _, step, limit in steps), default=0.0)


def compliance_steps(motion: solver.Deformation) -> dict[str, float]:
    """Largest change of displacement per force from a frame to the next while the force is even within 2%:
    of the peak and of the mean under the load."""
    size = np.linalg.norm(motion.force, axis=1)
    peak = np.linalg.norm(motion.displacement, axis=2).max(axis=1)
    weight = motion.area * np.linalg.norm(motion.traction, axis=2)
    mean = np.linalg.norm(np.einsum("tv,tvd->td", weight, motion.displacement), axis=1)
    mean /= np.maximum(weight.sum(axis=1), 1e-12)
    even = np.flatnonzero(
        (np.minimum(size[1:], size[:-1]) > 0.05 * size.max()) & (np.abs(np.diff(size)) < 0.02 * size.max())
    )
    found = {}
    for name, value in (("peak", peak), ("mean", mean)):
        log = np.log(np.maximum(value, 1e-12) / np.maximum(size, 1e-12))
        found[name] = float(np.expm1(np.abs(np.diff(log))[even]).max(initial=0.0))
    return found


def _added(parts: list[Row]) -> Row:
    """The parts of the random scenes as one."""
    whole: Row = {"scenes": 0, "outcome": Counter(), "whole_by_gesture": Counter(), "refusals": []}
    for part in parts:
        whole["scenes"] += part["scenes"]
        whole["outcome"].update(part["outcome"])
        whole["whole_by_gesture"].update(part["whole_by_gesture"])
        whole["refusals"] += part["refusals"]
        whole |= {name: part[name] for name in ("tets", "frames")}
        for name in ("largest_step", "over_verify"):
            whole[name] = max(whole.get(name, 0.0), part[name])
        whole["least_jacobian"] = min(whole.get("least_jacobian", np.inf), part["least_jacobian"])
    return whole


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    tables = [result_page.Section("All runs", found["rows"])]
    return result_page.Page("Physics: where it breaks", found, panels(found), tables)


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """Charts of `stability.json`: error over each thing that is made worse."""
    rows: list[Row] = found["rows"]
    axes = {
        "load": "P = F/(E a2)",
        "poisson": "Poisson's ratio",
        "size": "tetrahedra",
        "sliver": "height left [share]",
        "ramp": "steps to the peak",
        "dt": "time step [s]",
    }
    made = []
    for sweep, axis in axes.items():
        ours = [r for r in rows if r["sweep"] == sweep and r["error"] is not None and np.isfinite(r["error"])]
        ours = [r for r in ours if r["way"] != "aside" and (sweep != "load" or r["way"] == "push")]
        curves = tuple(
            charts.Curve(
                law,
                tuple(r["value"] for r in ours if r["law"] == law),
                tuple(max(100 * r["error"], 1e-3) for r in ours if r["law"] == law),
            )
            for law in dict.fromkeys(r["law"] for r in ours)
        )
        made.append(charts.Panel(f"Physics: {sweep}", axis, "error [%]", curves, sweep != "poisson", True))
    return made
