"""Foreground that no mask holds: it stands in front of the tissue, moves unlike it, or came between."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.estimator import Flags, Flow, Map
from synth.recording_flow.finding import Finding
from synth.recording_flow.frame_motion import FrameMotion


@dataclass(frozen=True)
class Thresholds:
    """When something is foreground: by hand, on videos; 13 of 17 with foreign objects are reported, none of
    19 clean ones (docs/design.md)."""

    front_mm: float = 2.5  # in front of the tissue's surface: more than relief
    sigmas: float = 5.0  # of the depth about that surface: more than noise
    front: float = 0.005  # share of the tissue, in one piece
    step_px: float = 0.25  # that the flow jumps by, at least
    step: float = 0.2  # and this share of the largest motion
    least_px: float = 0.7  # largest motion below which no jump is looked for
    across_px: int = 5  # to either side of a jump
    long: float = 0.12  # of the picture's width: an edge extends over this, a contact's rim doesn't
    lost: float = 0.02  # share of the tissue without a match, in one piece
    near_px: int = 8  # so near to masks nothing is concluded
    rounds: int = 8  # of the surface's robust fit


LIMITS = Thresholds()


class ForegroundSearch:
    """Looks at frames of a film, in order and from the rest frame on."""

    def __init__(self, tissue: Flags, shrink: int) -> None:
        """`tissue`: (h, w), as small as the frames; `shrink`: how many times smaller than the film's."""
        self._tissue, self._shrink = tissue, shrink
        self._surface: tuple[Map, float] | None = None
        self._found: dict[str, list[tuple[float, str, Flags]]] = {}
        self._masked = ~tissue  # in any frame: a mask is often chosen only once something moves

    def add(self, frame: FrameMotion, depth_mm: Map | None = None) -> None:
        """Looks at a frame; `depth_mm`: (h, w) of the frame along the view, NaN: unknown; None: one eye."""
        masked = ~self._tissue
        for known in (frame.masked, frame.rest_masked, frame.confidence == 0 if frame.is_rest else None):
            masked = masked if known is None else masked | known
        self._masked |= masked
        free = cv2.erode((~masked).astype(np.uint8), _square(LIMITS.near_px), borderValue=1) > 0
        if depth_mm is not None:
            self._surface = self._surface or fit_surface(depth_mm, free)
            surface, deviation = self._surface
            with np.errstate(invalid="ignore"):
                high = surface - depth_mm > max(LIMITS.front_mm, LIMITS.sigmas * deviation)
            self._note("stands in front of the tissue", high & free, frame, LIMITS.front)
        if frame.is_rest or not frame.trusted:
            return
        lost = free & (frame.confidence > 0) & (frame.confidence < LOW_CONFIDENCE)
        self._note("hides what was there at rest", lost, frame, LIMITS.lost)
        motion = float(np.percentile(np.linalg.norm(frame.flow[self._tissue], axis=-1), 98))
        if motion > LIMITS.least_px:
            inner = cv2.erode(free.astype(np.uint8), _square(2 * LIMITS.across_px), borderValue=0) > 0
            jump = flow_jump(frame.flow) > max(LIMITS.step_px, LIMITS.step * motion)
            edge = jump & inner & (frame.confidence > LOW_CONFIDENCE)
            self._note("moves unlike tissue", edge, frame, 0.0, LIMITS.long)

    @property
    def findings(self) -> list[Finding]:
        """What was found in two frames at least and not masked in others, the largest of each kind."""
        found = []
        for places in self._found.values():
            unmasked = [(share, said) for share, said, where in places if self._masked[where].mean() < 0.5]
            if len(unmasked) > 1:
                found.append(Finding("odd", "foreground", max(unmasked)[1]))
        return found

    def _note(self, why: str, where: Flags, frame: FrameMotion, share: float, extent: float = 0.0) -> None:
        """Keeps the largest piece, if it has that share of the tissue and that extent in widths."""
        whole = cv2.morphologyEx(where.astype(np.uint8), cv2.MORPH_OPEN, _square(0 if extent else 1))
        _, label, stats, centres = cv2.connectedComponentsWithStats(whole)
        if len(stats) < 2:
            return
        k = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        found = float(stats[k, cv2.CC_STAT_AREA] / np.count_nonzero(self._tissue))
        wide, high = stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT]
        if found >= share and np.hypot(wide, high) >= extent * where.shape[1]:
            x, y = self._shrink * (centres[k] + 0.5) - 0.5
            said = f"something at x {x:.0f}, y {y:.0f} in frame {frame.index} {why}: mask it? (masks/)"
            self._found.setdefault(why, []).append((found, said, label == k))


def fit_surface(depth_mm: Map, tissue: Flags) -> tuple[Map, float]:
    """The smooth surface (h, w) mm under what stands in front, and the tissue's deviation from it [mm].

    A quadratic by least squares; what is far from it is left out anew in each round, in front the sooner.

    Args:
        depth_mm: (h, w) along the view; NaN: unknown.
        tissue: (h, w) where it is fitted.
    """
    height, width = depth_mm.shape
    y, x = np.mgrid[:height, :width] / max(height, width) - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    known = tissue & np.isfinite(depth_mm)
    used, surface, deviation = known, np.full(depth_mm.shape, np.nan), 0.0
    for _ in range(LIMITS.rounds):
        if np.count_nonzero(used) < 10 * terms.shape[-1]:
            break
        surface = terms @ np.linalg.lstsq(terms[used], depth_mm[used], rcond=None)[0]
        off = np.where(known, depth_mm - surface, np.nan)
        deviation = 1.4826 * float(np.median(np.abs(off[used] - np.median(off[used]))))
        with np.errstate(invalid="ignore"):
            used = known & (off > -2 * max(deviation, 0.1)) & (off < 3.5 * max(deviation, 0.1))
    return np.asarray(surface, np.float32), deviation


def flow_jump(flow: Flow) -> Map:
    """(h, w) px by which a flow (h, w, 2) changes across a place more than it does on both sides of it.

    Of a straight slope it is 0, of a smooth one little: an elastic surface makes none, an edge does.
    """

    def beside(dx: float, dy: float) -> Flow:
        shift, size = np.array([[1, 0, dx], [0, 1, dy]], np.float32), (flow.shape[1], flow.shape[0])
        return np.asarray(cv2.warpAffine(flow, shift, size, borderMode=cv2.BORDER_REPLICATE))

    most, near, far = np.zeros(flow.shape[:2], np.float32), LIMITS.across_px, 2.5 * LIMITS.across_px
    for dx, dy in ((1, 0), (0, 1), (0.7, 0.7), (0.7, -0.7)):
        a, b, c, d = (beside(k * dx, k * dy) for k in (near, -near, far, -far))
        # Across lie 2 widths, on either side 1.5.
        slopes = np.linalg.norm(c - a, axis=-1) + np.linalg.norm(b - d, axis=-1)
        most = np.maximum(most, np.linalg.norm(a - b, axis=-1) - slopes * 2 / 3)
    return most


def _square(around_px: int) -> NDArray[np.uint8]:
    return np.ones((2 * around_px + 1, 2 * around_px + 1), np.uint8)
