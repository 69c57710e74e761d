"""Discretisation error of default scenes: the default mesh against refined ones."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from evidence import report
from evidence.study import Study
from synth.errors import UserError
from synth.fem import equilibrium, surface_embedding, tool_gesture
from synth.fem.mesh import tetrahedra
from synth.fem.mesh.mesh_relief import HeightMap
from synth.job.schema import Job
from synth.sequence.rest_scene import RestScene, at_rest

Row = dict[str, Any]
_JOB = Job(sequences=1000)


def measure(scenes: int = 40, tets: str = "1600,5000,20000") -> Row:
    """Peak and load-weighted mean displacement of default scenes at full load, relative to the finest mesh.

    `scenes`: number of scenes of the default job; `tets`: tetrahedra, the last is the reference.
    """
    sizes = [int(n) for n in tets.split(",")]
    rows = [row for index in range(scenes) for row in measure_scene(index, sizes)]
    return {"summary": summarise(rows, sizes), "rows": rows}


def measure_scene(index: int, sizes: Sequence[int]) -> list[Row]:
    """`_measure_mesh` of a scene with each number of tetrahedra."""
    rest = at_rest(_JOB, index)
    return [_measure_mesh(rest, index, count) for count in sizes]


def _measure_mesh(rest: RestScene, index: int, count: int) -> Row:
    """Largest and load-weighted mean displacement [mm] of a scene at full load, reached in two steps."""
    case, surface = rest.scenario, rest.surface
    gesture, height = case.gestures[0], HeightMap(surface.pia, surface.extent_mm)
    row: Row = {"index": index, "tets": count, "kind": gesture.kind, "load": gesture.load}
    volume = tetrahedra.block(count, gesture.focus, height)
    motion = tool_gesture.trajectory(gesture, _JOB.frames)
    peak = int(motion.load.argmax())
    motion = tool_gesture.ToolMotion(np.ones(1), motion.away[[peak]], motion.shift[[peak]])
    area = rest.vertex_area
    traction = tool_gesture.tractions(gesture, motion, surface.vertices, area)[0]
    force = area[:, None] * traction / case.tissue.young_kpa
    embedding = surface_embedding.embed(volume, surface.vertices)
    parts = np.array([0.5, 1.0])
    loads = parts[:, None, None] * embedding.gather(force)
    try:
        path = equilibrium.solve_path(case.tissue.equations(volume), loads, gesture.load * parts)
    except UserError as refusal:
        return row | {"refused": str(refusal)}
    u, weight = embedding.move(path.displacement[-1]), np.linalg.norm(force, axis=1)
    return row | {
        "peak_mm": float(np.linalg.norm(u, axis=1).max()),
        "mean_mm": float(np.linalg.norm(weight @ u) / weight.sum()),
        "least_jacobian": float(path.jacobian.min()),
    }


def summarise(rows: list[Row], sizes: list[int]) -> list[Row]:
    """Median and worst deviation from the finest mesh, over scenes that converge on it."""
    lines = []
    exact = {r["index"]: r for r in rows if r["tets"] == sizes[-1] and "peak_mm" in r}
    for count in sizes[:-1]:
        converged = [r for r in rows if r["tets"] == count and "peak_mm" in r and r["index"] in exact]
        line: Row = {"tets": count, "against": sizes[-1], "scenes": len(converged)}
        for name in ("peak_mm", "mean_mm") if converged else ():
            deviation = np.abs([r[name] / exact[r["index"]][name] - 1 for r in converged])
            line |= {
                f"{name[:4]}_median": float(np.median(deviation)),
                f"{name[:4]}_worst": float(deviation.max()),
            }
        lines.append(line)
    return lines


def page(data: Mapping[str, Any]) -> report.Page:
    """Deviation from the finest mesh, by number of tetrahedra."""
    rows = [row for row in data["summary"] if row["scenes"]]

    def draw(axes: Axes) -> None:
        for kind, statistic in product(("peak", "mean"), ("median", "worst")):
            errors = [100 * row[f"{kind}_{statistic}"] for row in rows]
            axes.plot([row["tets"] for row in rows], errors, "-o", label=f"{kind}, {statistic}")
        axes.set(xlabel="tetrahedra", ylabel="displacement [%]", ylim=(0, None))
        report.legend(axes)

    title, sections = "Default scenes against the finest mesh", [report.Section("Summary", data["summary"])]
    return report.Page(title, data, (), sections, report.chart(draw))


STUDY = Study(measure, "fem/relief/relief.json", page, needs=("mesh", "mechanics"))
