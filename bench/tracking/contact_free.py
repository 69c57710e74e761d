"""Spans of a video without contact, found from its masks: no instrument is over the tissue."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import binary_opening

from bench.methods.posterior import polynomials
from synth.arrays import Mask
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.recording.harmonic_fit import Span


class Limits:
    """Constants of the search, chosen by hand on nine recordings by felupe and Cycles and on `mission`."""

    absent: float = 0.001  # largest share of the tissue that instruments cover: false masks
    present: float = 0.005  # least share in the tenth of the frames that show most of an instrument
    run: int = 3  # least frames of a span: in fewer an instrument may be missed
    frames: int = 4  # least frames with an instrument, and without one
    least_s: float = 2.0  # least length of all spans: breath hardly shows in less
    still: float = 0.5  # uneven motion relative to that with an instrument: above, one was not recognised
    step_px: int = 4  # between pixels that are compared


class ContactFreeSearch:
    """Gathers a video's frames, in which spans without contact are then found."""

    def __init__(self, tissue: Mask, mm_per_px: float) -> None:
        """`tissue`: (h, w) of the rest frame."""
        self._tissue, (height, width) = tissue, tissue.shape
        y, x = np.mgrid[: height : Limits.step_px, : width : Limits.step_px].reshape(2, -1)
        self._smooth = polynomials(mm_per_px * np.stack([x - width / 2, y - height / 2], axis=1))
        self._time_s, self._covered, self._uneven = list[float](), list[float](), list[float]()

    def add(self, frame: FrameMotion, time_s: float) -> None:
        """Adds a frame at its time [s]; one that is not trusted is in no span."""
        lattice = slice(None, None, Limits.step_px), slice(None, None, Limits.step_px)
        weight = np.sqrt((frame.confidence * self._tissue)[lattice]).reshape(-1, 1)
        design, moved = weight * self._smooth, weight * frame.flow[lattice].reshape(-1, 2)
        residual = moved - design @ np.linalg.lstsq(design.T @ design, design.T @ moved, rcond=None)[0]
        self._time_s.append(time_s)
        share = np.count_nonzero(frame.instruments & self._tissue) / np.count_nonzero(self._tissue)
        self._covered.append(share if frame.trusted else np.inf)
        self._uneven.append(float(np.sqrt(np.square(residual).sum() / max(np.square(weight).sum(), 1e-9))))

    def find(self) -> tuple[Span, ...]:
        """First and last time [s] of each; none unless an instrument comes and goes and the tissue moves
        unevenly only where there is one."""
        covered, uneven, time_s = (np.array(values) for values in (self._covered, self._uneven, self._time_s))
        is_free = binary_opening(covered <= Limits.absent, np.ones(Limits.run))
        is_shown = np.isfinite(covered) & (covered > Limits.absent)
        if min(is_free.sum(), is_shown.sum()) < Limits.frames:
            return ()
        if np.quantile(covered[np.isfinite(covered)], 0.9) < Limits.present:
            return ()
        if uneven[is_free].max() > Limits.still * np.quantile(uneven[is_shown], 0.9):
            return ()
        ends = np.flatnonzero(np.diff(is_free, prepend=False, append=False)).reshape(-1, 2)
        spans = tuple((float(time_s[a]), float(time_s[b - 1])) for a, b in ends)
        return spans if sum(b - a for a, b in spans) >= Limits.least_s else ()
