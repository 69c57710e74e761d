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
from synth.flow.track import Solution, Tracker

_LARGEST = 0.4  # of the tissue: proposals that take more are no instrument and no highlight
_UNEXPLAINED = 0.12  # local deviations by which a piece's residual exceeds that of what isn't proposed ...
_TIMES = 1.7  # ... and as a factor
_GAIN = 0.01  # local deviations by which masking lowers the residual around a piece
_GAIN_OF_ALL = 0.0015  # the same around all highlights, where that changes the flow by
_DIFFERENT_PX = 0.1  # as much: then so much around one of them is enough
_GAIN_EACH = 0.006
_RING_PX = 8
_CELLS = 6  # a body is judged in parts of this share of the picture's longer side;
_MOST = 0.7  # where more than this share of it is masked, all of it is,
_NEARLY_ALL = 0.9  # and where more than this of a kind is, with its specks, all of the kind
_CAPPED = 1.5  # local deviations: one wrong pixel counts no more
_SMALLEST = 20  # px: smaller pieces are not judged
_JOINED_PX = 3  # highlights so near to each other are one piece
_LEAST_BEYOND = 0.05  # share of the tissue away from proposals that is enough to judge by
_AS_GOOD = 0.99  # share of the confidence without masks that has to be left, where both look
_GROWN = 1.5  # the choice is made again when motion has grown by this factor,
_STILL_PX = 0.5  # from this on,
_NEW = 0.005  # or when a piece of this share of the tissue turns up where none was
_HELD = 0.2  # highlights hold the picture still where they move by less than this share of what is
_AWAY_PX = 6  # so far away from them, a tenth of which moves by
_AWAY_MOVES_PX = 0.6  # this, if less than
_AWAY_MATCHED = 0.5  # this share of that is found again: the highlights vouch for themselves alone
_SPARE = 10  # solutions beyond one a frame that are allowed at once (one from nothing counts twice), and
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
        self._is_learning, self._vouching = True, False
        self._proved = [False, False]  # highlights, tools

    @property
    def trusted(self) -> bool:
        """Whether the last frame could be followed."""
        return self.tracker.trusted

    @property
    def tested(self) -> bool:
        """Whether masks have been chosen on some motion."""
        return self._tested_px > 0

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
        self.regained, self._is_learning = False, True
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
        if tracker.trusted and self._is_held_still(found):
            flow, confidence = tracker.doubt("highlights that stay where they are hold the picture still")
            self.regained = False
        if tracker.trusted and self._is_learning:
            self._verdict = np.where(pieces.number > 0, np.where(masked, 1, -1), 0).astype(np.int8)
        return flow, confidence

    def _remembered(self, pieces: Pieces) -> tuple[Flags, Flags]:
        """(H, W) what is masked as it was in the frame before, and what has such a past, or is of a kind that
        was right."""
        number = pieces.number.ravel()
        votes = np.bincount(number, self._verdict.ravel(), len(pieces.body))
        known = np.bincount(number, self._verdict.ravel() != 0, len(pieces.body))
        kept, old = votes > 0, known >= 0.5 * np.bincount(number, minlength=len(pieces.body))
        for layer, proved in zip(pieces.number, self._proved, strict=True):
            if proved:
                fresh = np.setdiff1d(layer, np.flatnonzero(old))
                kept[fresh] = old[fresh] = True  # a tool that comes back is the tool it was
        kept[0] = old[0] = False
        return np.asarray(kept[pieces.number].any(0), bool), np.asarray(old[pieces.number].any(0), bool)

    def _is_due(self, flow: Flow, new: bool) -> bool:
        if self._extra + 2 > _SPARE + _SHARE * self._frames:
            return False
        if new or not self.tracker.trusted:
            return True
        return _motion(flow, self.tracker.tissue) > max(_STILL_PX, _GROWN * self._tested_px)

    def _is_held_still(self, found: Proposal) -> bool:
        """Whether only highlights say that nothing moves.

        Over tissue so faint that noise hides it, nothing contradicts highlights that stay with the light, and
        they are what is found again. Away from them hardly anything is, and what little is known there moves.
        """
        tracker, last = self.tracker, self.tracker.last
        before, now = self.rest_found.glare, found.glare
        assert last is not None
        seen = tracker.usable & ~self.blocked
        shining = seen & before & now  # what shines in one picture alone doesn't stay
        if np.count_nonzero(shining) < _SMALLEST:
            return False
        away = seen & ~_ring(before | now, _AWAY_PX)
        if np.count_nonzero(away) < _LEAST_BEYOND * seen.size:
            return False
        length = np.hypot(last.flow[..., 0], last.flow[..., 1])
        moves = float(np.quantile(length[away], 0.9))
        if moves < _AWAY_MOVES_PX or float(np.median(length[shining])) >= _HELD * moves:
            return False
        return tracker.judge(last.flow, last.confidence, away).matched < _AWAY_MATCHED

    def _choose(
        self,
        frame: Rgb,
        found: Proposal,
        pieces: Pieces,
        first: Solution,
        masked: Flags,
        known: Flags,
    ) -> tuple[Solution, Flags]:
        """Tries all proposals and none, keeps those that earn it, and gives the answer and its masks."""
        tracker, still = self.tracker, self.rest_found
        tries, self._vouching = _Tries(self, frame, first, masked), False
        bare = tries.solve(still.known, found.known)
        # Highlights by themselves, too: a tool that is none must not speak against them.
        shine = tries.solve(still.known | still.glare, found.known | found.glare)
        full = tries.solve(still.known | still.either, found.known | found.either)
        rest, now = self._earned(frame, pieces, bare.flow, (shine.flow, full.flow))
        rest, now = rest | still.known, now | found.known
        motion = _motion(bare.flow, tracker.tissue)
        if tracker.trusted and motion < self._tested_px:
            # What was found out at more motion stands: a highlight pulls at nothing while nothing moves.
            rest, now = self.rest_blocked, np.where(known, masked, now)
        chosen = tries.solve(rest, now)
        both_see = tracker.tissue & ~(now | rest)
        # Next to a proposal the confidence speaks of the proposal, too.
        beyond = both_see & ~_ring(found.either | still.either)
        if np.count_nonzero(beyond) < _LEAST_BEYOND * np.count_nonzero(tracker.tissue):
            beyond = both_see
        if tracker.is_doubtful(chosen) and not (chosen.is_matched and self._is_better(chosen, bare, beyond)):
            # Nothing is learned from a frame that can't be followed; its answer is what fits best where all
            # of them look: without masks, a still highlight would vouch for stillness.
            common = beyond & tracker.usable & ~masked
            self._is_learning = False
            answers = [(first, masked), (chosen, now), (bare, found.known)]
            judged = [tracker.judge(one.flow, one.confidence, common) for one, _ in answers]
            best = max(range(len(answers)), key=lambda k: judged[k].level)
            return (judged[best], answers[best][1]) if best else (first, masked)
        # Highlights that hold their neighbours still have more confidence than the truth.
        if not self._vouching and all(
            self._is_better(bare, chosen, where, 1 / _AS_GOOD) for where in (both_see, beyond)
        ):
            rest, now, chosen = still.known, found.known, bare
        if motion >= self._tested_px:
            shares = [now[layer > 0].mean() if layer.any() else 0.0 for layer in pieces.number]
            self._proved = [bool(share > _NEARLY_ALL) for share in shares]
        self._tested_px = max(motion, self._tested_px)
        self.rest_blocked = rest
        tracker.usable = tracker.tissue & ~rest
        return chosen, now

    def _is_better(self, one: Solution, other: Solution, where: Flags, by: float = 1.0) -> bool:
        """Whether an answer has more than `by` times the other's confidence, (H, W) where."""
        levels = [self.tracker.judge(each.flow, each.confidence, where).level for each in (one, other)]
        return levels[0] > by * levels[1]

    def solve(self, frame: Rgb, rest: Flags, now: Flags, initial: Flow | None) -> Solution:
        """A frame's answer with other masks, (H, W) of the rest frame and of it; it is counted."""
        before, self.tracker.usable = self.tracker.usable, self.tracker.tissue & ~rest
        try:
            self._extra += 1 if initial is not None else 2
            return self.tracker.solve(frame, now, initial)
        finally:
            self.tracker.usable = before

    def _earned(
        self, frame: Rgb, pieces: Pieces, bare: Flow, without: tuple[Flow, Flow]
    ) -> tuple[Flags, Flags]:
        """(H, W) what is masked in the rest frame and in this one.

        `without`: the flow with all highlights masked, and that with all tools masked too.
        """
        now, still = _normalised(frame), self._rest_pieces
        residual = before = _residual(self._rest_picture, now, bare)
        kept_rest, kept = (np.zeros(len(each.body), bool) for each in (still, pieces))
        flow_before = bare
        for kind, flow in enumerate(without):
            moved = [np.stack([_at_rest(layer, f) for layer in pieces.number]) for f in (bare, flow)]
            # What is known to be no tissue is counted nowhere.
            inside = self.tracker.tissue & ~self.rest_found.known & _stays(bare) & _stays(flow)
            common = inside & ~((still.number > 0) | (moved[0] > 0) | (moved[1] > 0)).any(0)
            after = _residual(self._rest_picture, now, flow)
            seen = _Evidence(residual, before - after, inside, common)
            # Highlights have one cause.
            one = kind == 0 and seen.together((still.number[0] > 0) | (moved[0][0] > 0), flow_before - flow)
            self._vouching |= one
            # What something covers now is no worse at rest: there the neighbours are as little explained.
            kept_rest |= seen.earning(still.number[kind], len(still.body), one, beside=True)
            kept |= seen.earning(moved[0][kind], len(pieces.body), one, beside=False)
            before, flow_before = after, flow
        kept_rest, kept = still.whole(kept_rest), pieces.whole(kept)
        for before, after in zip(still.number, pieces.number, strict=True):
            # A kind that has proved right in one picture is right in the other.
            at_rest, later = (k[n[n > 0]] for k, n in ((kept_rest, before), (kept, after)))
            if any(len(shown) and shown.mean() > _NEARLY_ALL for shown in (at_rest, later)):
                kept_rest[before[before > 0]] = kept[after[after > 0]] = True
        return np.asarray(kept_rest[still.number].any(0), bool), np.asarray(kept[pieces.number].any(0), bool)


class _Tries:
    """Answers for one frame with one mask and another, each solved once."""

    def __init__(self, tracker: ChoosingTracker, frame: Rgb, first: Solution, masked: Flags) -> None:
        """`first`: the answer with what is masked, (H, W), so far."""
        self._tracker, self._frame = tracker, frame
        is_warm = tracker.trusted and tracker.tested
        self._initial = first.flow if is_warm else None
        self._solved = [(tracker.rest_blocked, masked, first)]

    def solve(self, rest: Flags, now: Flags) -> Solution:
        """With those masks, (H, W) of the rest frame and of this one."""
        for one, other, solved in self._solved:
            if np.array_equal(one, rest) and np.array_equal(other, now):
                return solved
        self._solved.append((rest, now, self._tracker.solve(self._frame, rest, now, self._initial)))
        return self._solved[-1][2]


@dataclass(frozen=True, eq=False)
class _Evidence:
    """What two flows, without masks and with, leave unexplained of a frame, (H, W) each."""

    residual: Map
    """Of the flow without masks [local deviations]."""
    gain: Map
    """By how much masking lowers it."""
    inside: Flags
    """What is tissue and in the picture."""
    common: Flags
    """What of that is proposed by nothing."""

    def earning(self, where: NDArray[np.int32], numbers: int, one: bool, beside: bool) -> NDArray[np.bool_]:
        """(numbers,) which pieces earn being masked.

        Args:
            where: (H, W), the pieces' numbers.
            numbers: how many there are.
            one: they are right by and large: less gain is enough, and where none can be seen none is asked.
            beside: judged against what lies around a piece, not against all tissue.
        """
        kept = np.zeros(numbers, bool)
        usual = self.residual[self.common] if self.common.any() else np.median(self.residual)
        for number in np.flatnonzero(np.bincount(where.ravel()) >= _SMALLEST):
            piece = (where == number) & self.inside
            if not number or np.count_nonzero(piece) < _SMALLEST:
                continue
            ring = _ring(piece) & self.common
            enough = np.count_nonzero(ring) >= _SMALLEST
            around = float(np.mean(self.residual[ring] if beside and enough else usual))
            kept[number] = float(self.residual[piece].mean()) > max(
                around + _UNEXPLAINED, _TIMES * around
            ) or (float(self.gain[ring].mean()) > (_GAIN_EACH if one else _GAIN) if enough else one)
        return kept

    def together(self, where: Flags, change: Flow) -> bool:
        """Whether masking all of it, (H, W), explains more around it; change: of the flow, (H, W, 2) px."""
        ring = _ring(where) & self.common
        if np.count_nonzero(ring) < _SMALLEST:
            return False
        differs = float(np.linalg.norm(change[ring], axis=-1).mean())
        return float(self.gain[ring].mean()) > _GAIN_OF_ALL and differs > _DIFFERENT_PX


def _ring(piece: Flags, away_px: int = _RING_PX) -> Flags:
    wide = 2 * away_px + 1
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
