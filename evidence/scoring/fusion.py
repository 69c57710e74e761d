"""Network, physics and what both say together, on sequences of a world that the network has not met.

Every sequence's stored motion is read as a recording's is, by one eye and by two, with the membrane unknown
and stated. The constants of `bench.methods.fusion`, and what physics' interval grows by under a membrane,
were set on the half with even numbers; read the other.

Run: python -m evidence.scoring.fusion mission-ood --work work
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from bench.methods.comparison import FUSION, MAIN, PHYSICS
from bench.methods.fusion import Fusion
from bench.methods.network import Model
from bench.methods.physics import Physics
from bench.methods.protocol import ForceEstimate, MethodContext
from evidence import cache, report, status
from learn.evaluation.statistics import interval
from learn.inference.shipped import find_model
from synth.dataset.store import Dataset
from synth.dataset.store import Sequence as Stored
from synth.flow.stereo.track import Moved
from synth.job.types import MembraneState

Floats = NDArray[np.float64]
_NETWORKS = {1: "mono", 2: "stereo"}
_STRONG = 0.5
"""Of the sequence's largest force: these frames tell the bias."""


@dataclass(frozen=True)
class Case:
    """How a sequence is read."""

    eyes: int
    told: bool
    """Whether the membrane is stated."""


CASES = tuple(Case(eyes, told) for eyes in (1, 2) for told in (False, True))


def main(
    data: Path,
    work: Annotated[Path, typer.Option(help="Folder for answers, kept for the next run.")] = Path("work"),
    every: Annotated[int, typer.Option(help="1: odd numbers, 0: even ones.")] = 1,
    out: Path = report.RESULTS / "scoring/fusion",
) -> None:
    """What each errs by, and what its 90% intervals hold."""
    rows = []
    for case in CASES:
        model = Model(find_model(_NETWORKS[case.eyes]))
        found = [_kept(one, case, model, work) for one in Dataset(data) if one.index % 2 == every]
        for tissue in ("all", "stripped", "intact"):
            some = [one for one in found if tissue in ("all", one["membrane"])]
            rows += [_row(case, tissue, name, some) for name in (MAIN, PHYSICS, FUSION)]
    result = {"data": status.data(data), "rows": rows}
    report.save(out, "fusion.json", result, page(result))
    report.show(result)


def _kept(sequence: Stored, case: Case, model: Model, work: Path) -> dict[str, Any]:
    key = cache.key(sequence.attrs["content_hash"], case.eyes, case.told, model.identity)
    return dict(cache.result(work, f"together-{sequence.index}", key, lambda: _read(sequence, case, model)))


def _read(sequence: Stored, case: Case, model: Model) -> dict[str, Any]:
    """Truth, force and interval of every frame by each method, as JSON holds them."""
    covered = sequence.attrs["scenario"]["tissue"].get("membrane")
    membrane: MembraneState = "intact" if covered else "stripped"
    scene = MethodContext(
        sequence["tissue"][:].astype(bool),
        sequence.attrs["scale_mm_per_px"],
        sequence.attrs["young_kpa"],
        membrane if case.told else "unknown",
    )
    physics, both = Physics(), Fusion(MAIN, PHYSICS)
    seen: list[dict[str, ForceEstimate]] = []
    for k in range(len(sequence["force"])):
        flow, sure = sequence["flow_recovered"][k], sequence["flow_confidence"][k].astype(np.float32)
        answers: dict[str, ForceEstimate] = {}
        for name, method in ((MAIN, model), (PHYSICS, physics)):
            if case.eyes == 1:
                answers[name] = method(flow, sure, scene, False)
            else:
                moved = Moved(sequence["motion_recovered"][k], sequence["motion_deviation"][k])
                answers[name] = method.in_space(flow, sure, moved, scene, False)
        seen.append(answers)
    for answers, revised in zip(seen, physics.revise(np.zeros(len(seen), bool)), strict=True):
        answers[PHYSICS] = revised
    for answers, fused in zip(seen, both.fuse(seen, scene, case.eyes), strict=True):
        answers[FUSION] = fused
    told = {
        name: [[*one[name].force_mn.tolist(), one[name].low_mn, one[name].high_mn] for one in seen]
        for name in (MAIN, PHYSICS, FUSION)
    }
    return {"membrane": membrane, "true": sequence["force"][:].tolist(), "told": told}


def _row(case: Case, tissue: str, name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    scores: dict[str, list[float]] = {"whole": [], "size": [], "bias": [], "held": [], "width": []}
    for one in found:
        true, told = np.array(one["true"]), np.array(one["told"][name], np.float64)
        size, said = np.linalg.norm(true, axis=1), np.linalg.norm(told[:, :3], axis=1)
        low, high, peak = told[:, 3], told[:, 4], size.max()
        strong = size > _STRONG * peak
        scores["whole"].append(float(np.sqrt(np.square(told[:, :3] - true).sum() / np.square(true).sum())))
        scores["size"].append(float(np.abs(said - size).mean() / peak))
        scores["bias"].append(float((said - size)[strong].mean() / peak))
        scores["held"].append(float(((size >= low) & (size <= high)).mean()))
        scores["width"].append(float((high - low).mean() / peak))
    row: dict[str, Any] = {"eyes": case.eyes, "told": case.told, "tissue": tissue, "method": name}
    row["sequences"] = len(found)
    for key, values in scores.items():
        over = interval(np.array(values), np.random.default_rng(0))
        row[key] = [over.mean, over.low, over.high]
    return row


def page(found: dict[str, Any]) -> report.Page:
    """One table."""

    def cell(ends: Sequence[float]) -> str:
        return f"{ends[0]:.0%} [{ends[1]:.0%}, {ends[2]:.0%}]"

    rows = [
        {
            "eyes": row["eyes"],
            "membrane": row["tissue"],
            "method": row["method"],
            "force": cell(row["whole"]),
            "bias of strong presses": cell(row["bias"]),
            "90% holds": cell(row["held"]),
        }
        for row in found["rows"]
        if not row["told"]
    ]
    whole = (False, FUSION, "all")
    one, two = (r for r in found["rows"] if (r["told"], r["method"], r["tissue"]) == whole)
    words = (
        f"**Together they err by {two['whole'][0]:.0%} of the force with two eyes and by "
        f"{one['whole'][0]:.0%} with one. Their 90% intervals hold {two['held'][0]:.0%} and "
        f"{one['held'][0]:.0%} of frames.**",
        f"{one['sequences']} sequences of a look that no network was fitted on; others of that look chose "
        "the methods' constants; the membrane isn't stated (where it is: in the data). *Force*: error as a "
        "vector, root mean square over that of the force. *Bias*: of the peak. 95% intervals over sequences.",
    )
    return report.Page("Network and physics together", found, [], [report.Section("", rows)], words)


if __name__ == "__main__":
    typer.run(main)
