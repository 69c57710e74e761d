"""A photograph in, a family of the job out, with how near it came on anatomies that the fit has not seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from synth.fit import candidate, look_file, parameters
from synth.fit.candidate import Setting
from synth.fit.compression import Compression
from synth.fit.photograph import read_photograph
from synth.fit.search import Fitted, search
from synth.fit.sheet import write_sheet
from synth.fit.statistics import measure
from synth.system.whole_file import write_whole

_UNSEEN = 1000  # first of the anatomies that distances are reported on
_SHOWN = 2


@dataclass(frozen=True)
class Outcome:
    """What a fit came to."""

    fitted: Fitted
    sections: dict[str, Any]
    """Of the job."""
    before: float
    """Distance of a default job's frames from the photograph, on anatomies that the fit didn't see."""
    after: float
    photograph: dict[str, float]
    """Its statistics."""
    cortex_mm2: float
    """That could be measured."""


def fit_photograph(
    photo: Path,
    out: Path,
    width_mm: float,
    mask: Path | None,
    sheet: Path | None,
    rounds: int,
    anatomies: int,
    said: Callable[[int, float], None],
) -> Outcome:
    """Fits, and writes the job file and, if asked for, the picture before and after.

    Args:
        photo: the photograph.
        out: the job file to write.
        width_mm: what the photograph's width spans.
        mask: of its cortex; found if not given.
        sheet: picture to write.
        rounds: of the search.
        anatomies: rendered in each.
        said: is told round and distance.

    Raises:
        UserError: the photograph or its mask can't be used, or a file can't be written.
    """
    given = read_photograph(photo, width_mm, mask)
    theirs = measure(given.view)
    scale = given.view.mm_per_px
    fitted = search(theirs, Setting(scale, tuple(range(anatomies)), given.compression), rounds, said)
    unseen = Setting(scale, tuple(range(_UNSEEN, _UNSEEN + anatomies)), Compression())
    best = parameters.as_job(fitted.values, fitted.family)
    before = [candidate.render({}, unseen, index, exact=False) for index in unseen.anatomies]
    bare = [candidate.render(best, unseen, index) for index in unseen.anatomies]
    after = [replace(view, rgb=given.compression.apply(view.rgb)) for view in bare]
    made = look_file.sections(fitted, given.compression.chroma, given.compression.bitrate_mbps(bare[0].rgb))
    found = Outcome(
        fitted,
        made,
        parameters.distance(candidate.measured(before), theirs),
        parameters.distance(candidate.measured(after), theirs),
        theirs,
        float(given.view.usable.sum()) * scale**2,
    )
    heading = [
        f"Fitted to {photo.name} by synth fit, at {scale:.4f} mm a pixel, which blur and noise are of.",
        f"Distance from it: {found.before:.2f} before, {found.after:.2f} after.",
    ]
    if sheet is not None:
        write_sheet(sheet, given.view, before[:_SHOWN], after[:_SHOWN])
    write_whole(out, look_file.text(fitted, made, heading))
    return found


def summary(found: Outcome) -> list[str]:
    """What a person is told."""
    lines = [
        f"{found.cortex_mm2:.0f} mm2 of cortex measured; nearest family {found.fitted.family}",
        f"distance on anatomies that the fit didn't see: {found.before:.2f} before, {found.after:.2f} after",
    ]
    off = {
        name: parameters.scaled(name, found.fitted.statistics[name]) - parameters.scaled(name, value)
        for name, value in found.photograph.items()
        if np.isfinite(value) and np.isfinite(found.fitted.statistics[name])
    }
    worst = sorted(off, key=lambda name: -abs(off[name]))[:4]
    if found.fitted.undecided:
        lines.append(
            f"not decided by this picture, one standard deviation: {look_file.undecided(found.fitted)}"
        )
    lines.append("farthest off: " + ", ".join(f"{name} {off[name]:+.2f}" for name in worst))
    return lines


def as_dict(found: Outcome) -> dict[str, Any]:
    """The same for machines; what isn't known is null."""
    return {
        "family": found.fitted.family,
        "before": found.before,
        "after": found.after,
        "cortex_mm2": found.cortex_mm2,
        "parameters": found.fitted.values,
        "not_seen": list(found.fitted.left),
        "at_a_limit": list(found.fitted.bounded),
        "standard_deviations": found.fitted.unsure,
        "not_decided": list(found.fitted.undecided),
        "photograph": _known(found.photograph),
        "rendered": _known(found.fitted.statistics),
        "job": found.sections,
    }


def _known(values: dict[str, float]) -> dict[str, float | None]:
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
