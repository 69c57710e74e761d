"""Tissue that looks like an instrument, such as a thick blue vein, told from one by its motion.

The segmentation judges by looks. What it takes for an instrument in the rest frame is tissue if it moves as
tissue does: with what is around it, and neither still nor as a rigid body. Three motions are compared in each
such region by the change that they leave between the contrast-normalised rest frame and a later frame: the
flow, none, and the Euclidean motion that fits the region best (G. Evangelidis and E. Psarakis, PAMI 2008).
Pixels tell two motions apart only where the picture's slope along their difference exceeds the noise: a rod
that is drawn along its own axis has no such pixels and stays masked, as does what doesn't move at all.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter

from synth.arrays import Array, Map, Mask, Pixels
from synth.flow import image
from synth.flow.opencv import Dis
from synth.flow.segmentation import Segmentation, segment


class Limits:
    """Chosen by hand on six videos by Cycles with thick veins, and on renders with instruments at rest."""

    min_probability: float = 0.5  # probability of an instrument above which a region is examined
    min_area: float = 0.0005  # share of the picture below which it isn't
    margin: float = 0.05  # of the picture's width: how far an object that appears disturbs the flow
    min_motion_px: float = 0.6  # motion and difference of motions below which a pixel tells nothing
    min_snr: float = 3.0  # change along a difference of motions from which a pixel tells [noise]
    min_contrast: float = 0.15  # the same [local deviations]
    min_evidence: float = 0.002  # share of the picture that has to tell
    max_ratio: float = 0.55  # mean change by the flow over that by another motion, if the flow is right
    max_unexplained: float = 0.05  # share that the flow leaves unexplained: veins 0.01, instruments 0.1
    max_difference: float = 0.25  # median difference of the flow from that around, over it: 0.15 and 0.6
    low_unexplained: float = 0.02  # `max_unexplained` of a part that moves as all around it
    low_difference: float = 0.1  # its `max_difference`
    max_change: float = 2.0  # limit of a change [local deviations]: pixels that are hidden count no more
    bins: int = 16  # of each channel of colours
    min_density: float = 0.15  # share of the mean density of proven colours from which a colour is proven too
    min_colour_share: float = 0.7  # of a region in proven colours: above it is tissue, if it tells nothing
    min_grey_change: float = 10.0  # grey levels from which a pixel differs from the aligned rest frame
    rim_px: int = 2  # half the width of differences that are rims of vessels


@dataclass(frozen=True)
class Votes:
    """What frames say of each region, (n,) shares of the picture that tell it, summed over frames."""

    good: Array
    """Of frames in which it moves as tissue."""
    bad: Array
    """Of frames in which it doesn't."""


class LookalikeSearch:
    """Searches the rest frame for tissue that the segmentation takes for instruments."""

    def __init__(self, rest: Pixels, tissue: Mask) -> None:
        """Starts with the rest frame (H, W, 3) uint8 and where tissue may be (H, W)."""
        self._rest, at_rest = rest, segment(rest, rest)
        self._suspicious, self._glare = at_rest.instrument > Limits.min_probability, at_rest.glare
        count, label = cv2.connectedComponents((self._suspicious & tissue).astype(np.uint8))
        sizes = np.bincount(label.ravel(), minlength=count)
        self.regions = [label == k for k in range(1, count) if sizes[k] > Limits.min_area * label.size]
        """(H, W) each, that look like instruments; without any there is nothing to search."""
        self._votes = Votes(*np.zeros((2, len(self.regions))))
        self._moving = np.zeros(tissue.shape, bool)

    def add(self, frame: Pixels) -> None:
        """Adds what a later frame (H, W, 3) says."""
        judge = _Judge(self._rest, frame, self._suspicious, self._glare)
        self._moving |= judge.moving
        for k, region in enumerate(self.regions):
            share, is_tissue = judge.judge_region(region)
            (self._votes.good if is_tissue else self._votes.bad)[k] += share

    def find(self) -> Mask:
        """Tissue (H, W) of the rest frame that looks like instruments.

        A region that doesn't move is told by its colours, if another one with them is tissue. Of a region
        only these colours are taken: an instrument may lie on it.
        """
        votes, tissue = self._votes, np.zeros(self._suspicious.shape, bool)
        is_tissue = votes.good > votes.bad
        for k in np.flatnonzero(is_tissue):
            tissue |= self.regions[k]
        proven = self._moving & tissue
        if not proven.any():
            return proven
        similar = _match_colours(self._rest, proven)
        for k in np.flatnonzero(~is_tissue & (votes.bad == 0)):
            if similar[self.regions[k]].mean() > Limits.min_colour_share:
                tissue |= self.regions[k]
        return np.asarray(tissue & similar)


def find_lookalikes(rest: Pixels, frames: Iterable[Pixels], tissue: Mask) -> Mask:
    """Tissue (H, W) that the segmentation takes for instruments in the rest frame (H, W, 3) uint8, by some
    later `frames` of its size with large motion; `tissue`: (H, W), where it may be."""
    search = LookalikeSearch(rest, tissue)
    for frame in frames if search.regions else ():
        search.add(frame)
    return search.find()


class Lookalikes:
    """Tissue that looks like instruments, in the frames of a video."""

    def __init__(self, rest: Pixels, tissue: Mask) -> None:
        """`rest`: (H, W, 3) uint8; `tissue`: (H, W), see `find_lookalikes`."""
        self._rest, self._tissue = rest, cv2.dilate(tissue.astype(np.uint8), _disc(3))

    def remove(self, segmentation: Segmentation, frame: Pixels) -> Segmentation:
        """The classes of a frame (H, W, 3) without instruments where it shows that tissue as at rest."""
        if not (segmentation.instrument > Limits.min_probability).any():
            return segmentation
        backward_flow = cv2.blur(
            np.dstack([cv2.medianBlur(plane, 5) for plane in cv2.split(_flow(frame, self._rest))]), (9, 9)
        )
        columns, rows = image.end_points(backward_flow)
        at_tissue = cv2.remap(self._tissue, columns, rows, cv2.INTER_NEAREST) > 0
        before = cv2.remap(self._rest, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        now, before = (cv2.blur(picture, (3, 3)).astype(np.float32) for picture in (frame, before))
        changed = (np.abs(now - before).mean(axis=-1) > Limits.min_grey_change).astype(np.uint8)
        disc = _disc(Limits.rim_px)
        changed = cv2.dilate(cv2.morphologyEx(changed, cv2.MORPH_OPEN, disc), disc)
        instrument = np.where(at_tissue & (changed == 0), 0, segmentation.instrument)
        return replace(segmentation, instrument=np.asarray(instrument, np.float32))


class _Judge:
    """One frame, compared with the rest frame (H, W, 3)."""

    def __init__(self, rest: Pixels, frame: Pixels, suspicious: Mask, glare: Mask) -> None:
        segmentation, size = segment(rest, frame), suspicious.shape
        # What appeared since rest hides tissue, and the flow next to it isn't the tissue's.
        appeared = ((segmentation.instrument > Limits.min_probability) & ~suspicious).astype(np.uint8)
        appeared = cv2.morphologyEx(appeared, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        self._free = cv2.dilate(appeared, _square(round(Limits.margin * size[1]))) == 0
        self._flow = _flow(rest, frame)
        full_mask = np.ones(size, np.float32)
        self._before, self._after = (
            cv2.GaussianBlur(image.normalise(image.luminance(picture), full_mask), (0, 0), 0.8)
            for picture in (rest, frame)
        )
        slopes = [
            cv2.Sobel(self._before, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1))
        ]
        self._slope = np.stack(slopes, axis=-1)
        outside = image.flags(~_widen(suspicious) & self._free & ~(segmentation.glare | glare))
        surrounding_flow = np.dstack(
            [image.fill(np.ascontiguousarray(plane), outside) for plane in cv2.split(self._flow)]
        )
        self._magnitude = np.linalg.norm(surrounding_flow, axis=-1)
        self._difference = np.linalg.norm(self._flow - surrounding_flow, axis=-1)
        no_motion = np.zeros_like(self._flow)
        self._flow_change = self._measure_change(self._flow)
        self._still_change = self._measure_change(no_motion)
        self._noise = 1.4826 * float(np.median(self._flow_change))
        self._evidence = self._find_evidence(no_motion)
        coherent = self._difference < Limits.max_difference * self._magnitude
        self.moving = self._evidence & coherent & (self._flow_change < Limits.max_ratio * self._still_change)
        """(H, W) what moves as tissue."""
        self._border = np.ones(size, bool)
        self._border[3:-3, 3:-3] = False

    def judge_region(self, region: Mask) -> tuple[float, bool]:
        """Share of the picture that tells how a region (H, W) moves, 0 if too little, and whether it moves as
        tissue."""
        widened, visible = _widen(region), region & self._free
        evidence = widened & self._evidence
        moving, share = visible & (self._magnitude > Limits.min_motion_px), float(evidence.mean())
        if share < Limits.min_evidence:
            return 0.0, False
        if not moving.any():
            return share, False
        difference = float(np.median(self._difference[moving] / self._magnitude[moving]))
        unexplained = float(np.mean(self._flow_change[visible] >= max(4 * self._noise, 0.6)))
        is_better = _compare_changes(self._flow_change, self._still_change, evidence) < Limits.max_ratio
        if not is_better or unexplained >= Limits.max_unexplained or difference >= Limits.max_difference:
            return share, False
        # A part that moves as all around it is tissue, unless a shaft may lead from it out of the picture.
        if (
            difference < Limits.low_difference
            and unexplained < Limits.low_unexplained
            and not (region & self._border).any()
        ):
            return share, True
        rigid = _fit_rigid(self._before, self._after, widened, self._flow)
        evidence = widened & self._find_evidence(rigid)
        rigid_change = self._measure_change(rigid)
        is_evident = evidence.mean() > Limits.min_evidence
        is_better = _compare_changes(self._flow_change, rigid_change, evidence) < Limits.max_ratio
        return share * is_evident, is_better

    def _measure_change(self, motion: Map) -> Map:
        """Change (H, W), limited, that a motion (H, W, 2) px leaves [local deviations]."""
        positions = image.end_points(motion)
        warped = cv2.remap(self._after, *positions, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.minimum(np.abs(warped - self._before), Limits.max_change))

    def _find_evidence(self, motion: Map) -> Mask:
        """Where (H, W) the picture tells the flow from another motion (H, W, 2) px."""
        difference = self._flow - motion
        change = np.abs((self._slope * difference).sum(axis=-1))
        is_visible = change > max(Limits.min_snr * self._noise, Limits.min_contrast)
        return np.asarray(
            is_visible & (np.linalg.norm(difference, axis=-1) > Limits.min_motion_px) & self._free
        )


def _flow(rest: Pixels, frame: Pixels) -> Map:
    """Flow (H, W, 2) px between two pictures without masks, coarse but fast."""
    full_mask = np.ones(rest.shape[:2], bool)
    return Dis().flow(rest, frame, full_mask, full_mask)[0]


def _fit_rigid(before: Map, after: Map, region: Mask, flow: Map) -> Map:
    """The Euclidean motion (H, W, 2) px of a region (H, W) that fits best, from several starts."""
    region_flow, magnitude = flow[region], np.linalg.norm(flow[region], axis=-1)
    starts = [
        np.zeros(2),
        np.median(region_flow, axis=0),
        region_flow[magnitude >= np.quantile(magnitude, 0.95)].mean(axis=0),
    ]
    best, best_score = np.eye(2, 3, dtype=np.float32), -2.0
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-4)
    for start in starts:
        matrix = np.column_stack([np.eye(2), start]).astype(np.float32)
        mask = region.astype(np.uint8)
        try:
            score, matrix = cv2.findTransformECC(
                before, after, matrix, cv2.MOTION_EUCLIDEAN, criteria, mask, 5
            )
        except cv2.error:  # it doesn't converge from this start
            continue
        if score > best_score:
            best, best_score = matrix, score
    pixels = np.stack(np.meshgrid(*map(np.arange, before.shape[::-1])), axis=-1).astype(np.float32)
    return np.asarray(pixels @ best[:, :2].T + best[:, 2] - pixels, np.float32)


def _match_colours(rgb: Pixels, proven: Mask) -> Mask:
    """Where a picture (H, W, 3) has the colours of proven tissue (H, W), without specks and holes."""
    lab = cv2.cvtColor(cv2.blur(rgb, (3, 3)), cv2.COLOR_RGB2Lab)
    bins, ranges = [Limits.bins] * 3, [0, 256] * 3
    counts = cv2.calcHist([lab], [0, 1, 2], proven.astype(np.uint8), bins, ranges)
    density = gaussian_filter(counts, 0.7)[tuple((lab // (256 // Limits.bins)).transpose(2, 0, 1))]
    similar = (density > Limits.min_density * density[proven].mean()).astype(np.uint8)
    closed = cv2.morphologyEx(similar, cv2.MORPH_CLOSE, _disc(3))
    return np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disc(3)) > 0)


def _compare_changes(changes: Map, other_changes: Map, mask: Mask) -> float:
    return float(changes[mask].sum() / max(float(other_changes[mask].sum()), 1e-6))


def _widen(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _square(2)) > 0)


def _disc(radius: int) -> Pixels:
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(shape, np.uint8)


def _square(around_px: int) -> Pixels:
    return np.ones((2 * around_px + 1, 2 * around_px + 1), np.uint8)
