"""Renderings against a photograph by features of an ImageNet network: kernel distance, coverage.

Precision, recall and coverage are defined as in prdc 0.2 of PyPI. Crops do not overlap.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.distance import cdist
from scipy.stats import binomtest

from evidence import report, status
from evidence.appearance import classifier
from evidence.appearance.classifier import MM_PER_PX, SIDE_PX, ablated, crops, embedded, taken
from evidence.render.photograph import OUTLINE, bare_picture, corners
from evidence.study import Study
from synth.arrays import Floats, Ints, Pixels
from synth.job.reader import as_job
from synth.job.schema import Job
from synth.tune.search import changed

_K = 5  # neighbours
_SAME = 0.05  # change of scale below which a picture is not resampled


def kernel_distance(theirs: Floats, ours: Floats) -> float:
    """Unbiased squared maximum mean discrepancy of two sets of features (N, d), (M, d), times 1000.

    Kernel inception distance, with the kernel (x·y / d + 1)³ (M. Binkowski et al., ICLR 2018).
    """
    within = []
    for one in (theirs, ours):
        kernel = (one @ one.T / one.shape[1] + 1) ** 3
        within.append((kernel.sum() - np.trace(kernel)) / (len(one) * (len(one) - 1)))
    between = (theirs @ ours.T / ours.shape[1] + 1) ** 3
    return float(1000 * (sum(within) - 2 * between.mean()))


def neighbourhoods(theirs: Floats, ours: Floats) -> dict[str, float]:
    """Precision, recall and coverage with k = 5 neighbours (M. F. Naeem et al., ICML 2020).

    Coverage is the share of `theirs` (N, d) that have one of `ours` (M, d) closer than the fifth of theirs.
    """
    between = cdist(theirs, ours)
    far, wide = (np.partition(cdist(one, one), _K, axis=1)[:, _K] for one in (theirs, ours))
    return {
        "precision": float((between < far[:, None]).any(axis=0).mean()),
        "recall": float((between < wide).any(axis=1).mean()),
        "coverage": float((between.min(axis=1) < far).mean()),
    }


def jackknife(theirs: Floats, ours: Floats, group: Ints) -> tuple[float, float]:
    """Interval of 95% of the kernel distance: without each of `theirs`, and without each group of `ours`.

    Args: theirs: (N, d); ours: (M, d); group: (M,), the frame of each.
    """
    variance, one = 0.0, kernel_distance(theirs, ours)
    without = [kernel_distance(np.delete(theirs, k, axis=0), ours) for k in range(len(theirs))]
    rest = [kernel_distance(theirs, ours[group != k]) for k in np.unique(group)]
    for values in (without, rest):
        variance += (len(values) - 1) * float(np.var(values))
    return one - 1.96 * variance**0.5, one + 1.96 * variance**0.5


def of_job(job: Job) -> tuple[Pixels, Ints]:
    """Crops of tissue, without overlap, of each sequence's first frame, and the sequence of each (N,).

    Pictures are scaled to the photograph's mm per px, if they differ by more than a twentieth. They have no
    instruments, and the field of a job that draws it is the default: drawing it sets keys of instruments.
    """
    drawn = {name: share for name, share in job.randomize.items() if name not in ("instruments", "field")}
    bare = changed(job, {"fem.instrument": "none", "sensor.bitrate_mbps": None})
    bare = changed(bare, {"randomize": drawn}) if job.randomize else bare
    pictures, of = [], []
    for index in range(job.sequences):
        rgb, inside, mm_per_px = bare_picture(bare, index)
        scale = mm_per_px / MM_PER_PX
        if abs(scale - 1) > _SAME:
            how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
            rgb = np.asarray(cv2.resize(rgb, None, fx=scale, fy=scale, interpolation=how), np.uint8)
            size = rgb.shape[1::-1]
            inside = cv2.resize(inside.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        every = corners(inside, SIDE_PX, SIDE_PX // 8)
        found = [every[k] for k in apart(np.array(every, float).reshape(-1, 2))]
        pictures.append(crops(taken(rgb, index + 1), found))
        of += [index] * len(found)
    return np.concatenate(pictures), np.array(of, np.int64)


def apart(places: Floats) -> list[int]:
    """Indices of crops that don't overlap, by their corners (N, 2) px: the first of those that do."""
    chosen: list[int] = []
    for k, at in enumerate(places):
        if (np.abs(places[chosen] - at).max(axis=1) >= SIDE_PX).all():
            chosen.append(k)
    return chosen


def measure(
    photo: Path,
    job: list[str] = ["default"],  # noqa: B006
    outline: str = OUTLINE,
    width_mm: float = 110.0,
    frames: int = 10,
    seed: int = 31,
) -> dict[str, Any]:
    """Kernel distance, precision, recall and coverage of renderings, photograph against rendered crops.

    `job`: named jobs or files, `default` for one without keys; repeatable; `outline`, `width_mm`: of the
    cortex in the photograph; `frames`: of each job, one a sequence.
    """
    every, places = classifier.of_photograph(photo, outline, width_mm, SIDE_PX // 8)
    chosen = apart(places)
    theirs, real = every[chosen], embedded(every[chosen])
    half = places[chosen, 0] < np.median(places[chosen, 0])
    in_grey = ablated(theirs)[", grey levels"]
    rows = [
        _row("control: photograph, one half of it", real[half], real[~half], np.arange((~half).sum())),
        _row("control: photograph, itself in grey", real, embedded(in_grey), np.arange(len(real))),
    ]
    for name in job:
        keys = {"sequences": frames, "seed": seed}
        ours, group = of_job(Job.model_validate(keys) if name == "default" else changed(as_job(name), keys))
        for what, both in ablated(np.concatenate([theirs, ours])).items():
            found = embedded(both)
            rows.append(_row(f"{name}{what}", found[: len(theirs)], found[len(theirs) :], group))
    return {"data": status.data(photo), "seed": seed, "rows": rows}


def _row(name: str, theirs: Floats, ours: Floats, group: Ints) -> dict[str, Any]:
    figures = {"distance": kernel_distance(theirs, ours), **neighbourhoods(theirs, ours)}
    covered = binomtest(round(figures["coverage"] * len(theirs)), len(theirs)).proportion_ci(method="wilson")
    ends = {"distance": jackknife(theirs, ours, group), "coverage": (float(covered.low), float(covered.high))}
    counts = {"photograph": len(theirs), "rendered": len(ours), "frames": len(np.unique(group))}
    return {"crops": name, "counts": counts, **figures, "ends": ends}


def page(found: Mapping[str, Any]) -> report.Page:
    """Kernel distance and coverage of every set of crops, with intervals."""
    rows, charts = found["rows"], []
    for name, title in (("distance", "0: as alike as two halves"), ("coverage", "1: all crops are covered")):
        bars = tuple(report.Row(row["crops"], row[name], tuple(row["ends"][name])) for row in rows)
        charts.append(report.Chart(title, name, bars))
    table = [
        {
            "crops": row["crops"],
            "photograph": row["counts"]["photograph"],
            "rendered": f"{row['counts']['rendered']} of {row['counts']['frames']} frames",
            "kernel distance × 1000": report.mean_cell([row["distance"], *row["ends"]["distance"]]),
            "coverage": report.mean_cell([row["coverage"], *row["ends"]["coverage"]]),
            "precision": row["precision"],
            "recall": row["recall"],
        }
        for row in rows
    ]
    words = (
        "Features: EfficientNet-Lite0, trained on ImageNet; kernel distance (KID): 0 for one distribution; "
        "coverage: share of the photograph's crops with a rendered one nearer than their fifth neighbour. "
        "Intervals: of the distance jackknife over frames and the photograph's crops, of coverage Wilson's. "
        f"Foreign packages, from PyPI, both Apache 2.0: `{classifier.PACKAGES}`.",
    )
    return report.Page(
        "Renderings against a photograph, by a network's features",
        found, charts, [report.Section("", table)], words,
    )  # fmt: skip


_STEP = "{photo} --job default --job randomized --frames 60"
STUDY = Study(measure, "render/features/features.json", page, (_STEP,), needs=("mesh", "picture"))
