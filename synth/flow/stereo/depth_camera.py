"""Motion in three dimensions from a flow and a depth camera: what a second eye gives, from depth pictures."""

from __future__ import annotations

import cv2
import numpy as np

from synth.errors import UserError
from synth.flow.confidence import deviation
from synth.flow.estimator import Flags, Flow, Map
from synth.flow.stereo.depth_motion import Change, Solver, fine
from synth.flow.stereo.rig import Floats
from synth.flow.stereo.track import Moved

_CAUTION = 1.5  # factor of the plate's deviation, which ignores correlated errors of depth; by hand


class DepthTracker:
    """Depth pictures beside a flow of the video that they lie on; its steps are a `StereoTracker`'s answers.

    What the flow's point is nearer or farther now is smoothed as the change of disparity is, in mm: a thin
    plate that softens where tissue strains, Student's weights, the noise from the residuals' median.
    """

    def __init__(self, K: Floats, rest: Map, blocked: Flags, tissue: Flags) -> None:
        """Starts at rest.

        Args:
            K: (3, 3) px, of pictures without distortion.
            rest: (H, W) mm, depth in the rest frame along the camera's axis; not finite or <= 0: unknown.
            blocked: (H, W), tool and glare in the rest frame.
            tissue: (H, W).

        Raises:
            UserError: shapes that don't fit, or no depth of the tissue.
        """
        if rest.shape != tissue.shape:
            raise UserError(f"depth: pictures {rest.shape} and tissue {tissue.shape} differ")
        self.K, self.tissue = K, tissue
        self._known = _known(rest) & tissue & ~blocked
        if not self._known.any():
            raise UserError("depth: the rest frame has no depth of the tissue")
        self._rest = np.where(self._known, rest, np.median(rest[self._known])).astype(np.float32)
        self.distance_mm = float(np.median(rest[self._known]))
        """Median of the tissue's, at rest."""
        self.solver = Solver((tissue.shape[0], tissue.shape[1]))
        self.noise_mm = float("nan")
        """Median deviation of depth motion over the tissue in the last frame."""

    def step(self, depth: Map, blocked: Flags, flow: Flow, confidence: Map) -> Moved:
        """Motion since rest in the next frame.

        Args:
            depth: (H, W) mm.
            blocked: (H, W), tool and glare.
            flow: (H, W, 2) px.
            confidence: (H, W) in 0..1, of that flow.
        """
        if depth.shape != self.tissue.shape:
            raise UserError(f"depth: a picture of {depth.shape}, the rest frame has {self.tissue.shape}")
        height, width = depth.shape
        x = np.arange(width, dtype=np.float32) + flow[..., 0]
        y = np.arange(height, dtype=np.float32)[:, None] + flow[..., 1]
        usable = _known(depth) & ~blocked
        there = cv2.remap(np.where(usable, depth, 0).astype(np.float32), x, y, cv2.INTER_LINEAR)
        seen = cv2.remap(usable.astype(np.float32), x, y, cv2.INTER_LINEAR, borderValue=0) > 0.999
        rise = np.where(seen & self._known, there - self._rest, 0).astype(np.float32)
        weight = np.clip(confidence, 0, 1) * (seen & self._known)
        straight = np.ascontiguousarray(flow.transpose(2, 0, 1))
        change = self.solver.smooth(rise, weight.astype(np.float32), straight, 1.0)
        spread = self._deviation(change)
        self.noise_mm = float(np.median(spread[self.tissue]))
        return self._moved(change.px, spread, straight, confidence)

    def _deviation(self, change: Change) -> Map:
        """(H, W) mm, of the depth motion: the plate's posterior."""
        return np.maximum(fine(_CAUTION * change.deviation, self.solver.cell, self.tissue.shape), 1e-4)

    def _moved(self, rise: Map, spread: Map, flow: Map, confidence: Map) -> Moved:
        height, width = self.tissue.shape
        x = np.arange(width, dtype=np.float32) - np.float32(self.K[0, 2])
        y = np.arange(height, dtype=np.float32)[:, None] - np.float32(self.K[1, 2])
        after = self._rest + rise
        across = [(flow[k] * after + at * rise) / np.float32(self.K[k, k]) for k, at in enumerate((x, y))]
        off = self._rest / np.float32(self.K[0, 0]) * deviation(confidence)
        inside = self.tissue[..., None]
        return Moved(
            (np.stack([*across, rise], axis=-1) * inside).astype(np.float32),
            (np.stack([off, off, spread], axis=-1) * inside).astype(np.float32),
        )


def _known(depth: Map) -> Flags:
    return np.asarray(np.isfinite(depth) & (depth > 0))
