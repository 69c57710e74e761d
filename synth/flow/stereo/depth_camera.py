"""Motion in three dimensions from a flow and the pictures of a depth camera."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.errors import UserError
from synth.flow import image
from synth.flow.confidence import deviation
from synth.flow.stereo.depth_motion import Solver, fine
from synth.flow.stereo.stereo_track import Moved

_CAUTION = 1.5  # factor of the deviation of depth, which ignores its correlated errors; chosen by hand


class DepthTracker:
    """Tracks depth pictures registered to a video of known flow; the results are those of a `StereoTracker`.

    The change of depth at the points of the flow is smoothed like a change of disparity, in mm: a thin plate
    that is softer where the tissue is strained, Student's weights, noise from the median residual.
    """

    def __init__(self, K: Floats, rest: Map, blocked: Mask, tissue: Mask) -> None:
        """Starts at the rest frame, with a mask (H, W) of its tissue and one of its instruments and glare.

        `K`: (3, 3) px, of pictures without distortion; `rest`: depth (H, W) mm along the optical axis; not
        finite or <= 0: unknown. UserError: shapes that differ, or no depth of the tissue.
        """
        if rest.shape != tissue.shape:
            raise UserError(f"depth: pictures {rest.shape} and tissue {tissue.shape} differ")
        self.K, self.tissue = K, tissue
        self._known = _known(rest) & tissue & ~blocked
        if not self._known.any():
            raise UserError("depth: no depth of the tissue is known in the rest frame")
        self._rest = np.where(self._known, rest, np.median(rest[self._known])).astype(np.float32)
        self.distance_mm = float(np.median(rest[self._known]))  # median depth of the tissue at rest
        self.solver = Solver((tissue.shape[0], tissue.shape[1]))

    def step(self, depth: Map, blocked: Mask, flow: Map, confidence: Map) -> Moved:
        """The motion to the next frame, of depth (H, W) mm, flow (H, W, 2) px and its confidence (H, W)."""
        if depth.shape != self.tissue.shape:
            raise UserError(f"depth: a picture of {depth.shape}, but the rest frame is {self.tissue.shape}")
        at = *image.ends(flow), cv2.INTER_LINEAR
        usable = _known(depth) & ~blocked
        there = cv2.remap(np.where(usable, depth, 0).astype(np.float32), *at)
        visible = cv2.remap(usable.astype(np.float32), *at, borderValue=0) > 0.999
        rise = np.where(visible & self._known, there - self._rest, 0).astype(np.float32)
        weight = np.clip(confidence, 0, 1) * (visible & self._known)
        straight = np.ascontiguousarray(flow.transpose(2, 0, 1))
        change = self.solver.smooth(rise, weight.astype(np.float32), straight, 1.0)
        spread = np.maximum(fine(_CAUTION * change.deviation, self.solver.cell, self.tissue.shape), 1e-4)
        rise = change.px
        height, width = depth.shape
        x = np.arange(width, dtype=np.float32) - np.float32(self.K[0, 2])
        y = np.arange(height, dtype=np.float32)[:, None] - np.float32(self.K[1, 2])
        after = self._rest + rise
        across = [
            (straight[k] * after + from_axis * rise) / np.float32(self.K[k, k])
            for k, from_axis in enumerate((x, y))
        ]
        off = self._rest / np.float32(self.K[0, 0]) * deviation(confidence)
        inside = self.tissue[..., None]
        return Moved(
            (np.stack([*across, rise], axis=-1) * inside).astype(np.float32),
            (np.stack([off, off, spread], axis=-1) * inside).astype(np.float32),
        )


def _known(depth: Map) -> Mask:
    return np.asarray(np.isfinite(depth) & (depth > 0))
