"""Tissue of a video that states none: found in the rest frame by the motion of a few frames and by colour.

What is still while the rest moves is no tissue. Bonded tissue moves ever less towards its rim, so that motion
marks only a part of it, from which GrabCut (Rother et al., SIGGRAPH 2004) grows to an edge of colour. Tissue
that fills the picture is still too, far from a gentle contact: a rim is assumed only where elastic tissue
without one would visibly move, and if what is still has other colours. Where nothing moves, or all of the
picture alike, as with a camera in motion, colour alone decides.
"""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow.confidence import deviation
from synth.flow.recording.decode import Footage
from synth.flow.recording.finding import Finding, Severity
from synth.flow.recording.frame_motion import FrameMotion, RestFrame


class Limits:
    """Constants of the search, chosen by hand on renders and on photographs that were warped in a part."""

    frames: int = 16  # tracked: in each part of the video the one that differs most from the rest frame
    step_px: int = 8  # px between those compared for it
    min_sigmas: float = 2.0  # root mean square of the motion over its standard deviation; still pixels 0.7
    min_relative_motion: float = 0.2  # likewise over the median of what moves: flow carries some across a rim
    min_still_share: float = 0.2  # of the picture, still though it should move: openings 0.38, others 0.05
    max_overlap: float = 0.4  # largest overlap of the colours of what is still and what moves: openings 0.31
    bins: int = 16  # of each channel of the colours, for their overlap
    min_smooth_rows: int = 180  # rows below which colours are smoothed less
    margin: float = 0.03  # of the picture's height: what flow smooths over, at rims and around instruments
    half_width: float = 0.06  # likewise: half the width of the narrowest tissue; shafts are narrower
    min_confidence: float = 0.7  # confidence above which a pixel is tracked
    min_visible: float = 0.7  # share of frames in which a pixel has to be tracked
    min_seen: float = 0.3  # likewise to tell that a part which has the tissue's colours moves as well
    iterations: int = 5  # of GrabCut
    min_part: float = 0.2  # share of what moves in the main part, from which another part is tissue too
    min_area: float = 0.05  # share of the picture below which what is found is not the tissue
    clear_solidity: float = 0.93  # of its convex hull, below which it is doubtful: right ones 0.95 and more
    max_contradiction: float = 0.04  # of it that is still though it should move: right ones 0.01, others 0.06
    max_solidity_loss: float = 0.02  # by which the outline without it may be less solid
    min_solidity: float = 0.75  # likewise, below which it is not the tissue
    max_uniformity: float = 0.5  # median over the largest motion; around a contact 0.3, in moved pictures 0.7
    centre: float = 0.35  # radius of an ellipse over the picture's, which colour alone takes for tissue
    frame: float = 0.06  # width of the border over the picture's height, which it takes for surroundings
    alone_overlap: float = 0.27  # largest overlap of colours inside and outside: openings 0.1 to 0.29
    alone_solidity: float = 0.92  # least solidity: openings 0.925 and more, without a rim 0.79 to 0.94


def choose_frames(footage: Footage) -> frozenset[int]:
    """Numbers of the rest frame and of some later ones, as `Limits.frames` says."""
    rest_sample: Map | None = None
    numbers, changes = list[int](), list[float]()
    for picture in footage.pictures():
        is_wanted = footage.only is None or picture.index in footage.only
        if picture.index < footage.rest_frame or not is_wanted or (numbers and picture.time_s is None):
            continue
        sample = picture.rgb[:: Limits.step_px, :: Limits.step_px].astype(np.float32)
        rest_sample = sample if rest_sample is None else rest_sample
        numbers.append(picture.index)
        changes.append(
            float(np.abs(sample - rest_sample).mean()) if sample.shape == rest_sample.shape else 0.0
        )
    if not numbers:  # `Decoder` reports it
        return frozenset()
    parts = np.array_split(np.arange(1, len(numbers)), Limits.frames)
    chosen = [0, *(max(part, key=changes.__getitem__) for part in parts if len(part))]
    return frozenset(numbers[k] for k in chosen)


class TissueSearch:
    """Gathers the motion of frames, the rest frame first, from which the tissue is then found."""

    def __init__(self, rest: RestFrame) -> None:
        self._rest, self._frames = rest, 0
        sums = np.zeros((4, *rest.tissue.shape), np.float32)
        self._square, self._variance, self._count, self._hidden = sums

    def add(self, frame: FrameMotion) -> None:
        """Adds a frame."""
        if frame.is_rest:
            self._hidden_at_rest = frame.hidden
        elif frame.trusted:
            known = frame.confidence > Limits.min_confidence
            self._square += known * np.square(frame.flow).sum(axis=-1)
            self._variance += known * 2 * deviation(frame.confidence) ** 2
            self._count += known
            self._hidden += frame.hidden
            self._frames += 1

    def find(self) -> tuple[Mask, Finding]:
        """Tissue (h, w) of the rest frame: the whole picture if motion shows no rim."""
        picture = self._rest.tissue
        margin, half_width = (
            max(1, round(share * len(picture))) for share in (Limits.margin, Limits.half_width)
        )
        hidden = self._hidden_at_rest | (self._hidden > (1 - Limits.min_visible) * self._frames)
        visible = picture & (self._count > Limits.min_visible * self._frames)
        visible &= ~_morph(hidden, cv2.MORPH_DILATE, margin)
        motion, noise = (
            np.sqrt(total / np.maximum(self._count, 1)) for total in (self._square, self._variance)
        )
        significant = motion > Limits.min_sigmas * noise
        moving = visible & significant
        if moving.any():
            significant &= motion > Limits.min_relative_motion * np.median(motion[moving])
        moving = _morph(_morph(visible & significant, cv2.MORPH_CLOSE, 2), cv2.MORPH_OPEN, half_width)
        core = _morph(moving, cv2.MORPH_ERODE, margin)
        colours = _colours(self._rest.rgb)
        if not core.any():
            return self._find_by_colour(colours, "nothing moves by which to find it")
        expected = _predict_motion(motion, moving) > Limits.min_sigmas * noise
        still = visible & (motion < noise)
        is_bounded = np.mean(expected & still) > Limits.min_still_share * np.mean(visible)
        is_alike = np.minimum(*_histograms(colours, core, still)).sum() > Limits.max_overlap
        if not is_bounded or is_alike:
            if np.mean(visible & ~expected) < 0.5 * np.mean(visible):
                largest, median = np.percentile(motion[visible], (98, 50))
                if median > Limits.max_uniformity * largest:
                    return self._find_by_colour(colours, "all of the picture moves alike")
                return picture, _state("it moves as tissue that fills the picture")
            if is_alike:
                text = "neither motion nor colour shows a rim: the whole picture is assumed"
                return picture, _state(text, "warning")
        # An instrument that is moved to and fro cuts tissue in parts, of which some are often hidden.
        seen = picture & ~hidden & (self._count > Limits.min_seen * self._frames)
        seeds = core | _morph(seen & significant, cv2.MORPH_OPEN, half_width)
        # Still, though tissue there would move.
        contradiction = _morph(expected & still & ~moving, cv2.MORPH_OPEN, 2)
        tissue, solidity = self._grow_from_motion(colours, moving, core, seeds, hidden, still, contradiction)
        if not is_bounded and solidity < Limits.clear_solidity:
            hull = picture & _hull(moving)
            if hull.mean() < Limits.min_area:
                return hull, _refuse(f"what moves is {100 * hull.mean():.2g}% of the picture")
            return hull, _state("too little moves to find its rim: what moves is taken for it", "warning")
        return tissue, _judge_outline(tissue, solidity)

    def _grow_from_motion(
        self,
        colours: Pixels,
        moving: Mask,
        core: Mask,
        seeds: Mask,
        hidden: Mask,
        still: Mask,
        contradiction: Mask,
    ) -> tuple[Mask, float]:
        """Tissue around what is `moving`, without the `contradiction` if it reaches too far into that; and
        the solidity of its outline."""
        guess = np.where(core, cv2.GC_FGD, np.where(moving, cv2.GC_PR_FGD, cv2.GC_PR_BGD)).astype(np.uint8)
        outside = still & ~_remove_border(self._rest.tissue, 2 * Limits.half_width)
        tissue, solidity = self._choose(colours, guess, core, seeds, hidden, outside)
        if tissue[contradiction].sum() > Limits.max_contradiction * tissue.sum():
            guess[contradiction & ~core] = cv2.GC_BGD
            alternative = self._choose(colours, guess, core, seeds, hidden, outside)
            if alternative[1] > solidity - Limits.max_solidity_loss:
                return alternative
        return tissue, solidity

    def _find_by_colour(self, colours: Pixels, text: str) -> tuple[Mask, Finding]:
        """Tissue by colour alone, from the middle of the picture to its border; the whole picture if colour
        shows no rim either. `text` says why motion can't tell."""
        height, width = self._rest.tissue.shape
        y, x = np.mgrid[:height, :width]
        centre = np.hypot(2 * x / width - 1, 2 * y / height - 1) < Limits.centre
        inner = _remove_border(self._rest.tissue, Limits.frame)
        core, hidden = centre & self._rest.tissue & ~self._hidden_at_rest, np.zeros_like(centre)
        if core.any():
            guess = np.where(core, cv2.GC_FGD, cv2.GC_PR_BGD).astype(np.uint8)
            guess = _relabel_by_colour(guess, colours, core, ~inner)
            tissue, solidity = self._grow_region(colours, guess, core, core, hidden)
            overlap = np.minimum(*_histograms(colours, tissue, ~tissue)).sum()
            is_large = tissue.mean() > Limits.min_area
            if is_large and overlap < Limits.alone_overlap and solidity > Limits.alone_solidity:
                share = f"{100 * tissue.mean():.2g}% of the picture"
                return tissue, _state(f"{text}: found by colour alone, {share}: is it right?", "warning")
        return self._rest.tissue, _state(f"{text}: the whole picture is assumed")

    def _choose(
        self, colours: Pixels, guess: Pixels, core: Mask, seeds: Mask, hidden: Mask, outside: Mask
    ) -> tuple[Mask, float]:
        """Of two regions, from a guess and from one by colour, the rounder one: from either, tissue may be
        lost that instruments cut off."""
        guesses = guess, _relabel_by_colour(guess, colours, core, outside)
        return max(
            (self._grow_region(colours, candidate, core, seeds, hidden) for candidate in guesses),
            key=lambda region: region[1],
        )

    def _grow_region(
        self, colours: Pixels, guess: Pixels, core: Mask, seeds: Mask, hidden: Mask
    ) -> tuple[Mask, float]:
        """The convex hull of what GrabCut finds from a guess, and the share of the hull that it found."""
        margin, half_width = (
            max(1, round(share * len(core))) for share in (Limits.margin, Limits.half_width)
        )
        tissue = _morph(_grow(colours, guess), cv2.MORPH_OPEN, margin) | core
        tissue = _keep_moving(_add_hidden(tissue, seeds, hidden), core, seeds)
        tissue = _fill_holes(_morph(_fill_holes(tissue), cv2.MORPH_CLOSE, half_width))
        hull = _hull(tissue)
        return self._rest.tissue & hull, float(tissue.sum() / hull.sum())


def measure_border_share(tissue: Mask) -> float:
    """Share of the outline of a mask (H, W) on the border of the picture, which is no edge of the tissue."""
    inner = cv2.erode(tissue.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    outline = tissue & ~inner
    border = np.ones(tissue.shape, bool)
    border[1:-1, 1:-1] = False
    return float((outline & border).sum() / max(outline.sum(), 1))


def _judge_outline(tissue: Mask, solidity: float) -> Finding:
    """What is to be said of tissue (h, w) found by motion and colour."""
    if tissue.mean() < Limits.min_area:
        return _refuse(f"what is found is {100 * tissue.mean():.2g}% of the picture")
    if solidity < Limits.min_solidity:
        return _refuse("what is found has an outline as tissue has none")
    text = f"found by motion and colour, {100 * tissue.mean():.2g}% of the picture"
    if solidity < Limits.clear_solidity:
        return _state(f"{text}, but with an uneven outline: see the picture of the masks", "warning")
    return _state(text)


def _refuse(text: str) -> Finding:
    return Finding("error", "tissue", f"draw tissue.png (bench init --tissue proposes it): {text}")


def _state(text: str, severity: Severity = "missing") -> Finding:
    return Finding(severity, "tissue", f"no mask of the tissue (tissue.png) is given: {text}")


def _predict_motion(motion: Map, moving: Mask) -> Map:
    """Motion (h, w) px of tissue without a rim: around what moves most it falls with distance, as 1 / r."""
    half_motion = float(np.percentile(motion[moving], 98)) / 2
    strongest = moving & (motion > half_motion)
    radius = np.sqrt(np.count_nonzero(strongest) / np.pi)
    distance = cv2.distanceTransform((~strongest).astype(np.uint8), cv2.DIST_L2, 5)
    return np.asarray(half_motion * radius / (radius + distance), np.float32)


def _colours(rgb: Pixels) -> Pixels:
    """Lab (h, w, 3), smoothed, with less of lightness, which shading changes, and more of colour."""
    side = 5 if len(rgb) >= Limits.min_smooth_rows else 3  # px: 5 in small pictures would remove veins, rim
    lab = cv2.medianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2Lab), side).astype(np.float32)
    return np.asarray(np.clip((lab - 128) * np.array([0.5, 2, 2]) + 128, 0, 255), np.uint8)


def _histograms(colours: Pixels, *masks: Mask) -> list[Map]:
    """Histograms of the colours (h, w, 3) in masks, each of sum 1."""
    bins, ranges = [Limits.bins] * 3, [0, 256] * 3
    histograms = [cv2.calcHist([colours], [0, 1, 2], mask.astype(np.uint8), bins, ranges) for mask in masks]
    return [np.asarray(counts / max(counts.sum(), 1), np.float32) for counts in histograms]


def _relabel_by_colour(guess: Pixels, colours: Pixels, core: Mask, outside: Mask) -> Pixels:
    """A guess that adds what has the colours (h, w, 3) of the core rather than of what is outside."""
    core_share, outside_share = (
        cv2.GaussianBlur(histogram.reshape(Limits.bins, -1), (0, 0), 0.5).reshape(histogram.shape) + 1e-5
        for histogram in _histograms(colours, core, outside)
    )
    indices = tuple((colours // (256 // Limits.bins)).transpose(2, 0, 1))
    odds = cv2.GaussianBlur(np.log(core_share[indices] / outside_share[indices]), (0, 0), 2)
    labels = np.where((guess == cv2.GC_PR_BGD) & (odds > 0), cv2.GC_PR_FGD, guess)
    return np.where(outside & (odds < 0) & ~core, cv2.GC_BGD, labels).astype(np.uint8)


def _remove_border(picture: Mask, width: float) -> Mask:
    """The picture without a band along its border, of this width over its height."""
    inside, band = np.zeros_like(picture), max(1, round(width * len(picture)))
    inside[band:-band, band:-band] = True
    return inside


def _grow(colours: Pixels, guess: Pixels) -> Mask:
    """GrabCut of the colours (h, w, 3) from a guess (h, w) in its labels."""
    label = guess.copy()
    cv2.setRNGSeed(0)
    background, foreground = np.zeros((2, 1, 65))
    cv2.grabCut(colours, label, None, background, foreground, Limits.iterations, cv2.GC_INIT_WITH_MASK)
    return np.asarray((label == cv2.GC_FGD) | (label == cv2.GC_PR_FGD))


def _morph(mask: Mask, operation: int, radius: int) -> Mask:
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), operation, disc) > 0)


def _add_hidden(mask: Mask, seeds: Mask, hidden: Mask) -> Mask:
    """The mask with what instruments hide within the convex hull of its components that move (seeds)."""
    label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
    parts = mask & np.isin(label, np.unique(label[seeds]))
    return parts | (_hull(parts) & hidden)


def _hull(mask: Mask) -> Mask:
    """The convex hull of a mask (h, w)."""
    outline = cv2.convexHull(np.argwhere(mask)[:, ::-1].astype(np.int32))
    return np.asarray(cv2.fillConvexPoly(np.zeros(mask.shape, np.uint8), outline, 1) > 0)


def _keep_moving(mask: Mask, core: Mask, seeds: Mask) -> Mask:
    """The component that contains most of the core, and others that move (seeds): veins divide tissue."""
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    largest = 1 + np.argmax(np.bincount(label[core], minlength=count)[1:])
    moving_px = np.bincount(label[seeds & mask], minlength=count)
    return np.asarray(
        np.isin(label, [largest, *np.flatnonzero(moving_px > Limits.min_part * moving_px[largest])])
    )


def _fill_holes(mask: Mask) -> Mask:
    """The mask without holes."""
    edges = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    return np.asarray(cv2.drawContours(np.zeros(mask.shape, np.uint8), edges, -1, 1, cv2.FILLED) > 0)
