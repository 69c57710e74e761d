"""Default scenes with the mesh refined: what the default mesh leaves out of gyri, sulci and contact."""

from __future__ import annotations

import json as json_
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench.output import charts, machine, write
from bench.output.result_page import Page, Section
from evidence.measuring import measuring
from synth.dataset import provenance
from synth.errors import UserError
from synth.fem import equilibrium, surface_embedding, tool
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.relief import HeightMap
from synth.fem.mesh.tetrahedra import Tets
from synth.job.schema import Job
from synth.sequence import pipeline, scenario
from synth.sequence.scenario import Scenario

Floats = NDArray[np.float64]
Row = dict[str, Any]
_JOB = Job(sequences=1000)
_MAKERS = (
    "synth.fem.equilibrium",
    "synth.fem.material",
    "synth.fem.mesh.relief",
    "synth.fem.mesh.tetrahedra",
    "synth.fem.surface_embedding",
    "synth.fem.tool",
    "synth.job.schema",
    "synth.render.anatomy.surface",
)


@measuring("--scenes 4 --tets 800,1600,5000")
def relief(
    scenes: Annotated[int, typer.Option(help="How many of the default job.", min=1)] = 40,
    tets: Annotated[str, typer.Option(help="Tetrahedra; the last is the reference.")] = "1600,5000,20000",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder; what this code made there stays.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON to standard output.")] = False,
) -> None:
    """Peak and loaded mean of default scenes at full load, by mesh, against the finest mesh."""
    sizes = [int(n) for n in tets.split(",")]
    kept = out / "relief.json" if out is not None else None
    rows: list[Row] = json_.loads(kept.read_text("utf-8"))["rows"] if kept and kept.exists() else []
    rows = [row for row in rows if row.get("code") == code()]
    found: Row = {}
    for count in reversed(sizes):
        for index in range(scenes):
            if not any(r["index"] == index and r["tets"] == count for r in rows):
                rows.append(measure_scene(index, count))
            found = {
                "command": f"bench experiment relief --scenes {scenes} --tets {tets}",
                "machine": machine.describe(),
                "summary": summarise(rows, sizes),
                "rows": rows,
            }
            if out is not None:
                write.keep(out, "relief.json", found)
    if json:
        print(json_.dumps(found))
        return
    for line in found["summary"]:
        print(line)


@cache
def code() -> str:
    """One word for what decides a row: what scenes are drawn from, their surface, mesh and equations."""
    return provenance.source(_MAKERS, {"synth"})


def measure_scene(index: int, count: int) -> Row:
    """Largest displacement and the mean under the load, weighted by it, mm, at a scene's full load."""
    case = scenario.draw(_JOB, index)
    surface, _ = pipeline.cortex(_JOB, case)
    height = HeightMap(surface.pia, surface.extent_mm)
    row: Row = {"code": code(), "index": index, "tets": count}
    row |= {"kind": case.gesture.kind, "load": case.gesture.load}
    volume = tetrahedra.block(_JOB.anatomy, count, _JOB.fem.order, tool.focus(case.gesture), height)
    try:
        return row | peak_and_mean(case, volume, surface.vertices, surface.faces)
    except UserError as refusal:
        return row | {"refused": str(refusal)}


def peak_and_mean(case: Scenario, volume: Tets, vertices: Floats, faces: NDArray[np.int32]) -> Row:
    """Of a scene at its full load, half of it taken first."""
    gesture = case.gesture
    over = tool.course(gesture, _JOB.frames)
    full = int(over.load.argmax())
    over = tool.Course(np.ones(1), over.away[[full]], over.shift[[full]])
    area = surface_embedding.vertex_area(vertices, faces)
    force = area[:, None] * tool.tractions(gesture, over, vertices, area)[0] / case.tissue.young_kpa
    carry = surface_embedding.embed(volume, vertices)
    parts = np.array([0.5, 1.0])
    path = equilibrium.solve_path(
        case.tissue.equations(volume),
        parts[:, None, None] * carry.gather(force),
        gesture.load * parts,
    )
    u, weight = carry.move(path.displacement[-1]), np.linalg.norm(force, axis=1)
    return {
        "peak_mm": float(np.linalg.norm(u, axis=1).max()),
        "mean_mm": float(np.linalg.norm(weight @ u) / weight.sum()),
        "least_jacobian": float(path.jacobian.min()),
    }


def summarise(rows: list[Row], sizes: list[int]) -> list[Row]:
    """Median and worst deviation from the finest mesh, of the scenes that have one there."""
    made = []
    exact = {r["index"]: r for r in rows if r["tets"] == sizes[-1] and "peak_mm" in r}
    for count in sizes[:-1]:
        ours = [r for r in rows if r["tets"] == count and "peak_mm" in r and r["index"] in exact]
        line: Row = {"tets": count, "against": sizes[-1], "scenes": len(ours)}
        for name in ("peak_mm", "mean_mm") if ours else ():
            off = np.abs([r[name] / exact[r["index"]][name] - 1 for r in ours])
            line |= {f"{name[:4]}_median": float(np.median(off)), f"{name[:4]}_worst": float(off.max())}
        made.append(line)
    return made


def drawn(found: Mapping[str, Any]) -> Page:
    """What the data say."""
    rows = found["summary"]
    sizes = tuple(float(row["tets"]) for row in rows)
    curves = tuple(
        charts.Curve(f"{of}, {which}", sizes, tuple(100 * row[f"{of}_{which}"] for row in rows))
        for of in ("peak", "mean")
        for which in ("median", "worst")
    )
    title = f"{rows[0]['scenes']} default scenes against {rows[0]['against']} tetrahedra"
    panel = charts.Panel(title, "tetrahedra", "displacement [%]", curves)
    return Page(title, found, [panel], [Section("Summary", rows)])
