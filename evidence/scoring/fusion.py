"""Errors of network, physics and their fusion, on sequences out of distribution.

Force is estimated from every sequence's stored motion as from a recording's, monocular and in stereo, with
the membrane unknown, stated, and stated with its stiffness. The constants of `bench.methods.force_fusion`
were set on sequences with even numbers; odd ones are reported. Those of physics' membranes were set on 42
covered sequences, 5 of which are among them.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bench.methods.comparison import FUSION, MAIN, PHYSICS
from bench.methods.force_fusion import Fusion
from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.methods.network import Model
from bench.methods.physics import Physics
from evidence import report, result_cache, result_status
from evidence.paired_means import mean_of
from evidence.study import Study
from learn.inference.predict import load_model
from learn.inference.shipped_networks import NAMES
from synth.dataset.store import Dataset
from synth.dataset.store import Sequence as Stored
from synth.flow.stereo.stereo_track import Moved
from synth.job.types import MembraneState

Case = dict[str, Any]  # input of the methods: `cameras`, and what is stated, one of `_STATED`
_STATED = "nothing", "membrane", "membrane and its stiffness"
_MEASURED = 1.25  # factor of the true stiffness, up and down, that is stated
_CONTROL = "control: another video's force"
_STRONG = 0.5  # of the sequence's largest force: bias is measured on frames above it


def measure(data: Path, work: Path = Path("work"), every: int = 1) -> dict[str, Any]:
    """Errors of network, physics and their fusion, and coverage of their 90% intervals.

    `work`: folder of estimates, which a later run reuses; `every`: 1 for odd numbers, 0 for even ones.
    """
    rows = []
    for cameras, stated in product((1, 2), _STATED):
        model = Model(load_model(NAMES[0])) if cameras == 2 else None  # none is shipped for one camera
        case = {"cameras": cameras, "stated": stated}
        found = []
        for one in (one for one in Dataset(data) if one.index % 2 == every):
            key = result_cache.key(one.attrs["content_hash"], case, model.identity if model else "")
            compute = partial(_estimated, one, case, model)
            found.append(result_cache.result(work, f"fusion-{one.index}", key, compute))
        for tissue in ("all", "stripped", "intact"):
            some = [one for one in found if tissue in ("all", one["membrane"])]
            rows += [case | _row(tissue, name, some) for name in _names(model)]
        others = [
            one | {"true": other["true"]} for one, other in zip(found, found[1:] + found[:1], strict=True)
        ]
        rows.append(case | _row("all", PHYSICS, others) | {"method": _CONTROL})
    return {"data": result_status.data(data), "rows": rows}


def _names(model: Model | None) -> tuple[str, ...]:
    return (PHYSICS,) if model is None else (MAIN, PHYSICS, FUSION)


def _estimated(sequence: Stored, case: Case, model: Model | None) -> dict[str, Any]:
    """True force, and estimate and interval by each method, of every frame, for JSON."""
    covered = sequence.attrs["scenario"]["tissue"].get("membrane")
    membrane: MembraneState = "intact" if covered else "stripped"
    stiff = covered["young_kpa"] * covered["thickness_mm"] if covered else None
    scene = MethodContext(
        sequence["tissue"][:].astype(bool),
        sequence.attrs["scale_mm_per_px"],
        sequence.attrs["young_kpa"],
        "unknown" if case["stated"] == "nothing" else membrane,
        membrane_mn_per_mm=(stiff / _MEASURED, stiff * _MEASURED)
        if stiff and case["stated"] == _STATED[-1]
        else None,
    )
    physics, both = Physics(), Fusion(MAIN, PHYSICS)
    frames: list[dict[str, ForceEstimate]] = []
    for k in range(len(sequence["force"])):
        flow, sure = sequence["flow_recovered"][k], sequence["flow_confidence"][k].astype(np.float32)
        estimates: dict[str, ForceEstimate] = {}
        moved = None
        if case["cameras"] == 2:
            moved = Moved(sequence["motion_recovered"][k], sequence["motion_deviation"][k])
        if model is not None:
            estimates[MAIN] = model(FrameMotion(flow, sure, motion=moved), scene, False)
        estimates[PHYSICS] = physics(FrameMotion(flow, sure, motion=moved), scene, False)
        frames.append(estimates)
    for estimates, revised in zip(frames, physics.revise(np.zeros(len(frames), bool)), strict=True):
        estimates[PHYSICS] = revised
    if model is not None:
        for estimates, fused in zip(frames, both.fuse(frames, scene, case["cameras"]), strict=True):
            estimates[FUSION] = fused
    rows = {
        name: [[*one[name].force_mn.tolist(), one[name].low_mn, one[name].high_mn] for one in frames]
        for name in _names(model)
    }
    return {"membrane": membrane, "true": sequence["force"][:].tolist(), "estimated": rows}


def _row(tissue: str, name: str, found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    scores: dict[str, list[float]] = {"whole": [], "bias": [], "coverage": []}
    for one in found:
        true, rows = np.array(one["true"]), np.array(one["estimated"][name], np.float64)
        force, low, high = rows[:, :3], rows[:, 3], rows[:, 4]
        size = np.linalg.norm(true, axis=1)
        off, peak = np.linalg.norm(force, axis=1) - size, size.max()
        scores["whole"].append(float(np.sqrt(np.square(force - true).sum() / np.square(true).sum())))
        scores["bias"].append(float(off[size > _STRONG * peak].mean() / peak))
        if np.isfinite(low).all():
            scores["coverage"].append(float(((size >= low) & (size <= high)).mean()))
    row = {"tissue": tissue, "method": name, "sequences": len(found)}
    return row | {key: mean_of(values) if values else None for key, values in scores.items()}


def page(found: Mapping[str, Any]) -> report.Page:
    """A table of the rows with unknown membrane, and physics under a membrane by what is stated."""
    unknown = [row for row in found["rows"] if row["stated"] == "nothing"]
    rows = [
        {
            "cameras": row["cameras"],
            "membrane": row["tissue"],
            "method": row["method"],
            "force": report.mean_cell(row["whole"], ".0%"),
            "bias of strong presses": report.mean_cell(row["bias"], ".0%"),
            "coverage": row["coverage"] and report.mean_cell(row["coverage"], ".0%"),
        }
        for row in unknown
    ]
    known = [
        {
            "cameras": row["cameras"],
            "stated": row["stated"],
            "force": report.mean_cell(row["whole"], ".0%"),
            "bias of strong presses": report.mean_cell(row["bias"], ".0%"),
        }
        for row in found["rows"]
        if (row["method"], row["tissue"]) == (PHYSICS, "intact")
    ]
    by_method = {(row["cameras"], row["method"]): row for row in unknown if row["tissue"] == "all"}
    one, two, both = by_method[1, PHYSICS], by_method[2, PHYSICS], by_method[2, FUSION]
    words = (
        f"**The error of physics' force is {two['whole'][0]:.0%} with two cameras and {one['whole'][0]:.0%} "
        f"with one; its fusion with the pretrained network errs by {both['whole'][0]:.0%} with two.**",
        f"{one['sequences']} sequences with an appearance that no network was fitted on; the methods' "
        "constants were set on other sequences of it, but for 5. The membrane is unknown to the methods. "
        "*Coverage*: of each method's own 90% interval, not of the calibrated one. *Force*: root mean square "
        "error of the vector relative to that of the force, so no force has 100%. *Bias*: relative to the "
        "peak. 95% intervals over sequences.",
    )
    sections = [report.Section("", rows), report.Section("Physics under a membrane", known)]
    return report.Page("Physics, network, and their fusion", found, words, sections)


STUDY = Study(
    measure,
    "scoring/fusion/fusion.json",
    page,
    ("{mission-ood} --work {work}/fusion",),
    needs=("mesh", "mechanics", "picture", "truth", "flow", "stereo", "network", "score", "score-stereo"),
)
