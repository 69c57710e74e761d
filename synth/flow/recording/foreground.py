"""Detection of unmasked foreground: objects that stand above the tissue, move unlike it, or occlude it."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.flow import image
from synth.flow.confidence import LOW_CONFIDENCE
from synth.flow.recording.finding import Finding
from synth.flow.recording.frame_motion import FrameMotion


class Limits:
    """Limits for foreground, chosen by hand on videos with foreign objects and without."""

    min_height_mm: float = 2.5  # least height above the surface of the tissue: more than its relief
    min_height_sigmas: float = 5.0  # least height in standard deviations of the depth
    min_raised: float = 0.005  # least share of the tissue that a raised object covers
    min_jump_px: float = 0.25  # least jump of the flow
    min_jump: float = 0.2  # least jump as a share of the largest motion
    min_motion_px: float = 0.7  # largest motion below which jumps are not searched
    offset_px: int = 5  # distance from a jump at which the flow is compared
    min_extent: float = 0.12  # of a jump over the width of the picture: more than the rim of a contact
    min_lost: float = 0.02  # least share of the tissue that an occluder covers
    max_colour_change: float = 14.0  # grey levels under which what is lost may be tissue that moved far
    large_motion_px: float = 4.0  # motion from which flow may lose tissue in view
    margin_px: int = 8  # margin around masks that is not searched
    iterations: int = 8  # iterations of the robust fit of the surface
    min_hand_width: float = 0.25  # least width of a hand over that of the picture; spatulas: 0.2
    max_tool_overlap: float = 0.1  # share on or next to what is segmented: above it an object is part of that
    tool_margin_px: int = 12  # what is next to it
    min_width_ratio: float = 1.5  # its least width over that of the tools at rest, which may be as wide


_WIDE = "is wider than an instrument"


class ForegroundSearch:
    """Searches frames of a video, in order from the rest frame on."""

    def __init__(self, tissue: Mask, shrink: int, *, is_stated: bool, has_masks: bool) -> None:
        """Starts before the rest frame, with tissue (h, w) that `is_stated` or found, in frames downsampled
        by `shrink`. `has_masks`: instruments' masks are given: without, narrow objects are instruments."""
        self._tissue, self._shrink = tissue, shrink
        self._is_stated, self._has_masks = is_stated, has_masks
        self._surface: tuple[Map, float] | None = None
        self._objects: dict[str, list[tuple[float, str, Mask]]] = {}
        self._masked = ~tissue  # in any frame
        self._width_px = 0.0  # of the widest tool at rest
        self._hidden = np.zeros_like(tissue)  # in the rest frame
        self._rest_rgb = np.zeros((0, 0, 3), np.uint8)
        # Where the tissue is not stated, what is in front of it from the start may be its surroundings.
        self._surroundings = np.zeros_like(tissue)

    def add(self, frame: FrameMotion, depth_mm: Map | None = None) -> None:
        """Searches a frame; `depth_mm`: (h, w) along the optical axis, NaN: unknown; None: monocular."""
        if frame.is_rest:
            self._hidden, self._rest_rgb = frame.hidden, frame.rgb
        if not self._has_masks:
            self._find_wide(frame.instruments, frame)
        if depth_mm is not None:
            free = self._find_free(frame.hidden)
            self._surface = self._surface or fit_surface(depth_mm, free)
            surface, deviation = self._surface
            with np.errstate(invalid="ignore"):
                raised = surface - depth_mm > max(Limits.min_height_mm, Limits.min_height_sigmas * deviation)
            if frame.is_rest and not self._is_stated:
                self._surroundings = cv2.dilate(raised.astype(np.uint8), _square(Limits.margin_px)) > 0
            raised &= free & ~self._surroundings
            self._note("stands in front of the tissue", raised, frame, Limits.min_raised)
        if frame.is_rest or not frame.trusted:
            return
        # Flow and confidence are at the rest frame's pixels, masks at the picture's: tissue that has moved
        # under a mask is hidden where it was at rest.
        free = self._find_free(_warp_to_rest(frame.hidden, frame.flow))
        doubtful = free & (frame.confidence > 0) & (frame.confidence < LOW_CONFIDENCE)
        # A textured object hides tissue in patches only, as some of its texture resembles the tissue's.
        closed = cv2.morphologyEx(doubtful.astype(np.uint8), cv2.MORPH_CLOSE, _square(Limits.margin_px))
        lost = self._exclude_far(np.asarray(closed > 0), frame)
        self._note("hides tissue that is visible at rest", lost, frame, Limits.min_lost)
        motion = float(np.percentile(np.linalg.norm(frame.flow[self._tissue], axis=-1), 98))
        if motion > Limits.min_motion_px and self._has_masks:  # else it would be that of an instrument
            inner = cv2.erode(free.astype(np.uint8), _square(2 * Limits.offset_px), borderValue=0) > 0
            jump = flow_jump(frame.flow) > max(Limits.min_jump_px, Limits.min_jump * motion)
            edge = jump & inner & (frame.confidence > LOW_CONFIDENCE)
            self._note("moves unlike tissue", edge, frame, 0.0, Limits.min_extent)

    def _find_free(self, hidden: Mask) -> Mask:
        """Tissue (h, w) away from what is `hidden` (h, w) or was so in the rest frame."""
        masked = ~self._tissue | hidden | self._hidden
        self._masked |= masked
        return np.asarray(cv2.erode((~masked).astype(np.uint8), _square(Limits.margin_px), borderValue=1) > 0)

    @property
    def findings(self) -> list[Finding]:
        """The largest object of each kind that is found in two frames or more and not masked in others."""
        findings = []
        for kind, objects in self._objects.items():
            is_unmasked = [kind == _WIDE or self._masked[mask].mean() < 0.5 for *_, mask in objects]
            unmasked = [
                (share, text) for (share, text, _), use in zip(objects, is_unmasked, strict=True) if use
            ]
            if len(unmasked) > 1:
                findings.append(Finding("warning", "foreground", max(unmasked)[1]))
        return findings

    def _exclude_far(self, lost: Mask, frame: FrameMotion) -> Mask:
        """What is lost (h, w) without what may be tissue that moved too far for flow: tissue moves far around
        it, and its colours are the rest frame's, there or where flow leads."""
        rest, now = self._rest_rgb, frame.rgb
        _, label, stats, _ = cv2.connectedComponentsWithStats(lost.astype(np.uint8))
        large = stats[:, cv2.CC_STAT_AREA] > Limits.min_lost * np.count_nonzero(self._tissue)
        if not large[1:].any() or now.shape != rest.shape or not rest.size:
            return lost
        window = (2 * Limits.margin_px + 1,) * 2
        warped = cv2.remap(
            now, *image.end_points(frame.flow), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        rest_colour, colour, warped_colour = (
            cv2.blur(picture, window).astype(np.float32) for picture in (rest, now, warped)
        )
        changes = [np.abs(after - rest_colour).mean(axis=-1) for after in (colour, warped_colour)]
        similar = np.min(changes, axis=0) < Limits.max_colour_change
        motion = np.linalg.norm(frame.flow, axis=-1)
        remaining = lost.copy()
        for k in 1 + np.flatnonzero(large[1:]):
            component = label == k
            surroundings = cv2.dilate(component.astype(np.uint8), _square(Limits.margin_px)) > 0
            if np.percentile(motion[surroundings], 90) > Limits.large_motion_px:
                remaining &= ~(component & similar)
        return np.asarray(remaining)

    def _find_wide(self, tool: Mask, frame: FrameMotion) -> None:
        """Notes a detected tool that is wider than tools are and than those at rest."""
        width_px = _width(tool)
        if frame.is_rest:
            self._width_px = float(width_px.max())
        min_width_px = max(Limits.min_hand_width * tool.shape[1], Limits.min_width_ratio * self._width_px)
        self._note(_WIDE, width_px > min_width_px, frame, 0.0)

    def _note(self, kind: str, mask: Mask, frame: FrameMotion, share: float, extent: float = 0.0) -> None:
        """Stores the largest component if it has this share of tissue and this extent in picture widths.

        Without masks narrow ones are left out, which are instruments, or parts of them, not detected; and
        those of which the segmentation holds a part: an instrument with its shadow.
        """
        opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, _square(0 if extent else 1))
        _, label, stats, centres = cv2.connectedComponentsWithStats(opened)
        if len(stats) < 2:
            return
        if not self._has_masks and kind != _WIDE:
            hands = np.unique(label[_width(opened > 0) > Limits.min_hand_width * mask.shape[1]])
            stats[np.setdiff1d(np.arange(len(stats)), hands)] = 0
            tools = cv2.dilate(frame.instruments.astype(np.uint8), _square(Limits.tool_margin_px)) > 0
            overlap = np.bincount(label[_warp_to_rest(tools, frame.flow)], minlength=len(stats))
            stats[overlap > Limits.max_tool_overlap * stats[:, cv2.CC_STAT_AREA]] = 0
        k = 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
        area = float(stats[k, cv2.CC_STAT_AREA] / np.count_nonzero(self._tissue))
        width, height = stats[k, cv2.CC_STAT_WIDTH], stats[k, cv2.CC_STAT_HEIGHT]
        if area > 0 and area >= share and np.hypot(width, height) >= extent * mask.shape[1]:
            x, y = self._shrink * (centres[k] + 0.5) - 0.5
            text = f"an object at x {x:.0f}, y {y:.0f} in frame {frame.index} {kind}: mask it in masks/?"
            self._objects.setdefault(kind, []).append((area, text, label == k))


def fit_surface(depth_mm: Map, tissue: Mask) -> tuple[Map, float]:
    """A smooth surface (h, w) mm fitted to the tissue (h, w), and the tissue's deviation from it [mm].

    A quadratic by least squares; each round leaves out outliers, with a tighter limit in front.
    """
    height, width = depth_mm.shape
    y, x = np.mgrid[:height, :width] / max(height, width) - 0.5
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    known = tissue & np.isfinite(depth_mm)
    used, surface, deviation = known, np.full(depth_mm.shape, np.nan), 0.0
    for _ in range(Limits.iterations):
        if np.count_nonzero(used) < 10 * terms.shape[-1]:
            break
        surface = terms @ np.linalg.lstsq(terms[used], depth_mm[used], rcond=None)[0]
        residual = np.where(known, depth_mm - surface, np.nan)
        deviation = 1.4826 * float(np.median(np.abs(residual[used] - np.median(residual[used]))))
        with np.errstate(invalid="ignore"):
            used = known & (residual > -2 * max(deviation, 0.1)) & (residual < 3.5 * max(deviation, 0.1))
    return np.asarray(surface, np.float32), deviation


def flow_jump(flow: Map) -> Map:
    """Excess (h, w) px of the change of a flow (h, w, 2) across a place over that on both sides of it.

    It is 0 for a linear flow and small for a smooth one, as on elastic tissue; it is large at edges.
    """

    def translate(dx: float, dy: float) -> Map:
        shift, size = np.array([[1, 0, dx], [0, 1, dy]], np.float32), (flow.shape[1], flow.shape[0])
        return np.asarray(cv2.warpAffine(flow, shift, size, borderMode=cv2.BORDER_REPLICATE))

    excess, inner, outer = np.zeros(flow.shape[:2], np.float32), Limits.offset_px, 2.5 * Limits.offset_px
    for dx, dy in ((1, 0), (0, 1), (0.7, 0.7), (0.7, -0.7)):
        a, b, c, d = (translate(k * dx, k * dy) for k in (inner, -inner, outer, -outer))
        # The distance is 2 widths across the place and 1.5 widths on either side.
        slopes = np.linalg.norm(c - a, axis=-1) + np.linalg.norm(b - d, axis=-1)
        excess = np.maximum(excess, np.linalg.norm(a - b, axis=-1) - slopes * 2 / 3)
    return excess


def _warp_to_rest(mask: Mask, flow: Map) -> Mask:
    """A picture's mask (h, w) at the rest frame's pixels, by the flow (h, w, 2) px from there."""
    x = flow[..., 0] + np.arange(mask.shape[1], dtype=np.float32)
    y = flow[..., 1] + np.arange(mask.shape[0], dtype=np.float32)[:, None]
    return np.asarray(cv2.remap(mask.astype(np.uint8) * 255, x, y, cv2.INTER_LINEAR) > 0)


def _width(mask: Mask) -> Map:
    """Width (h, w) px of a mask around each of its pixels: twice the distance from its outline, of which the
    border of the picture is a part: a rod that leaves there isn't as wide as its cut."""
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    distance = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    return np.asarray(2 * distance, np.float32)


def _square(around_px: int) -> Pixels:
    return np.ones((2 * around_px + 1, 2 * around_px + 1), np.uint8)
