"""`bench flow`: any two pictures, any estimator, scored against a flow file."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.flow import files
from synth.errors import UserError
from synth.flow import mask
from synth.flow.estimator import Flags, Flow, Map, Rgb, create
from synth.system import foreign_picture


@dataclass(frozen=True)
class Score:
    """Against the truth, over the pixels where it is known."""

    epe: float
    """Mean endpoint error [px]."""
    p95: float
    """95th percentile [px]."""
    outliers: float
    """Share of pixels off by more than 3 px and 5% (KITTI's Fl)."""
    trusted: float
    """Share of pixels with confidence of at least one half."""
    trusted_epe: float
    """Mean endpoint error of those [px]; NaN if there are none."""
    pixels: int


def score_pair(
    first: Path, second: Path, truth: Path | None, backend: str, masks: bool, out: Path | None
) -> Score | None:
    """Computes the flow from `first` to `second`, writes it to `out`, and scores it if there is a truth.

    Raises:
        UserError: unreadable pictures or flow, or sizes that differ.
    """
    one, two = _picture(first), _picture(second)
    if one.shape != two.shape:
        raise UserError(f"{second}: {two.shape[1]} x {two.shape[0]} px, but {first} has other size")
    every = np.ones(one.shape[:2], bool)
    usable = (~mask.glare(one), ~mask.glare(two)) if masks else (every, every)
    flow, trust = create(backend).flow(one, two, *usable)
    if out is not None:
        files.write_flow(out, flow)
    if truth is None:
        return None
    real, known = files.read_flow(truth)
    if real.shape != flow.shape:
        raise UserError(f"{truth}: {real.shape[1]} x {real.shape[0]} px, the pictures have other size")
    if not known.any():
        raise UserError(f"{truth}: no pixel's flow is known")
    return _score(flow, real, trust, known)


def as_dict(score: Score | None, out: Path | None) -> dict[str, float | int | str | None]:
    """For JSON, which has no NaN: where the flow was written, and the scores if there was a truth."""
    found = {} if score is None else asdict(score)
    plain = {name: None if value != value else value for name, value in found.items()}
    return {**plain, "out": None if out is None else str(out)}


def _score(flow: Flow, real: Flow, trust: Map, known: Flags) -> Score:
    error = np.linalg.norm(flow - real, axis=-1)[known]  # endpoint error (Baker et al., IJCV 2011)
    length = np.linalg.norm(real, axis=-1)[known]
    sure = trust[known] >= 0.5
    return Score(
        epe=float(error.mean()),
        p95=float(np.percentile(error, 95)),
        outliers=float(np.mean((error > 3) & (error > 0.05 * length))),
        trusted=float(sure.mean()),
        trusted_epe=float(error[sure].mean()) if sure.any() else float("nan"),
        pixels=int(known.sum()),
    )


def _picture(path: Path) -> Rgb:
    return np.ascontiguousarray(foreign_picture.read_picture(path)[..., ::-1], np.uint8)
