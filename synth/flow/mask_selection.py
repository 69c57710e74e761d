"""Selection of masks among the detected instruments and highlights, by their effect on the flow.

A wrong mask hides tissue, and a detector trained on other pictures can be wrong about a whole recording.
Detections of `mask_detection` are therefore proposals. Two flows are computed, without masks and with every
proposal masked. A block of a proposal is masked if the residual of the unmasked flow is larger in it than
elsewhere (something occludes the tissue), or if masking it lowers the residual around it (it biases the flow
of its neighbours). No proposal is masked if the unmasked flow has the higher confidence away from proposals.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from synth.arrays import Floats, Map, Mask, Pixels
from synth.flow import image
from synth.flow.estimator import Estimator
from synth.flow.track import Solution, Tracker


class Selection:
    """Thresholds of the selection, chosen on the foreign videos of docs/results/flow/recordings: masking all
    proposals costs 0.55 px there, masking selected ones 0.17. The unit of residuals is a local deviation."""

    largest: float = 0.4  # share of the tissue above which a kind of proposal is dropped as implausible
    unexplained: float = 0.12  # excess of a block's residual over that elsewhere [local deviations]
    gain: float = 0.01  # fall of the residual around a block when it is masked [local deviations]
    sure: float = 3.0  # standard errors that are added to both thresholds
    ring_px: int = 6  # width of the ring around a block
    new_px: int = 20  # pixels of unjudged proposals that start a selection
    cells: int = 6  # blocks along the longer side
    grown_px: float = 0.5  # growth of the motion that starts a selection
    first: int = 4  # selections that are always allowed; they take time
    every: int = 60  # frames for each further selection


@dataclass(frozen=True, eq=False)
class Proposal:
    """Masks (H, W) of what may not be tissue in a picture, and of what is certainly not."""

    glare: Mask
    tool: Mask
    known: Mask  # always masked

    def within(self, tissue: Mask) -> Proposal:
        """The same without a kind that covers an implausible share of the tissue."""
        most = Selection.largest * np.count_nonzero(tissue)
        glare, tool = (one & (np.count_nonzero(one & tissue) <= most) for one in (self.glare, self.tool))
        return Proposal(glare, tool, self.known)

    @property
    def either(self) -> Mask:
        """(H, W) glare or tool."""
        return self.glare | self.tool

    def blocks(self) -> NDArray[np.int16]:
        """Block numbers (2, H, W) of glare and of tool, from 1; 0 where there is no proposal."""
        height, width = self.glare.shape
        side = max(1, max(height, width) // Selection.cells)
        row, column = np.arange(height, dtype=np.int16) // side, np.arange(width, dtype=np.int16) // side
        square = 1 + row[:, None] * (column[-1] + 1) + column
        return np.stack([self.glare * square, self.tool * (square + square[-1, -1])])


class SelectingTracker:
    """A `Tracker` that selects its masks among proposals.

    Masks are selected at the first motion, when motion grows, at new proposals, and when a frame is lost.
    """

    def __init__(self, backend: str | Estimator, rest: Pixels, found: Proposal, tissue: Mask) -> None:
        """Starts at the rest frame with proposals `found`, none of them masked; otherwise as `Tracker`."""
        self.tracker = Tracker(backend, rest, found.known, tissue)
        self.rest_found = found.within(tissue)
        self.rest_blocked = found.known  # (H, W) mask of the rest frame
        self.blocked = found.known  # (H, W) mask of the last frame
        self.reinitialised = False  # whether other masks or a start from zero made the last frame trusted
        self._rest_picture = _normalised(rest)
        last = Proposal(tissue, np.ones_like(tissue), tissue).blocks().max()
        self._verdict = np.zeros(1 + last, np.int8)  # of blocks: 1 masked, -1 not masked, 0 not judged
        self._some = np.flatnonzero(tissue)[::7]  # pixels over which motion is measured
        self._tested_px = 0.0  # largest motion at which masks have been selected
        self._frames = self._selections = 0

    @property
    def trusted(self) -> bool:
        """Whether the last frame could be tracked."""
        return self.tracker.trusted

    def step(self, frame: Pixels, found: Proposal) -> tuple[Map, Map]:
        """As `Tracker.step`, with the proposals `found` in the frame."""
        tracker = self.tracker
        found = found.within(tracker.tissue)
        verdict = self._verdict[found.blocks()]
        self.blocked = found.known | (verdict > 0).any(0)
        new = np.count_nonzero(found.either & (verdict == 0).all(0)) >= Selection.new_px
        # Near a proposal the confidence depends on the proposal too.
        tracker.unsure = _widened((found.either | self.rest_found.either).astype(np.int16)) > 0
        resets = tracker.resets
        flow, confidence = tracker.step(frame, self.blocked)
        first, low_confidence = tracker.last, not tracker.trusted
        assert first is not None
        self._frames += 1
        due = new or low_confidence or self._motion(flow) > self._tested_px + Selection.grown_px
        proposed = (found.either | self.rest_found.either).any()
        if due and proposed and self._selections < Selection.first + self._frames / Selection.every:
            self._selections += 1
            better = self._select(frame, found, first)
            if better is not first:
                flow, confidence = tracker.accept(better)
        self.reinitialised = tracker.trusted and (low_confidence or tracker.resets > resets)
        assert tracker.last is not None
        # Highlights stay in place with the lamp: over faint tissue they would support zero motion.
        stay = self.rest_found.glare & found.glare
        return flow, np.where(stay, np.minimum(confidence, np.float32(tracker.last.level)), confidence)

    def _select(self, frame: Pixels, found: Proposal, first: Solution) -> Solution:
        """Selects masks and returns the solution; the masks are stored unless the frame is lost."""
        tracker, at_rest = self.tracker, self.rest_found
        initial = first.flow if tracker.trusted and self._tested_px > 0 else None
        solved = [(self.rest_blocked, self.blocked, first)]

        def solve(rest: Mask, now: Mask) -> Solution:
            for *masks, solution in solved:
                if np.array_equal([rest, now], masks):
                    return solution
            tracker.usable = tracker.tissue & ~rest
            solved.append((rest, now, tracker.solve(frame, now, initial)))
            return solved[-1][2]

        rest, now = at_rest.known, found.known
        bare, full = solve(rest, now), solve(rest | at_rest.either, now | found.either)
        motion = self._motion(bare.flow)
        blocks, (selected, masked) = found.blocks(), self._judge(frame, found, bare.flow, full.flow)
        tried = rest | selected[at_rest.blocks()].any(0)
        if tracker.trusted and motion < self._tested_px:
            # Verdicts at larger motion are final: a highlight causes no residual while nothing moves.
            tried, masked = self.rest_blocked, np.where(self._verdict == 0, masked, self._verdict > 0)
        chosen = solve(tried, now | masked[blocks].any(0))
        if bare.level > chosen.level:
            tried, masked, chosen = rest, np.zeros_like(masked), bare
        if tracker.needs_retry(chosen) and not chosen.is_matched:
            tracker.usable = tracker.tissue & ~self.rest_blocked
            return first  # a lost frame gives no verdict
        judged = np.unique(blocks)[1:]
        self._verdict[judged] = np.where(masked[judged], 1, -1)
        self._tested_px = max(motion, self._tested_px)
        self.rest_blocked, self.blocked = tried, now | masked[blocks].any(0)
        tracker.usable = tracker.tissue & ~self.rest_blocked
        return chosen

    def _motion(self, flow: Map) -> float:
        """90th percentile of the motion over the tissue [px]."""
        return float(np.quantile(np.hypot(*flow.reshape(-1, 2)[self._some].T), 0.9))

    def _judge(self, frame: Pixels, found: Proposal, bare: Map, full: Map) -> tuple[Mask, Mask]:
        """Whether to mask each block at rest and in the frame, (number of blocks + 1,) each, by the residuals
        of the flow without masks (`bare`) and with all of them (`full`)."""
        picture = _normalised(frame)
        residual, left = (_residual(self._rest_picture, picture, flow) for flow in (bare, full))
        blocks, moved, others = self.rest_found.blocks(), *(_at_rest(found.blocks(), f) for f in (bare, full))
        # Pixels that are certainly not tissue do not count.
        inside = self.tracker.tissue & ~self.rest_found.known & (moved >= 0).all(0) & (others >= 0).all(0)
        common = inside & (np.concatenate([blocks, moved, others]) <= 0).all(0)
        usual = float(residual[common].mean() if common.any() else np.median(residual))
        count = self._verdict.size

        def mean(field: Map, number: NDArray[np.int16], where: Mask) -> Floats:
            """(2, count): mean of each block and its standard error, which is infinite below two pixels."""
            many = np.bincount(number[where], minlength=count)
            first, second = (np.bincount(number[where], field[where] ** k, count) for k in (1, 2))
            average = first / np.maximum(many, 1)
            variance = np.maximum(second / np.maximum(many, 1) - average**2, 0) / np.maximum(many - 1, 1)
            return np.stack([average, np.where(many > 1, np.sqrt(variance), np.inf)])

        def selected(layers: NDArray[np.int16], local: bool) -> Mask:
            chosen = np.zeros(count, bool)
            for layer in layers:
                near = _widened(np.maximum(layer, 0))
                covered, around = mean(residual, layer, inside), mean(residual, near, common)
                gain = mean(residual - left, near, common)
                usually = np.where(np.isfinite(around[1]) & local, around, [[usual], [0.0]])
                margin = Selection.unexplained + Selection.sure * np.hypot(covered[1], usually[1])
                chosen |= covered[0] > usually[0] + margin
                chosen |= gain[0] > Selection.gain + Selection.sure * gain[1]
            chosen[0] = False
            return chosen

        # At rest a block is compared with its neighbours, which an occluder in the frame affects as much.
        return selected(blocks, local=True), selected(moved, local=False)


def _residual(rest: torch.Tensor, now: torch.Tensor, flow: Map) -> Map:
    """(H, W) absolute difference of the aligned pictures [local deviations]."""
    planes = torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))[None]
    warped, _ = image.warp(now, torch.ones_like(now), planes)
    return np.asarray((warped - rest).abs()[0, 0].numpy(), np.float32)


def _at_rest(blocks: NDArray[np.int16], flow: Map) -> NDArray[np.int16]:
    """Block numbers (2, H, W) of the frame now on the pixels of the rest frame; -1 outside the picture."""
    ends = image.ends(flow)
    moved = [cv2.remap(one.astype(np.float32), *ends, cv2.INTER_NEAREST, borderValue=-1) for one in blocks]
    return np.stack(moved).astype(np.int16)


def _widened(number: NDArray[np.int16]) -> NDArray[np.int16]:
    """Block numbers (H, W) grown by a ring; where rings overlap, the larger number."""
    wide = 2 * Selection.ring_px + 1
    return np.asarray(cv2.dilate(number, np.ones((wide, wide), np.uint8)), np.int16)


def _normalised(picture: Pixels) -> torch.Tensor:
    grey = image.tensor(picture)
    return image.normalise(grey, torch.ones_like(grey))
