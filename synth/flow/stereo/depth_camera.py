"""Motion in three dimensions from a flow and the pictures of a depth camera."""

from __future__ import annotations

import cv2
import numpy as np

from synth.arrays import Floats, Map, Mask
from synth.errors import UserError
from synth.flow import image
from synth.flow.confidence import deviation
from synth.flow.stereo.depth_motion import Solver, interpolate_cells
from synth.flow.stereo.stereo_track import Motion3D

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
        self._known = _find_known(rest) & tissue & ~blocked
        if not self._known.any():
            raise UserError("depth: no depth of the tissue is known in the rest frame")
        self._rest = np.where(self._known, rest, np.median(rest[self._known])).astype(np.float32)
        self.distance_mm = float(np.median(rest[self._known]))  # median depth of the tissue at rest
        self.solver = Solver((tissue.shape[0], tissue.shape[1]))

    def step(self, depth: Map, blocked: Mask, flow: Map, confidence: Map) -> Motion3D:
        """The motion to the next frame, of depth (H, W) mm, flow (H, W, 2) px and its confidence (H, W)."""
        if depth.shape != self.tissue.shape:
            raise UserError(f"depth: a picture of {depth.shape}, but the rest frame is {self.tissue.shape}")
        sampling = *image.end_points(flow), cv2.INTER_LINEAR
        usable = _find_known(depth) & ~blocked
        depth_now = cv2.remap(np.where(usable, depth, 0).astype(np.float32), *sampling)
        visible = cv2.remap(usable.astype(np.float32), *sampling, borderValue=0) > 0.999
        rise = np.where(visible & self._known, depth_now - self._rest, 0).astype(np.float32)
        weight = np.clip(confidence, 0, 1) * (visible & self._known)
        flow_planes = np.ascontiguousarray(flow.transpose(2, 0, 1))
        change = self.solver.smooth(rise, weight.astype(np.float32), flow_planes, 1.0)
        axial_deviation = np.maximum(
            interpolate_cells(_CAUTION * change.deviation, self.solver.cell, self.tissue.shape), 1e-4
        )
        rise = change.px
        height, width = depth.shape
        x = np.arange(width, dtype=np.float32) - np.float32(self.K[0, 2])
        y = np.arange(height, dtype=np.float32)[:, None] - np.float32(self.K[1, 2])
        after = self._rest + rise
        lateral = [
            (flow_planes[k] * after + position * rise) / np.float32(self.K[k, k])
            for k, position in enumerate((x, y))
        ]
        lateral_deviation = self._rest / np.float32(self.K[0, 0]) * deviation(confidence)
        tissue = self.tissue[..., None]
        return Motion3D(
            (np.stack([*lateral, rise], axis=-1) * tissue).astype(np.float32),
            (np.stack([lateral_deviation, lateral_deviation, axial_deviation], axis=-1) * tissue).astype(
                np.float32
            ),
        )


def _find_known(depth: Map) -> Mask:
    return np.asarray(np.isfinite(depth) & (depth > 0))
