"""Error of the physics against cost by law and mesh, error of each law by load, and cost of a sequence."""

import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from evidence import report
from evidence.fem import fem_case as fem_case
from evidence.study import Study
from synth.arrays import Floats
from synth.fem import solver
from synth.fem.equilibrium import InvertedElement, NoEquilibrium
from synth.fem.laws import NUMBER
from synth.fem.material import Tissue
from synth.fem.mesh import tetrahedra
from synth.geometry.triangles import Shape
from synth.job import schema
from synth.sequence.draw import read_scheme

Row = dict[str, Any]

_LOADS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
_SETTINGS = (
    *((law, 1600) for law in NUMBER),
    *((law, tets) for law in ("linear", "neo-hookean") for tets in (700, 2500)),
)
_FRAMES = 60


def measure(load: float = 0.3, refined: int = 8000, contacts: int = 2) -> Row:
    """Error against CPU time a frame by law and size, and costs.

    `load`: P = F/(E a^2) at which laws are compared; `refined`: tetrahedra of the references; `contacts`:
    number of contacts, at most four.
    """
    surface, context = fem_case.patch(), multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, context, max_tasks_per_child=1) as pool:
        costs = list(pool.map(sequence, ("linear", "neo-hookean")))
    return {
        "rows": discretisation(surface, refined, contacts, load),
        "laws": law_table(surface),
        "sequence": costs,
    }


def discretisation(surface: fem_case.Patch, refined: int, contacts: int, load: float) -> list[Row]:
    """Rows of law and size: `mesh_error` against the refined mesh at the same nu (linear law; 0.4 and 0.49),
    `error` against refined neo-Hookean at the load."""
    default = ("neo-hookean", schema.FemSection().tets)
    total: dict[tuple[str, int], list[dict[str, float]]] = {setting: [] for setting in _SETTINGS}
    for contact in fem_case.CONTACTS[:contacts]:
        exact = {nu: _small(surface, refined, contact, nu) for nu in (0.4, 0.49)}
        reference_case = fem_case.brain(surface, "neo-hookean", refined, contact)
        reference = {
            direction: fem_case.displace(reference_case, load, direction) for direction in ("push", "aside")
        }
        mesh_errors: dict[int, dict[str, float]] = {}
        for law, tets in _SETTINGS:
            if tets not in mesh_errors:
                mesh_errors[tets] = {
                    name: _mean_error(_small(surface, tets, contact, nu), exact[nu], surface)
                    for nu, name in ((0.4, "mesh_error"), (0.49, "mesh_error_049"))
                }
            case = fem_case.brain(surface, law, tets, contact)
            error = speed = float("nan")  # past the law's range
            with suppress(InvertedElement, NoEquilibrium):
                error = _mean_error(
                    {direction: fem_case.displace(case, load, direction) for direction in reference},
                    reference,
                    surface,
                )
                speed = fem_case.speed(case, load, "push")
            total[law, tets].append(mesh_errors[tets] | {"error": error, "ms_a_frame": speed})
    return [
        {"law": law, "tets": tets, "default": (law, tets) == default}
        | {name: _mean([row[name] for row in rows]) for name in rows[0]}
        | {"mesh_error_worst": max(row["mesh_error"] for row in rows)}
        for (law, tets), rows in total.items()
    ]


def _mean(values: list[float]) -> float | None:
    """Mean, or None if a value isn't finite."""
    return float(np.mean(values)) if np.isfinite(values).all() else None


def _small(
    surface: fem_case.Patch, tets: int, contact: tuple[float, float, float], poisson: float
) -> dict[str, Floats]:
    """Displacement by direction under the linear law."""
    case = fem_case.brain(surface, "linear", tets, contact, poisson)
    return {direction: fem_case.displace(case, 0.1, direction, 1) for direction in ("pull", "aside")}


def _mean_error(u: Mapping[str, Floats], exact: Mapping[str, Floats], surface: fem_case.Patch) -> float:
    return float(np.mean([fem_case.error(u[direction], exact[direction], surface) for direction in exact]))


def law_table(surface: fem_case.Patch) -> list[Row]:
    """Error of each law against neo-Hookean on the same mesh, by load and direction; None past its range."""
    cases = {law: fem_case.brain(surface, law, 1600, fem_case.CONTACTS[0]) for law in NUMBER}
    rows: list[Row] = []
    for load in _LOADS:
        for direction in fem_case.DIRECTIONS:
            displacements: dict[str, Floats] = {}
            for law, case in cases.items():
                with suppress(InvertedElement, NoEquilibrium):
                    displacements[law] = fem_case.displace(case, load, direction, 6)
            reference = displacements.pop("neo-hookean", None)
            for law in (law for law in NUMBER if law != "neo-hookean"):
                error = None
                if reference is not None and law in displacements:
                    error = fem_case.error(displacements[law], reference, surface)
                rows.append({"law": law, "load": load, "way": direction, "error": error})
    return rows


def sequence(law: str) -> Row:
    """CPU time and peak memory of this process for mesh and mechanics, 60 frames of 40,000 vertices."""
    surface, load = fem_case.patch(), 0.15
    fem = schema.FemSection(gestures=("pull",), load=(load, load))
    gesture, tissue = fem_case.pull(fem), Tissue(1.0, 0.4, law)
    start = time.process_time()
    volume = tetrahedra.block(fem.tets, gesture.focus)
    mesh_end = time.process_time()
    solver.deform(
        read_scheme(fem), tissue, [gesture], volume, Shape(surface.vertices, surface.faces), _FRAMES, 25.0
    )
    ms_a_frame = 1e3 * (time.process_time() - mesh_end) / _FRAMES
    # The kernel's high-water mark; getrusage would include the parent's memory before exec.
    status = Path("/proc/self/status").read_text("utf-8")
    peak = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmHWM"))
    row: Row = {"law": law, "load": load, "mesh_s": mesh_end - start, "ms_a_frame": ms_a_frame}
    return row | {"peak_rss_mb": peak * 1024 / 1e6}


def page(data: Mapping[str, Any]) -> report.Page:
    """Error of mesh and law against cost, and the largest error of each law by load."""
    rows = [row | {"error %": 100 * row["error"]} for row in data["rows"] if row["error"] is not None]

    def draw_cost(axes: Axes) -> None:
        groups = {law: law_rows for (law,), law_rows in report.group_rows(rows, "law").items()}
        axes.set(xlabel="CPU ms a frame", ylabel="error [%]", xscale="log", yscale="log")
        report.scatter(axes, groups, "ms_a_frame", "error %", "{law}, {tets}")
        report.set_log(axes)
        report.legend(axes)

    worst = worst_by_load(data["laws"])

    def draw_laws(axes: Axes) -> None:
        for law, by_load in worst.items():
            axes.plot([*by_load], [100 * error for error in by_load.values()], "-o", label=law)
        axes.set(title="Against neo-Hookean, worst direction", xlabel="P = F/(E a2)", ylabel="error [%]")
        report.set_log(axes)
        report.legend(axes)

    words = (
        "Errors are root mean squares over the opening, relative to the motion. `mesh_error`: against 8,000 "
        "tetrahedra of the linear law at ν 0.4 (`_049`: at 0.49; `_worst`: of the contacts), so of the mesh "
        "alone. `error`: against 8,000 neo-Hookean ones at P = 0.3, so of mesh and law.",
    )
    laws = [
        {"law": law} | {f"P {load:g}": f"{error:.1%}" for load, error in by_load.items()}
        for law, by_load in worst.items()
    ]
    sections = [
        report.Section("Meshes and laws", data["rows"]),
        report.Section("Error of a law against neo-Hookean, by load", laws, ("Worst direction:",)),
        report.Section("A sequence", data["sequence"]),
    ]
    chart = report.chart(draw_cost, draw_laws)
    return report.Page("Physics: error against cost", data, words, sections, chart)


def worst_by_load(rows: Sequence[Row]) -> dict[str, dict[float, float]]:
    """Of each law and load P the largest error over directions, of loads that every direction solves."""
    largest: dict[str, dict[float, float]] = {}
    for (law, load), group in report.group_rows(rows, "law", "load").items():
        if None not in (errors := [row["error"] for row in group]):
            largest.setdefault(law, {})[load] = max(errors)
    return largest


STUDY = Study(measure, "fem/pareto/pareto.json", page, needs=("mesh", "mechanics"), timed=True)
