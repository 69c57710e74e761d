"""The physics' error against its cost, for law, order and size; and what each law is worth at each load."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np
import typer

from bench.output import charts, result_page
from evidence.fem import case as fem_case
from evidence.fem import cost as fem_cost
from evidence.measuring import measuring
from synth.fem.equilibrium import InvertedElement, NoEquilibrium
from synth.fem.laws import NUMBER
from synth.job.schema import Fem

_LOADS = (0.02, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.0)
_SETTINGS = (
    *((law, 2, 1600) for law in NUMBER),
    *(("corotational", 1, n) for n in (1600, 4096)),
    *((law, 1, 10_000) for law in ("linear", "neo-hookean")),
    *((law, 2, n) for law in ("linear", "neo-hookean") for n in (700, 2500)),
)


@measuring(
    "--load 0.3 --out runs/fem",
    said="Folder for data, picture and page.",
    file="pareto.json",
    page=lambda found, out: result_page.write(drawn(found), out),
)
def pareto(
    load: Annotated[float, typer.Option(help="P = F/(E a^2) at which laws are compared.")] = 0.3,
    refined: Annotated[int, typer.Option(help="Tetrahedra of the reference, quadratic.")] = 9000,
    contacts: Annotated[int, typer.Option(help="How many of the four contacts.", min=1, max=4)] = 4,
) -> dict[str, Any]:
    """Error against CPU time a frame, for law, order and size; what gestures and a whole sequence cost."""
    on = fem_case.patch()
    return {
        "meaning": "errors: relative root mean square of displacement in the opening; ms_a_frame: CPU, one "
        "core, 60 frames, 40,000 vertices moved",
        "rows": discretisation(on, refined, contacts, load),
        "laws": law_table(on),
        "gestures": fem_cost.gestures(on, 0.15),
        "sequence": [fem_cost.sequence("linear", 0.15), fem_cost.sequence("neo-hookean", 0.4)],
    }


def discretisation(on: fem_case.Patch, refined: int, contacts: int, load: float) -> list[dict[str, Any]]:
    """Rows of law, order and size: `mesh_error` against refined linear P2 at the same nu (linear law; 0.4 and
    0.49), `error` against refined neo-Hookean P2 at the load."""
    default = (Fem().order, Fem().tets)
    total: dict[tuple[str, int, int], list[dict[str, float]]] = {s: [] for s in _SETTINGS}
    for contact in fem_case.CONTACTS[:contacts]:
        ways = ("pull", "aside")
        exact = {}
        for poisson in (0.4, 0.49):
            fine = fem_case.brain(on, "linear", 2, refined, contact, poisson)
            exact[poisson] = {way: fem_case.moved(fine, 0.1, way, 1) for way in ways}
        true = fem_case.brain(on, "neo-hookean", 2, refined, contact)
        whole = {way: fem_case.moved(true, load, way) for way in ("push", "aside")}
        del fine, true
        meshed: dict[tuple[int, int], dict[str, float]] = {}
        for law, order, tets in _SETTINGS:
            if (order, tets) not in meshed:
                errors = {}
                for poisson, name in ((0.4, "mesh_error"), (0.49, "mesh_error_049")):
                    case = fem_case.brain(on, "linear", order, tets, contact, poisson)
                    each = [
                        fem_case.error(fem_case.moved(case, 0.1, way, 1), exact[poisson][way], on)
                        for way in ways
                    ]
                    errors[name] = float(np.mean(each))
                meshed[order, tets] = errors
            case = fem_case.brain(on, law, order, tets, contact)
            each = [fem_case.error(fem_case.moved(case, load, way), whole[way], on) for way in whole]
            total[law, order, tets].append(
                meshed[order, tets]
                | {"error": float(np.mean(each)), "ms_a_frame": fem_case.speed(case, load, "push")}
            )
    return [
        {
            "law": law,
            "order": order,
            "tets": tets,
            "default": (order, tets) == default and law == "neo-hookean",
        }
        | {name: float(np.mean([r[name] for r in rows])) for name in rows[0]}
        | {"mesh_error_worst": max(r["mesh_error"] for r in rows)}
        for (law, order, tets), rows in total.items()
    ]


def law_table(on: fem_case.Patch) -> list[dict[str, Any]]:
    """Each law against neo-Hookean on the same mesh, for load and direction."""
    contact, rows = fem_case.CONTACTS[0], []
    cases = {law: fem_case.brain(on, law, 2, 1600, contact) for law in NUMBER}
    for load in _LOADS:
        for way in fem_case.WAYS:
            laws = [law for law in NUMBER if law != "neo-hookean"]
            try:
                true = fem_case.moved(cases["neo-hookean"], load, way, 6)
            except (InvertedElement, NoEquilibrium) as refusal:
                outcome = f"no reference: {refusal}"
                rows += [
                    {"law": law, "load": load, "way": way, "error": None, "outcome": outcome} for law in laws
                ]
                continue
            for law in laws:
                row: dict[str, Any] = {"law": law, "load": load, "way": way, "error": None}
                try:
                    row["error"] = fem_case.error(fem_case.moved(cases[law], load, way, 6), true, on)
                    row["outcome"] = f"{100 * row['error']:.2f}%"
                except (InvertedElement, NoEquilibrium) as refusal:
                    row["outcome"] = f"{type(refusal).__name__}: {refusal}"
                rows.append(row)
    return rows


def drawn(found: Mapping[str, Any]) -> result_page.Page:
    """What the data say."""
    tables = [result_page.Section(name, found[name]) for name in ("rows", "gestures", "sequence")]
    return result_page.Page("Physics: error against cost", found, panels(found), tables)


def panels(found: Mapping[str, Any]) -> list[charts.Panel]:
    """Charts of `pareto.json`: the mesh and law's error against cost, and each law's over the load."""
    rows, laws = found["rows"], found["laws"]
    groups = sorted({(r["law"], r["order"]) for r in rows})
    cost = tuple(
        charts.Curve(
            f"{law} P{order}",
            tuple(r["ms_a_frame"] for r in mine),
            tuple(100 * r["error"] for r in mine),
            tuple(f"{law} P{order}, {r['tets']}" for r in mine),
            ringed=tuple(k for k, r in enumerate(mine) if r["default"]),
        )
        for law, order in groups
        if (mine := [r for r in rows if (r["law"], r["order"]) == (law, order)])
    )
    worth = tuple(
        charts.Curve(
            law,
            tuple(load for load, _ in worst),
            tuple(100 * error for _, error in worst),
        )
        for law in NUMBER
        if (worst := _worst(laws, law))
    )
    return [
        charts.Panel(
            "Physics: error against cost", "CPU ms a frame", "error [%]", cost, True, True, front=True
        ),
        charts.Panel("Physics: laws against neo-Hookean", "P = F/(E a2)", "error [%]", worth, True, True),
    ]


def _worst(laws: list[dict[str, Any]], law: str) -> list[tuple[float, float]]:
    """Loads at which a law holds in every direction, with its largest error."""
    rows = []
    for load in _LOADS:
        errors = [r["error"] for r in laws if r["law"] == law and r["load"] == load]
        if errors and None not in errors:
            rows.append((load, max(errors)))
    return rows
