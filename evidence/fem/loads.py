"""Typical force and motion of each named job: what its sequences press with, and how far tissue moves."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

import synth
from evidence import report
from evidence.study import Study
from synth.errors import UserError
from synth.job.reader import names

Row = dict[str, Any]
_QUANTITIES = {"force_mn": "largest force [mN]", "motion_mm": "largest motion [mm]"}
_RANGE = 0, 50, 100  # percentiles: the table's least, median and greatest


def measure(scenes: int = 12, vertices: int = 6000) -> Row:
    """Largest total force [mN] and motion of the surface [mm] of a job's first sequences, without pictures.

    `scenes`: sequences of each job; `vertices`: of the surface, fewer than the jobs' own.
    """
    rows = []
    for name in names():
        job = synth.load_job(name, [f"anatomy.vertices={vertices}", f"sequences={scenes}"])
        rows += [{"job": name, "index": index} | measure_sequence(job, index) for index in range(scenes)]
    return {"rows": rows}


def measure_sequence(job: synth.Job, index: int) -> Row:
    """`force_mn`, `motion_mm` and `young_kpa` of a sequence, or why it is `refused`."""
    try:
        scene = synth.simulate(job, index)
    except UserError as refusal:
        return {"refused": str(refusal)}
    return {
        "force_mn": float(np.linalg.norm(scene.force, axis=1).max()),
        "motion_mm": float(np.linalg.norm(scene.motion.displacement, axis=-1).max()),
        "young_kpa": scene.scenario.tissue.young_kpa,
    }


def page(data: Mapping[str, Any]) -> report.Page:
    """A row for each job: least, median and greatest over its sequences."""
    by_job = {name: rows for (name,), rows in report.group_rows(data["rows"], "job").items()}
    solved = {name: [row for row in rows if "refused" not in row] for name, rows in by_job.items()}
    table = [
        {"job": name, "sequences": len(rows)}
        | {title: _spread([row[key] for row in rows]) for key, title in _QUANTITIES.items()}
        for name, rows in solved.items()
    ]

    def draw(axes: Axes) -> None:
        for name, rows in solved.items():
            axes.loglog(
                [row["motion_mm"] for row in rows], [row["force_mn"] for row in rows], "o", ms=4, label=name
            )
        axes.set(xlabel="largest motion [mm]", ylabel="largest force [mN]")
        report.legend(axes)

    words = ("Median [least, greatest] of each job's first sequences, by their mechanics alone.",)
    return report.Page(
        "Force and motion of each job", data, words, [report.Section("Jobs", table)], report.chart(draw)
    )


def _spread(values: list[float]) -> str:
    low, middle, high = (f"{float(f'{value:.2g}'):g}" for value in np.percentile(values, _RANGE))
    return f"{middle} [{low}, {high}]"


STUDY = Study(measure, "fem/loads/loads.json", page, needs=("mesh", "mechanics"))
