"""Masks that have to earn their place: which found tools and highlights are masked, by the video alone.

A mask that is wrong blanks tissue, and a detector trained elsewhere can be wrong about a whole recording. So
what `synth.flow.mask` finds is a proposal. Two flows are computed, with every proposal masked and with none;
a connected piece is masked if the flow without masks doesn't explain what is seen in it (something came
between), or if masking it lowers the residual of what both flows see around it (it pulls at its neighbours).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from synth.flow import image
from synth.flow.estimator import Estimator, Flags, Flow, Map, Rgb
from synth.flow.track import Solved, Tracker

_LARGEST = 0.4  # of the tissue: proposals that take more are no instrument and no highlight
_UNEXPLAINED = 0.12  # local deviations by which a piece's residual exceeds that of what isn't proposed ...
_TIMES = 1.7  # ... and as a factor
_GAIN = 0.01  # local deviations by which masking lowers the residual around a piece
_RING_PX = 8
_CELLS = 6  # a body is judged in parts of this share of the picture's longer side;
_MOST = 0.7  # where more than this share of it is masked, all of it is,
_NEARLY_ALL = 0.9  # and where more than this of a kind is, with its specks, all of the kind
_CAPPED = 1.5  # local deviations: one wrong pixel counts no more
_SMALLEST = 20  # px: smaller pieces are not judged
_JOINED_PX = 3  # highlights so near to each other are one piece
_AS_GOOD = 0.99  # share of the confidence without masks that has to be left, where both look
_GROWN = 1.5  # the choice is made again when motion has grown by this factor,
_STILL_PX = 0.5  # from this on,
_NEW = 0.005  # or when a piece of this share of the tissue turns up where none was
_SPARE = 24  # solutions beyond one a frame that are allowed at once (one from nothing counts twice), and
_SHARE = 0.05  # a frame


@dataclass(frozen=True, eq=False)
class Proposal:
    """What was found in a picture that may be no tissue, and what is known to be none, (H, W) each."""

    glare: Flags
    tool: Flags
    known: Flags
    """Masked without being asked."""

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

    def pieces(self) -> Pieces:
        """Connected pieces of glare and of tool, cut by a grid: one may be partly right."""
        joined = cv2.dilate(self.glare.astype(np.uint8), np.ones((2 * _JOINED_PX + 1,) * 2, np.uint8))
        height, width = self.glare.shape
        side = max(_SMALLEST, max(height, width) // _CELLS)
        cell = np.arange(height)[:, None] // side * (width // side + 1) + np.arange(width) // side
        cells = int(cell[-1, -1]) + 1
        layers, last = [], 0
        for where, grown in ((self.glare, joined), (self.tool, self.tool.astype(np.uint8))):
            count, label = cv2.connectedComponents(grown)
            layers.append(np.where(where, (label + last) * cells + cell + 1, 0))
            last += count
        code = np.stack(layers)
        there = np.zeros(last * cells + 1, bool)  # instead of sorting all pixels, a tenth of a live frame
        there[code] = True
        there[0] = True
        return Pieces((np.cumsum(there) - 1)[code].astype(np.int32), (np.flatnonzero(there) - 1) // cells)


@dataclass(frozen=True, eq=False)
class Pieces:
    """Parts of a proposal that are judged one by one."""

    number: NDArray[np.int32]
    """(2, H, W) of glare and of tool: from 1 on through both, 0: none."""
    body: NDArray[np.int64]
    """(n,) the connected body of each number."""

    def whole(self, kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """(n,) with all of those bodies, and of those kinds, of which most is kept. kept: (n,)."""
        result = kept.copy()
        for layer in self.number:
            size = np.bincount(layer.ravel(), minlength=len(self.body)).astype(float)
            size[0] = 0
            _, body = np.unique(self.body, return_inverse=True)
            share = np.bincount(body, size * kept) / np.maximum(np.bincount(body, size), 1)
            result |= (share > _MOST)[body] & (size > 0)
            if (size * result).sum() > _NEARLY_ALL * size.sum():
                result |= size > 0
        result[0] = False
        return result


class ChoosingTracker:
    """A `Tracker` that is given proposals and chooses its masks.

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
        """(H, W) what is masked in the rest frame, by the last choice."""
        self.blocked = found.known
        """(H, W) what is masked in the last frame."""
        self.regained = False
        """Whether the last frame can be trusted only for other masks, or for a start from nothing."""
        self._rest_pieces = self.rest_found.pieces()
        self._rest_picture = _normalised(rest)
        self._verdict = np.zeros((2, *tissue.shape), np.int8)  # 1 masked, -1 not, 0 not known
        self._tested_px = 0.0
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
        tracker, tissue = self.tracker, self.tracker.tissue
        found = found.within(tissue)
        pieces = found.pieces()
        masked, known = self._remembered(pieces)
        masked |= found.known
        new = bool(np.count_nonzero(found.either & ~known) > _NEW * np.count_nonzero(tissue))
        self._frames += 1
        self.regained = False
        resets = tracker.resets
        flow, confidence = tracker.step(frame, masked)
        proposed = bool((found.either | self.rest_found.either).any())
        if proposed and self._is_due(flow, new):
            first = tracker.last
            assert first is not None
            better, masked = self._choose(frame, found, pieces, first, masked, known)
            if better is not first:
                doubted = not tracker.trusted
                flow, confidence = tracker.accept(better)
                self.regained = doubted and tracker.trusted
        self.regained |= tracker.trusted and tracker.resets > resets
        self.blocked = masked
        if tracker.trusted:
            self._verdict = np.where(pieces.number > 0, np.where(masked, 1, -1), 0).astype(np.int8)
        return flow, confidence

    def _remembered(self, pieces: Pieces) -> tuple[Flags, Flags]:
        """(H, W) what is masked as it was in the frame before, and which pieces have such a past."""
        number = pieces.number.ravel()
        votes = np.bincount(number, self._verdict.ravel(), len(pieces.body))
        known = np.bincount(number, self._verdict.ravel() != 0, len(pieces.body))
        kept, old = votes > 0, known >= 0.5 * np.bincount(number, minlength=len(pieces.body))
        kept[0] = old[0] = False
        return np.asarray(kept[pieces.number].any(0), bool), np.asarray(old[pieces.number].any(0), bool)

    def _is_due(self, flow: Flow, new: bool) -> bool:
        if self._extra + 2 > _SPARE + _SHARE * self._frames:
            return False
        if new or not self.tracker.trusted:
            return True
        return _motion(flow, self.tracker.tissue) > max(_STILL_PX, _GROWN * self._tested_px)

    def _choose(
        self,
        frame: Rgb,
        found: Proposal,
        pieces: Pieces,
        first: Solved,
        masked: Flags,
        known: Flags,
    ) -> tuple[Solved, Flags]:
        """Tries all proposals and none, keeps those that earn it, and gives the answer and its masks."""
        tracker = self.tracker
        fixed = self.rest_found.known
        bare = self._solve(frame, fixed, found.known, first, masked)
        full = self._solve(frame, fixed | self.rest_found.either, found.known | found.either, first, masked)
        rest, now = self._earned(frame, pieces, bare.flow, full.flow)
        rest, now = rest | fixed, now | found.known
        motion = _motion(bare.flow, tracker.tissue)
        if tracker.trusted and motion < self._tested_px:
            # What was found out at more motion stands: a highlight pulls at nothing while nothing moves.
            rest, now = self.rest_blocked, np.where(known, masked, now)
        chosen = self._solve(frame, rest, now, first, masked)
        if tracker.is_doubtful(chosen):
            # Nothing is learned from a frame that can't be followed; its answer is what fits best where all
            # of them look: without masks, a still highlight would vouch for stillness.
            common = tracker.usable & ~(masked | now | rest)
            tries = [(first, masked), (chosen, now), (bare, found.known)]
            judged = [tracker.judge(one.flow, one.confidence, common) for one, _ in tries]
            best = max(range(len(tries)), key=lambda k: judged[k].level)
            return (judged[best], tries[best][1]) if best else (first, masked)
        both_see = tracker.tissue & ~(now | rest)
        levels = [tracker.judge(one.flow, one.confidence, both_see).level for one in (chosen, bare)]
        if levels[0] < _AS_GOOD * levels[1]:
            rest, now, chosen = fixed, found.known, bare
        self._tested_px = max(motion, self._tested_px)
        self.rest_blocked = rest
        tracker.usable = tracker.tissue & ~rest
        return chosen, now

    def _solve(self, frame: Rgb, rest: Flags, now: Flags, first: Solved, masked: Flags) -> Solved:
        if np.array_equal(rest, self.rest_blocked) and np.array_equal(now, masked):
            return first
        before, self.tracker.usable = self.tracker.usable, self.tracker.tissue & ~rest
        warm = first.flow if self.tracker.trusted and self._tested_px > 0 else None
        try:
            self._extra += 1 if warm is not None else 2
            return self.tracker.solve(frame, now, warm)
        finally:
            self.tracker.usable = before

    def _earned(self, frame: Rgb, pieces: Pieces, bare: Flow, full: Flow) -> tuple[Flags, Flags]:
        """(H, W) what is masked in the rest frame and in this one."""
        now = _normalised(frame)
        residual, residual_full = (_residual(self._rest_picture, now, flow) for flow in (bare, full))
        moved = [np.stack([_at_rest(layer, flow) for layer in pieces.number]) for flow in (bare, full)]
        # What is known to be no tissue is counted nowhere.
        inside = self.tracker.tissue & ~self.rest_found.known & _stays(bare) & _stays(full)
        common = inside & ~((self._rest_pieces.number > 0) | (moved[0] > 0) | (moved[1] > 0)).any(0)
        usual = float(residual[common].mean()) if common.any() else float(np.median(residual))
        gain = np.where(common, residual - residual_full, 0)

        def earning(where: NDArray[np.int32], judged: Pieces, beside: bool) -> NDArray[np.bool_]:
            """By number; beside: judged against what lies around a piece, not against all tissue."""
            kept = np.zeros(len(judged.body), bool)
            for number in np.flatnonzero(np.bincount(where.ravel()) >= _SMALLEST):
                piece = (where == number).any(0) & inside
                if not number or np.count_nonzero(piece) < _SMALLEST:
                    continue
                ring = _ring(piece) & common
                enough = np.count_nonzero(ring) >= _SMALLEST
                around = float(residual[ring].mean()) if beside and enough else usual
                kept[number] = float(residual[piece].mean()) > max(
                    around + _UNEXPLAINED, _TIMES * around
                ) or (enough and float(gain[ring].mean()) > _GAIN)
            return judged.whole(kept)

        # What something covers now is no worse at rest: there the neighbours are as little explained.
        still = self._rest_pieces
        kept_rest, kept = earning(still.number, still, True), earning(moved[0], pieces, False)
        for before, after in zip(still.number, pieces.number, strict=True):
            shown = after[after > 0]
            if len(shown) and kept[shown].mean() > _NEARLY_ALL:
                kept_rest[before[before > 0]] = True  # the kind has proved right
        return np.asarray(kept_rest[still.number].any(0), bool), np.asarray(kept[pieces.number].any(0), bool)


def _ring(piece: Flags) -> Flags:
    wide = 2 * _RING_PX + 1
    return np.asarray(cv2.dilate(piece.astype(np.uint8), np.ones((wide, wide), np.uint8)) > 0, bool)


def _stays(flow: Flow) -> Flags:
    """(H, W): what the now frame's picture still holds."""
    height, width = flow.shape[:2]
    x = np.arange(width) + flow[..., 0]
    y = np.arange(height)[:, None] + flow[..., 1]
    return np.asarray((x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1), bool)


def _motion(flow: Flow, tissue: Flags) -> float:
    """What a tenth of the tissue exceeds [px]."""
    return float(np.quantile(np.hypot(flow[..., 0], flow[..., 1])[tissue][::7], 0.9))


def _normalised(picture: Rgb) -> torch.Tensor:
    grey = image.tensor(picture)
    return image.normalise(grey, torch.ones_like(grey))


def _residual(rest: torch.Tensor, now: torch.Tensor, flow: Flow) -> Map:
    """(H, W) capped difference of the aligned pictures, in local deviations."""
    planes = torch.from_numpy(np.ascontiguousarray(flow.transpose(2, 0, 1)))[None]
    warped, _ = image.warp(now, torch.ones_like(now), planes)
    return np.asarray((warped - rest).abs().clamp(max=_CAPPED)[0, 0].numpy(), np.float32)


def _at_rest(layer: NDArray[np.int32], flow: Flow) -> NDArray[np.int32]:
    """Numbers of the now frame on the rest frame's pixels, (H, W)."""
    height, width = layer.shape
    x = np.arange(width, dtype=np.float32) + flow[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
    found = cv2.remap(layer.astype(np.float32), x, y, cv2.INTER_NEAREST, borderValue=0)
    return np.asarray(found, np.int32)
