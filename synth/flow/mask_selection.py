"""Which of the tools and highlights found in pictures are masked: those that the video itself rules out.

A mask that is wrong hides tissue, and a detector trained elsewhere can be wrong about a whole recording. So
what `mask_detection` finds is a proposal. Two flows are computed, without masks and with every proposal
masked. A block of a proposal is masked if the flow without masks leaves more of the picture unexplained in
it than elsewhere (something came between), or if masking lowers what is left around it (it pulls at its
neighbours). All is taken back if away from proposals the flow without masks is the surer one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from synth.flow import image
from synth.flow.estimator import Estimator, Flags, Flow, Map, Rgb
from synth.flow.track import Solution, Tracker


@dataclass(frozen=True)
class SelectionConstants:
    """When a proposal is masked: chosen on the foreign videos of docs/results/flow/recordings, where always
    used masks cost 0.55 px and chosen ones 0.17; a local deviation is a picture's unit of contrast."""

    largest: float = 0.4  # share of the tissue: more is no instrument and no highlight
    unexplained: float = 0.12  # local deviations by which the residual exceeds that elsewhere
    gain: float = 0.01  # local deviations by which masking lowers the residual around a block
    sure: float = 3.0  # standard errors by which a block shows either: few pixels show either by chance
    ring_px: int = 6  # what is "around" a block
    new_px: int = 20  # so much that was not judged is something new
    cells: int = 6  # blocks on the longer side
    grown_px: float = 0.5  # masks are selected anew as motion grows by so much, or at something new ...
    first: int = 4  # ... so often at first, for time
    every: int = 60  # ... and once in so many frames


SELECTION = SelectionConstants()


@dataclass(frozen=True, eq=False)
class Proposal:
    """What was found in a picture that may be no tissue, and what is known to be none, (H, W) each."""

    glare: Flags
    tool: Flags
    known: Flags  # masked in any case

    def within(self, tissue: Flags) -> Proposal:
        """Without the kind that takes more of the tissue than anything real does."""
        most = SELECTION.largest * np.count_nonzero(tissue)
        glare, tool = (
            kind if np.count_nonzero(kind & tissue) <= most else np.zeros_like(kind)
            for kind in (self.glare, self.tool)
        )
        return replace(self, glare=glare, tool=tool)

    @property
    def either(self) -> Flags:
        """(H, W) both kinds."""
        return self.glare | self.tool

    def blocks(self) -> NDArray[np.int16]:
        """(2, H, W) numbers from 1 on of the squares of glare and of those of tool; 0: neither."""
        height, width = self.glare.shape
        side = max(1, max(height, width) // SELECTION.cells)
        row, column = np.arange(height, dtype=np.int16) // side, np.arange(width, dtype=np.int16) // side
        square = 1 + row[:, None] * (column[-1] + 1) + column
        return np.stack([self.glare * square, self.tool * (square + square[-1, -1])])


class SelectingTracker:
    """A `Tracker` that is given proposals and selects its masks.

    It does so at first motion, as motion grows, when something new turns up, and when trust falls.
    """

    def __init__(self, backend: str | Estimator, rest: Rgb, found: Proposal, tissue: Flags) -> None:
        """Starts at rest, where nothing proposed has to be masked yet. Arguments and errors as `Tracker`.

        Args:
            found: of the rest frame.
        """
        self.tracker = Tracker(backend, rest, found.known, tissue)
        self.rest_found = found.within(tissue)
        self.rest_blocked = found.known
        """(H, W) what is masked in the rest frame, by the last selection."""
        self.blocked = found.known
        """(H, W) what is masked in the last frame."""
        self.reinitialised = False
        """Whether the last frame can be trusted only for other masks, or for a start from nothing."""
        self._rest_picture = _normalised(rest)
        last = Proposal(tissue, np.ones_like(tissue), tissue).blocks().max()
        self._verdict = np.zeros(1 + last, np.int8)  # of blocks: 1 masked, -1 not, 0 not known
        self._some = np.flatnonzero(tissue)[::7]  # pixels by which motion is judged
        self._tested_px = 0.0  # largest motion at which masks were selected
        self._frames = self._selections = 0

    @property
    def trusted(self) -> bool:
        """Whether the last frame could be followed."""
        return self.tracker.trusted

    @property
    def lost(self) -> str:
        """Why the last frame could not be followed; empty if it could."""
        return self.tracker.lost

    def step(self, frame: Rgb, found: Proposal) -> tuple[Flow, Map]:
        """As `Tracker.step`; found: what may be no tissue in the frame."""
        tracker = self.tracker
        found = found.within(tracker.tissue)
        verdict = self._verdict[found.blocks()]
        self.blocked = found.known | (verdict > 0).any(0)
        new = np.count_nonzero(found.either & (verdict == 0).all(0)) >= SELECTION.new_px
        # Near a proposal the confidence speaks of the proposal, too.
        tracker.unsure = _grown(found.either | self.rest_found.either)
        resets = tracker.resets
        flow, confidence = tracker.step(frame, self.blocked)
        first, low_confidence = tracker.last, not tracker.trusted
        assert first is not None
        self._frames += 1
        due = new or low_confidence or self._motion(flow) > self._tested_px + SELECTION.grown_px
        proposed = (found.either | self.rest_found.either).any()
        if due and proposed and self._selections < SELECTION.first + self._frames / SELECTION.every:
            self._selections += 1
            better = self._select(frame, found, first)
            if better is not first:
                flow, confidence = tracker.accept(better)
        self.reinitialised = tracker.trusted and (low_confidence or tracker.resets > resets)
        assert tracker.last is not None
        # Over faint tissue nothing but highlights, which stay with the light, says that nothing moves.
        stay = self.rest_found.glare & found.glare
        return flow, np.where(stay, np.minimum(confidence, np.float32(tracker.last.level)), confidence)

    def _select(self, frame: Rgb, found: Proposal, first: Solution) -> Solution:
        """The answer; its masks are remembered if it is one."""
        tracker, at_rest = self.tracker, self.rest_found
        initial = first.flow if tracker.trusted and self._tested_px > 0 else None
        solved = [(self.rest_blocked, self.blocked, first)]

        def solve(rest: Flags, now: Flags) -> Solution:
            for *masks, answer in solved:
                if np.array_equal([rest, now], masks):
                    return answer
            tracker.usable = tracker.tissue & ~rest
            solved.append((rest, now, tracker.solve(frame, now, initial)))
            return solved[-1][2]

        rest, now = at_rest.known, found.known
        bare, full = solve(rest, now), solve(rest | at_rest.either, now | found.either)
        motion = self._motion(bare.flow)
        blocks, (selected, masked) = found.blocks(), self._judge(frame, found, bare.flow, full.flow)
        tried = rest | selected[at_rest.blocks()].any(0)
        if tracker.trusted and motion < self._tested_px:
            # What was found out at more motion stands: a highlight pulls at nothing while nothing moves.
            tried, masked = self.rest_blocked, np.where(self._verdict == 0, masked, self._verdict > 0)
        chosen = solve(tried, now | masked[blocks].any(0))
        if bare.level > chosen.level:
            tried, masked, chosen = rest, np.zeros_like(masked), bare
        if tracker.is_doubtful(chosen) and not chosen.is_matched:
            tracker.usable = tracker.tissue & ~self.rest_blocked
            return first  # nothing is learned from a frame that can't be followed
        seen = np.unique(blocks)[1:]
        self._verdict[seen] = np.where(masked[seen], 1, -1)
        self._tested_px = max(motion, self._tested_px)
        self.rest_blocked, self.blocked = tried, now | masked[blocks].any(0)
        tracker.usable = tracker.tissue & ~self.rest_blocked
        return chosen

    def _motion(self, flow: Flow) -> float:
        """What a tenth of the tissue exceeds [px]."""
        return float(np.quantile(np.hypot(*flow.reshape(-1, 2)[self._some].T), 0.9))

    def _judge(self, frame: Rgb, found: Proposal, bare: Flow, full: Flow) -> tuple[Flags, Flags]:
        """Whether each block has to be masked at rest and in the frame, (number of blocks + 1,) each.

        By what the flow without masks, and that with all of them, leave unexplained.
        """
        picture = _normalised(frame)
        residual, left = (_residual(self._rest_picture, picture, flow) for flow in (bare, full))
        blocks, moved, others = self.rest_found.blocks(), *(_at_rest(found.blocks(), f) for f in (bare, full))
        # What is known to be no tissue is counted nowhere.
        inside = self.tracker.tissue & ~self.rest_found.known & (moved >= 0).all(0) & (others >= 0).all(0)
        common = inside & (np.concatenate([blocks, moved, others]) <= 0).all(0)
        usual = float(residual[common].mean() if common.any() else np.median(residual))
        count = self._verdict.size

        def mean(field: Map, number: NDArray[np.int16], where: Flags) -> NDArray[np.float64]:
            """(2, count): each block's mean and its standard error, infinite below two pixels."""
            many = np.bincount(number[where], minlength=count)
            first, second = (np.bincount(number[where], field[where] ** k, count) for k in (1, 2))
            average = first / np.maximum(many, 1)
            variance = np.maximum(second / np.maximum(many, 1) - average**2, 0) / np.maximum(many - 1, 1)
            return np.stack([average, np.where(many > 1, np.sqrt(variance), np.inf)])

        def selected(layers: NDArray[np.int16], local: bool) -> Flags:
            chosen = np.zeros(count, bool)
            for layer in layers:
                near = _widened(np.maximum(layer, 0))
                covered, around = mean(residual, layer, inside), mean(residual, near, common)
                gain = mean(residual - left, near, common)
                usually = np.where(np.isfinite(around[1]) & local, around, [[usual], [0.0]])
                margin = SELECTION.unexplained + SELECTION.sure * np.hypot(covered[1], usually[1])
                chosen |= (covered[0] > usually[0] + margin) | (
                    gain[0] > SELECTION.gain + SELECTION.sure * gain[1]
                )
            chosen[0] = False
            return chosen

        # What something covers now is no worse at rest: there the neighbours are as little explained.
        return selected(blocks, local=True), selected(moved, local=False)


def _residual(rest: torch.Tensor, now: torch.Tensor, flow: Flow) -> Map:
    """(H, W) difference of the aligned pictures [local deviations]."""
    planes = torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))[None]
    warped, _ = image.warp(now, torch.ones_like(now), planes)
    return np.asarray((warped - rest).abs()[0, 0].numpy(), np.float32)


def _at_rest(blocks: NDArray[np.int16], flow: Flow) -> NDArray[np.int16]:
    """The now frame's numbers (2, H, W) on the rest frame's pixels; -1 for what left the picture."""
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    moved = [cv2.remap(one.astype(np.float32), x, y, cv2.INTER_NEAREST, borderValue=-1) for one in blocks]
    return np.stack(moved).astype(np.int16)


def _widened(number: NDArray[np.int16]) -> NDArray[np.int16]:
    """(H, W) numbers with a ring around each, the larger number first."""
    wide = 2 * SELECTION.ring_px + 1
    return np.asarray(cv2.dilate(number, np.ones((wide, wide), np.uint8)), np.int16)


def _grown(piece: Flags) -> Flags:
    """(H, W) with a ring around it."""
    return _widened(piece.astype(np.int16)) > 0


def _normalised(picture: Rgb) -> torch.Tensor:
    grey = image.tensor(picture)
    return image.normalise(grey, torch.ones_like(grey))
