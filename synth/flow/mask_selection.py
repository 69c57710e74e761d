"""Which of the tools and highlights found in pictures are masked: those that the video itself rules out.

A mask that is wrong hides tissue, and a detector trained elsewhere can be wrong about a whole recording. So
what `mask_detection` finds is a proposal. Two flows are computed, without masks and with every proposal
masked. A connected piece is masked if the flow without masks leaves more of the picture unexplained in it
than around it (something came between), or if masking lowers what is left around it (it pulls at its
neighbours). All is taken back if away from proposals the flow without masks is the surer one.

Behind each threshold is what goes wrong without it on 16 to 24 films of the half `tuning` of
`evidence.flow.foreign`, as a factor on the mean endpoint error, or in the tests.
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

# What is masked.
_LARGEST = 0.4  # of the tissue: more is no instrument and no highlight (1.06; 26% of a film masked)
_UNEXPLAINED = 0.12  # local deviations by which the residual exceeds that around (1.03, one film 1.46) ...
_TIMES = 1.7  # ... and as a factor (1.01, rendered films 1.04)
_GAIN = 0.01  # local deviations by which masking lowers the residual around a piece (one film 1.96)
_RING_PX = 6  # what is "around" a piece
_SMALLEST_PX = 20  # smaller pieces are not judged (tissue taken for a tool is masked)
_JOINED_PX = 3  # highlights so near to each other are one piece (1.01; highlights that stay are not masked)
_CELLS = 6  # pieces are cut by this share of the longer side (1.01; score of the golden recording 3% off)
_CAPPED = 1.5  # local deviations: one wrong pixel counts no more (score of the golden recording 1.3% off)
# When it is selected anew: what the selection may cost.
_GROWN_PX = 0.5  # as motion grows by so much
_SPARE, _SHARE = 10, 0.05  # solutions beyond one a frame that are allowed at once, and a frame
# When highlights alone hold the picture still (such frames are followed without a sign).
_HELD = 0.2  # they move by less than this share of what is away from them,
_AWAY_MATCHED = 0.5  # less than this share of which is found again (13 frames flagged that could be followed)


@dataclass(frozen=True, eq=False)
class Proposal:
    """What was found in a picture that may be no tissue, and what is known to be none, (H, W) each."""

    glare: Flags
    tool: Flags
    known: Flags
    """Masked in any case."""

    def within(self, tissue: Flags) -> Proposal:
        """Without the kind that takes more of the tissue than anything real does."""
        most = _LARGEST * np.count_nonzero(tissue)
        glare, tool = (
            kind if np.count_nonzero(kind & tissue) <= most else np.zeros_like(kind)
            for kind in (self.glare, self.tool)
        )
        return replace(self, glare=glare, tool=tool)

    @property
    def either(self) -> Flags:
        """(H, W) both kinds."""
        return self.glare | self.tool

    def pieces(self) -> NDArray[np.int32]:
        """(2, H, W) numbers of the connected pieces of glare and of tool, from 1 on through both; 0: none.

        They are cut by a grid: a large one may be partly right.
        """
        height, width = self.glare.shape
        joined = cv2.dilate(self.glare.astype(np.uint8), np.ones((2 * _JOINED_PX + 1,) * 2, np.uint8))
        count, glare = cv2.connectedComponents(joined)
        _, tool = cv2.connectedComponents(self.tool.astype(np.uint8))
        side = max(_SMALLEST_PX, max(height, width) // _CELLS)
        cell = np.arange(height)[:, None] // side * width + np.arange(width) // side
        code = np.stack([glare, tool + count]) * height * width + cell
        proposed, number = np.stack([self.glare, self.tool]), np.zeros(code.shape, np.int32)
        number[proposed] = np.unique(code[proposed], return_inverse=True)[1] + 1
        return number


class SelectingTracker:
    """A `Tracker` that is given proposals and selects its masks.

    It does so at first motion, as motion grows, when something new turns up, and when trust falls; beyond the
    first frames, solutions for it are at most a twentieth of the others.
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
        self.regained = False
        """Whether the last frame can be trusted only for other masks, or for a start from nothing."""
        self._rest_pieces, self._rest_picture = self.rest_found.pieces(), _normalised(rest)
        self._verdict = np.zeros((2, *tissue.shape), np.int8)  # 1 masked, -1 not, 0 not known
        self._tested_px = 0.0  # largest motion at which masks were selected
        self._frames = self._extra = 0

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
        pieces = found.pieces()
        masked, known = self._remembered(pieces)
        masked |= found.known
        new = np.count_nonzero(found.either & ~known) >= _SMALLEST_PX
        self._frames += 1
        resets, learns = tracker.resets, True
        flow, confidence = tracker.step(frame, masked)
        first, doubted = tracker.last, not tracker.trusted
        assert first is not None
        if (found.either | self.rest_found.either).any() and self._is_due(flow, bool(new)):
            better, masked, learns = self._select(frame, found, pieces, first, masked, known)
            if better is not first:
                flow, confidence = tracker.accept(better)
        self.regained = tracker.trusted and (doubted or tracker.resets > resets)
        self.blocked = masked
        if tracker.trusted and self._is_held_still(found):
            flow, confidence = tracker.doubt("highlights that stay where they are hold the picture still")
            self.regained = False
        if tracker.trusted and learns:
            self._verdict = np.where(pieces > 0, np.where(masked, 1, -1), 0).astype(np.int8)
        return flow, confidence

    def _remembered(self, pieces: NDArray[np.int32]) -> tuple[Flags, Flags]:
        """(H, W) what is masked as it was in the frame before, and what has such a past."""
        number, verdict = pieces.ravel(), self._verdict.ravel()
        masked = np.bincount(number, verdict) > 0
        known = np.bincount(number, verdict != 0) >= 0.5 * np.bincount(number)
        masked[0] = known[0] = False
        return np.any(masked[pieces], axis=0), np.any(known[pieces], axis=0)

    def _is_due(self, flow: Flow, new: bool) -> bool:
        if self._extra + 2 > _SPARE + _SHARE * self._frames:
            return False
        grown = _motion(flow, self.tracker.tissue) > self._tested_px + _GROWN_PX
        return grown or new or not self.tracker.trusted

    def _is_held_still(self, found: Proposal) -> bool:
        """Whether only highlights say that nothing moves.

        Over tissue so faint that noise hides it, nothing contradicts highlights that stay with the light, and
        they are what is found again. Away from them hardly anything is, and what little is known there moves.
        """
        tracker, last = self.tracker, self.tracker.last
        before, now = self.rest_found.glare, found.glare
        assert last is not None
        visible = tracker.usable & ~self.blocked
        shining = visible & before & now  # what shines in one picture alone doesn't stay
        away = visible & ~_grown(before | now)
        if min(np.count_nonzero(shining), np.count_nonzero(away)) < _SMALLEST_PX:
            return False
        length = np.hypot(last.flow[..., 0], last.flow[..., 1])
        if float(np.median(length[shining])) >= _HELD * float(np.quantile(length[away], 0.9)):
            return False
        return tracker.judge(last.flow, last.confidence, away).matched < _AWAY_MATCHED

    def _select(
        self,
        frame: Rgb,
        found: Proposal,
        pieces: NDArray[np.int32],
        first: Solution,
        masked: Flags,
        known: Flags,
    ) -> tuple[Solution, Flags, bool]:
        """The answer, its masks (H, W), and whether they are to be remembered.

        `first`: the answer with what is `masked` so far; `known`: what of it was judged before.
        """
        tracker, at_rest = self.tracker, self.rest_found
        initial = first.flow if tracker.trusted and self._tested_px > 0 else None
        solved = [(self.rest_blocked, masked, first)]

        def solve(rest: Flags, now: Flags) -> Solution:
            for one, other, answer in solved:
                if np.array_equal(one, rest) and np.array_equal(other, now):
                    return answer
            self._extra += 1 if initial is not None else 2
            tracker.usable = tracker.tissue & ~rest
            solved.append((rest, now, tracker.solve(frame, now, initial)))
            tracker.usable = tracker.tissue & ~self.rest_blocked
            return solved[-1][2]

        bare = solve(at_rest.known, found.known)
        full = solve(at_rest.known | at_rest.either, found.known | found.either)
        rest, now = self._judge(frame, pieces, bare.flow, full.flow)
        rest, now = rest | at_rest.known, now | found.known
        motion = _motion(bare.flow, tracker.tissue)
        if tracker.trusted and motion < self._tested_px:
            # What was found out at more motion stands: a highlight pulls at nothing while nothing moves.
            rest, now = self.rest_blocked, np.where(known, masked, now)
        chosen = solve(rest, now)
        if tracker.is_doubtful(chosen) and not chosen.is_matched:
            return first, masked, False  # nothing is learned from a frame that can't be followed
        # Near a proposal the confidence speaks of the proposal, too.
        beyond = tracker.tissue & ~(now | rest) & ~_grown(found.either | at_rest.either)
        without, level = (tracker.judge(one.flow, one.confidence, beyond).level for one in (bare, chosen))
        if without > level:
            rest, now, chosen = at_rest.known, found.known, bare
        self._tested_px = max(motion, self._tested_px)
        self.rest_blocked = rest
        tracker.usable = tracker.tissue & ~rest
        return chosen, now, True

    def _judge(self, frame: Rgb, pieces: NDArray[np.int32], bare: Flow, full: Flow) -> tuple[Flags, Flags]:
        """(H, W) what of the proposals has to be masked at rest and in the frame.

        By what the flow without masks, and that with all of them, leave unexplained.
        """
        picture = _normalised(frame)
        residual, left = (_residual(self._rest_picture, picture, flow) for flow in (bare, full))
        gain = residual - left
        moved, others = (_at_rest(pieces, flow) for flow in (bare, full))
        # What is known to be no tissue is counted nowhere.
        inside = self.tracker.tissue & ~self.rest_found.known & (moved >= 0).all(0) & (others >= 0).all(0)
        common = inside & (np.concatenate([self._rest_pieces, moved, others]) <= 0).all(0)
        usual = float(residual[common].mean() if common.any() else np.median(residual))

        def selected(layers: NDArray[np.int32], local: bool) -> list[int]:
            """Numbers of pieces, judged against what lies around them or against all tissue."""
            numbers = []
            for layer in layers:
                for number in np.unique(layer[layer > 0]).tolist():
                    piece = (layer == number) & inside
                    if np.count_nonzero(piece) < _SMALLEST_PX:
                        continue
                    ring = _grown(piece) & common
                    enough = np.count_nonzero(ring) >= _SMALLEST_PX
                    around = float(residual[ring].mean()) if local and enough else usual
                    came_between = float(residual[piece].mean()) > max(around + _UNEXPLAINED, _TIMES * around)
                    if came_between or (enough and float(gain[ring].mean()) > _GAIN):
                        numbers.append(number)
            return numbers

        # What something covers now is no worse at rest: there the neighbours are as little explained.
        rest, now = selected(self._rest_pieces, local=True), selected(moved, local=False)
        return np.any(np.isin(self._rest_pieces, rest), axis=0), np.any(np.isin(pieces, now), axis=0)


def _residual(rest: torch.Tensor, now: torch.Tensor, flow: Flow) -> Map:
    """(H, W) difference of the aligned pictures, capped [local deviations]."""
    planes = torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))[None]
    warped, _ = image.warp(now, torch.ones_like(now), planes)
    return np.asarray((warped - rest).abs().clamp(max=_CAPPED)[0, 0].numpy(), np.float32)


def _at_rest(pieces: NDArray[np.int32], flow: Flow) -> NDArray[np.int32]:
    """The now frame's numbers (2, H, W) on the rest frame's pixels; -1 for what left the picture."""
    height, width = flow.shape[:2]
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    moved = [cv2.remap(one.astype(np.float32), x, y, cv2.INTER_NEAREST, borderValue=-1) for one in pieces]
    return np.stack(moved).astype(np.int32)


def _grown(piece: Flags) -> Flags:
    """(H, W) with `_RING_PX` around it."""
    wide = 2 * _RING_PX + 1
    return np.asarray(cv2.dilate(piece.astype(np.uint8), np.ones((wide, wide), np.uint8)) > 0, bool)


def _motion(flow: Flow, tissue: Flags) -> float:
    """What a tenth of the tissue exceeds [px]."""
    return float(np.quantile(np.hypot(flow[..., 0], flow[..., 1])[tissue][::7], 0.9))


def _normalised(picture: Rgb) -> torch.Tensor:
    grey = image.tensor(picture)
    return image.normalise(grey, torch.ones_like(grey))
