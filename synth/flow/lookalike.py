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

    likely: float = 0.5  # probability of an instrument above which a region is examined
    small: float = 0.0005  # share of the picture below which it isn't
    around: float = 0.05  # of the picture's width: how far an object that appears disturbs the flow
    least_px: float = 0.6  # motion and difference of motions below which a pixel tells nothing
    told: float = 3.0  # change along a difference of motions from which a pixel tells [noise]
    told_least: float = 0.15  # the same [local deviations]
    enough: float = 0.002  # share of the picture that has to tell
    better: float = 0.55  # mean change by the flow over that by another motion, below which the flow is right
    unlike: float = 0.05  # share of pixels that the flow may leave unexplained: veins 0.01, instruments 0.1
    apart: float = 0.25  # median difference of the flow from that around, over the latter: 0.15 and 0.6
    plain: float = 0.02  # `unlike` of a part that moves as all around it
    near: float = 0.1  # its `apart`
    farthest: float = 2.0  # limit of a change [local deviations]: pixels that are hidden count no more
    bins: int = 16  # of each channel of colours
    alike: float = 0.15  # share of the mean density of proven colours from which a colour is proven too
    shared: float = 0.7  # share of a region in proven colours from which it is tissue, if it tells nothing
    changed: float = 10.0  # grey levels from which a pixel of a frame differs from the aligned rest frame
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
        self._likely, self._shines = at_rest.instrument > Limits.likely, at_rest.shines
        count, label = cv2.connectedComponents((self._likely & tissue).astype(np.uint8))
        sizes = np.bincount(label.ravel(), minlength=count)
        self.regions = [label == k for k in range(1, count) if sizes[k] > Limits.small * label.size]
        """(H, W) each, that look like instruments; without any there is nothing to search."""
        self._votes = Votes(*np.zeros((2, len(self.regions))))
        self._moved = np.zeros(tissue.shape, bool)

    def add(self, frame: Pixels) -> None:
        """Adds what a later frame (H, W, 3) says."""
        judged = _Judge(self._rest, frame, self._likely, self._shines)
        self._moved |= judged.moved
        for k, region in enumerate(self.regions):
            told, is_tissue = judged.of(region)
            (self._votes.good if is_tissue else self._votes.bad)[k] += told

    def find(self) -> Mask:
        """Tissue (H, W) of the rest frame that looks like instruments.

        A region that doesn't move is told by its colours, if another one with them is tissue. Of a region
        only these colours are taken: an instrument may lie on it.
        """
        votes, chosen = self._votes, np.zeros(self._likely.shape, bool)
        is_tissue = votes.good > votes.bad
        for k in np.flatnonzero(is_tissue):
            chosen |= self.regions[k]
        proven = self._moved & chosen
        if not proven.any():
            return proven
        alike = _of_colours(self._rest, proven)
        for k in np.flatnonzero(~is_tissue & (votes.bad == 0)):
            if alike[self.regions[k]].mean() > Limits.shared:
                chosen |= self.regions[k]
        return np.asarray(chosen & alike)


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

    def remove(self, found: Segmentation, frame: Pixels) -> Segmentation:
        """The classes of a frame (H, W, 3) without instruments where it shows that tissue as at rest."""
        if not (found.instrument > Limits.likely).any():
            return found
        back = cv2.blur(
            np.dstack([cv2.medianBlur(plane, 5) for plane in cv2.split(_flow(frame, self._rest))]), (9, 9)
        )
        columns, rows = image.ends(back)
        there = cv2.remap(self._tissue, columns, rows, cv2.INTER_NEAREST) > 0
        before = cv2.remap(self._rest, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        now, before = (cv2.blur(picture, (3, 3)).astype(np.float32) for picture in (frame, before))
        unlike = (np.abs(now - before).mean(axis=-1) > Limits.changed).astype(np.uint8)
        disc = _disc(Limits.rim_px)
        unlike = cv2.dilate(cv2.morphologyEx(unlike, cv2.MORPH_OPEN, disc), disc)
        kept = np.where(there & (unlike == 0), 0, found.instrument)
        return replace(found, instrument=np.asarray(kept, np.float32))


class _Judge:
    """One frame, compared with the rest frame (H, W, 3)."""

    def __init__(self, rest: Pixels, frame: Pixels, likely: Mask, shines: Mask) -> None:
        found, size = segment(rest, frame), likely.shape
        # What appeared since rest hides tissue, and the flow next to it isn't the tissue's.
        appeared = ((found.instrument > Limits.likely) & ~likely).astype(np.uint8)
        appeared = cv2.morphologyEx(appeared, cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
        self._free = cv2.dilate(appeared, _square(round(Limits.around * size[1]))) == 0
        self._flow = _flow(rest, frame)
        everywhere = np.ones(size, np.float32)
        self._before, self._after = (
            cv2.GaussianBlur(image.normalise(image.luminance(picture), everywhere), (0, 0), 0.8)
            for picture in (rest, frame)
        )
        slopes = [cv2.Sobel(self._before, cv2.CV_32F, *way, ksize=3, scale=1 / 8) for way in ((1, 0), (0, 1))]
        self._slope = np.stack(slopes, axis=-1)
        outside = image.flags(~_wider(likely) & self._free & ~(found.shines | shines))
        around = np.dstack(
            [image.fill(np.ascontiguousarray(plane), outside) for plane in cv2.split(self._flow)]
        )
        self._size = np.linalg.norm(around, axis=-1)
        self._apart = np.linalg.norm(self._flow - around, axis=-1)
        still = np.zeros_like(self._flow)
        self._by_flow, self._by_none = self._change(self._flow), self._change(still)
        self._noise = 1.4826 * float(np.median(self._by_flow))
        self._told = self._tells(still)
        near = self._apart < Limits.apart * self._size
        self.moved = self._told & near & (self._by_flow < Limits.better * self._by_none)
        """(H, W) what moves as tissue."""
        self._border = np.ones(size, bool)
        self._border[3:-3, 3:-3] = False

    def of(self, region: Mask) -> tuple[float, bool]:
        """Share of the picture that tells how a region (H, W) moves, 0 if too little, and whether it moves as
        tissue."""
        wide, seen = _wider(region), region & self._free
        told = wide & self._told
        moving, share = seen & (self._size > Limits.least_px), float(told.mean())
        if share < Limits.enough:
            return 0.0, False
        if not moving.any():
            return share, False
        apart = float(np.median(self._apart[moving] / self._size[moving]))
        unlike = float(np.mean(self._by_flow[seen] >= max(4 * self._noise, 0.6)))
        is_better = _ratio(self._by_flow, self._by_none, told) < Limits.better
        if not is_better or unlike >= Limits.unlike or apart >= Limits.apart:
            return share, False
        # A part that moves as all around it is tissue, unless a shaft may lead from it out of the picture.
        if apart < Limits.near and unlike < Limits.plain and not (region & self._border).any():
            return share, True
        rigid = _rigid(self._before, self._after, wide, self._flow)
        told = wide & self._tells(rigid)
        by_rigid = self._change(rigid)
        is_told = told.mean() > Limits.enough
        return share * is_told, _ratio(self._by_flow, by_rigid, told) < Limits.better

    def _change(self, motion: Map) -> Map:
        """Change (H, W), limited, that a motion (H, W, 2) px leaves [local deviations]."""
        ends = image.ends(motion)
        warped = cv2.remap(self._after, *ends, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.minimum(np.abs(warped - self._before), Limits.farthest))

    def _tells(self, motion: Map) -> Mask:
        """Where (H, W) the picture tells the flow from another motion (H, W, 2) px."""
        off = self._flow - motion
        change = np.abs((self._slope * off).sum(axis=-1))
        is_seen = change > max(Limits.told * self._noise, Limits.told_least)
        return np.asarray(is_seen & (np.linalg.norm(off, axis=-1) > Limits.least_px) & self._free)


def _flow(rest: Pixels, frame: Pixels) -> Map:
    """Flow (H, W, 2) px between two pictures without masks, coarse but fast."""
    everywhere = np.ones(rest.shape[:2], bool)
    return Dis().flow(rest, frame, everywhere, everywhere)[0]


def _rigid(before: Map, after: Map, region: Mask, flow: Map) -> Map:
    """The Euclidean motion (H, W, 2) px of a region (H, W) that fits best, from several starts."""
    inner, size = flow[region], np.linalg.norm(flow[region], axis=-1)
    starts = [np.zeros(2), np.median(inner, axis=0), inner[size >= np.quantile(size, 0.95)].mean(axis=0)]
    best, most = np.eye(2, 3, dtype=np.float32), -2.0
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-4)
    for start in starts:
        turn = np.column_stack([np.eye(2), start]).astype(np.float32)
        mask = region.astype(np.uint8)
        try:
            score, turn = cv2.findTransformECC(before, after, turn, cv2.MOTION_EUCLIDEAN, criteria, mask, 5)
        except cv2.error:  # it doesn't converge from this start
            continue
        if score > most:
            best, most = turn, score
    places = np.stack(np.meshgrid(*map(np.arange, before.shape[::-1])), axis=-1).astype(np.float32)
    return np.asarray(places @ best[:, :2].T + best[:, 2] - places, np.float32)


def _of_colours(rgb: Pixels, proven: Mask) -> Mask:
    """Where a picture (H, W, 3) has the colours of proven tissue (H, W), without specks and holes."""
    lab = cv2.cvtColor(cv2.blur(rgb, (3, 3)), cv2.COLOR_RGB2Lab)
    bins, every = [Limits.bins] * 3, [0, 256] * 3
    counts = cv2.calcHist([lab], [0, 1, 2], proven.astype(np.uint8), bins, every)
    density = gaussian_filter(counts, 0.7)[tuple((lab // (256 // Limits.bins)).transpose(2, 0, 1))]
    alike = (density > Limits.alike * density[proven].mean()).astype(np.uint8)
    closed = cv2.morphologyEx(alike, cv2.MORPH_CLOSE, _disc(3))
    return np.asarray(cv2.morphologyEx(closed, cv2.MORPH_OPEN, _disc(3)) > 0)


def _ratio(these: Map, those: Map, where: Mask) -> float:
    return float(these[where].sum() / max(float(those[where].sum()), 1e-6))


def _wider(mask: Mask) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), _square(2)) > 0)


def _disc(radius: int) -> Pixels:
    shape = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(shape, np.uint8)


def _square(around_px: int) -> Pixels:
    return np.ones((2 * around_px + 1, 2 * around_px + 1), np.uint8)
