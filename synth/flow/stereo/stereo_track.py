"""Motion in three dimensions through a stereo video, from the rest frame to each frame."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from synth.arrays import Map, Mask, Pixels
from synth.errors import UserError
from synth.flow import image, kernels
from synth.flow.confidence import deviation
from synth.flow.stereo import depth_correction, rest
from synth.flow.stereo.depth_motion import Change, Solver, StereoPictures, interpolate_cells
from synth.flow.stereo.rig import Rectified, StereoRig


class Stereo:
    """Constants of motion in three dimensions; chosen by hand where no source is given."""

    still_px: float = 0.3  # 98th percentile of the flow below which a frame is at rest
    max_rest_frames: int = 4  # most frames that count as rest frames
    synchronous_lag: float = 0.12  # measured lag of synchronous cameras, as a share of the motion
    min_confidence: float = 0.3  # least confidence of the flow: lower under an unmasked tool, 0.9 on tissue
    lateral_factor: float = 1.15  # factor of the lateral deviation, calibrated to its coverage at contacts
    axial_factor: float = 1.3  # factor of the deviation along the optical axis, likewise
    correction_deviation: float = 0.4  # relative standard deviation of the correction of depth
    min_visible: float = 0.05  # visible share of the tissue below which the next frame starts from zero


@dataclass(frozen=True)
class Motion3D:
    """Motion from rest to one frame, on the pixels of the left rest frame."""

    motion: Map  # (H, W, 3) mm, in the axes of the left camera; 0 outside the tissue
    deviation: Map  # (H, W, 3) mm, standard deviation of each component; 0 outside the tissue

    @classmethod
    def zeros(cls, size: tuple[int, ...]) -> Motion3D:
        """Zero motion with zero deviation on (H, W) pixels, as in the rest frame."""
        return cls(*np.zeros((2, *size, 3), np.float32))


class StereoTracker:
    """Tracks motion in three dimensions from frames of both cameras and the flow of the left one.

    The flow may come from a `synth.flow.track.Tracker` or any other source and is not changed.
    """

    def __init__(
        self,
        rig: StereoRig,
        lefts: Pixels,
        rights: Pixels,
        left_blocked: Mask,
        right_blocked: Mask,
        tissue: Mask,
    ) -> None:
        """Starts at the rest frame, 0, with the first n frames (n, H, W, 3) uint8, all at rest.

        `left_blocked`, `right_blocked`: (H, W), instruments and glare in the rest frame; `tissue`: (H, W), in
        the left one. UserError: the rest pictures do not match, or shapes differ.
        """
        width, height = rig.size
        if lefts.shape != rights.shape or not lefts.shape[1:3] == tissue.shape == (height, width):
            raise UserError(
                f"stereo: pictures {lefts.shape[1:3]} and {rights.shape[1:3]}, tissue {tissue.shape} and "
                f"calibration {(height, width)} differ"
            )
        self.rectified, self.tissue = Rectified(rig), tissue
        r = self.rectified
        usable = (r.flags(tissue & ~left_blocked, 0), r.flags(~right_blocked, 1))
        greys = [
            np.stack([r.picture(image.luminance(picture), camera) for picture in pictures])
            for camera, pictures in enumerate((lefts, rights))
        ]
        self.rest = rest.match(greys[0], greys[1], *usable)
        self.solver = Solver((height, width))
        self._left, _ = self._normalise(lefts[0], usable[0], 0)
        right, known = self._normalise(rights[0], usable[1], 1)
        self._right, self._usable = np.empty_like(right), np.empty_like(right)
        disparity_flow = np.stack([-self.rest.disparity, np.zeros_like(right)])
        kernels.warp_into(right, known, disparity_flow, self._right, self._usable)
        self._usable *= usable[0]
        self.distance_mm = float(np.median(r.depth(self.rest.disparity)[usable[0]]))  # of the tissue at rest
        self.px_per_mm = r.focal * r.baseline_mm / self.distance_mm**2  # disparity over motion along the axis
        self._mm_per_px = float(np.median(r.depth(self.rest.disparity))) / r.focal
        self._change: Map | None = None

    def right_tissue(self) -> Mask:
        """Tissue mask (H, W) in the right rest picture."""
        r = self.rectified
        rows, columns = np.nonzero(r.flags(self.tissue, 0))
        right_columns = np.rint(columns - self.rest.disparity[rows, columns]).astype(int)
        inside = (right_columns >= 0) & (right_columns < self.tissue.shape[1])
        right_mask = np.zeros(self.tissue.shape, np.float32)
        right_mask[rows[inside], right_columns[inside]] = 1
        # Dilation fills the columns that stay empty where the tissue is steep.
        return r.unrectify(cv2.dilate(right_mask, np.ones((3, 5), np.uint8)), 1) > 0

    def step(
        self, left: Pixels, right: Pixels, left_blocked: Mask, right_blocked: Mask, flow: Map, confidence: Map
    ) -> Motion3D:
        """The motion from rest to the next frame: pictures (H, W, 3) uint8, masks (H, W) of instruments and
        glare, and the left camera's flow (H, W, 2) px with its confidence (H, W)."""
        r = self.rectified
        now, now_usable = self._normalise(left, r.flags(~left_blocked, 0), 0)
        right_now, right_usable = self._normalise(right, r.flags(~right_blocked, 1), 1)
        # Where the flow lost the tissue, both cameras may see an unmasked occluder.
        tracked = self._usable * (r.picture(confidence, 0) > Stereo.min_confidence)
        pictures = StereoPictures(self._left, self._right, tracked, now, right_now, now_usable, right_usable)
        rectified_flow = r.flow(flow)
        change = self.solver.solve(
            pictures, rectified_flow, self.rest.disparity, self.px_per_mm, self._change
        )
        is_lost = float(change.visible.sum()) < Stereo.min_visible * float(self._usable.sum())
        self._change = None if is_lost else change.px
        return self._measure_motion(change, rectified_flow, confidence, is_lost)

    def _measure_motion(self, change: Change, flow: Map, confidence: Map, is_lost: bool) -> Motion3D:
        r, disparity, solver = self.rectified, self.rest.disparity, self.solver
        self.lag = change.lag
        features, spread = self.describe(change, flow, confidence)
        correction_mm, depth_deviation = depth_correction.correct(features)
        if is_lost:  # no correction where the right camera shows nothing
            correction_mm = np.zeros_like(correction_mm)
        # Where the right camera sees nothing, the deviation is that of the plate.
        spread_mm = Stereo.correction_deviation * correction_mm
        depth_deviation = np.hypot(Stereo.axial_factor * depth_deviation, spread_mm)
        depth_deviation = np.maximum(depth_deviation, change.deviation / self.px_per_mm)
        # A right picture of another moment turns lateral motion into apparent depth.
        lag = np.sqrt(max(change.lag**2 - Stereo.synchronous_lag**2, 0.0))
        lag = lag * solver.average_cells(np.abs(flow[0]) + np.abs(change.px))
        depth_deviation = np.hypot(depth_deviation, lag / self.px_per_mm)
        # The correction [mm] as a change of disparity at the depth found.
        depth_mm = r.depth(disparity + change.px)
        depth_ratio = depth_mm / (depth_mm + interpolate_cells(correction_mm, solver.cell, disparity.shape))
        px = (disparity + change.px + r.shift) * depth_ratio - r.shift - disparity
        motion = r.motion(disparity, px, flow)
        lateral_deviation = Stereo.lateral_factor * self._mm_per_px * spread
        # Logarithms are interpolated, because cubic interpolation of the deviations could give negative ones.
        logs = [
            interpolate_cells(np.log(part), solver.cell, disparity.shape)
            for part in (lateral_deviation, lateral_deviation, depth_deviation)
        ]
        planes = [r.unrectify(np.ascontiguousarray(motion[..., k])) for k in range(3)]
        tissue = self.tissue[..., None]
        return Motion3D(
            np.stack(planes, axis=-1) * tissue,
            np.stack([np.exp(r.unrectify(part)) for part in logs], axis=-1) * tissue,
        )

    def describe(self, change: Change, flow: Map, confidence: Map) -> tuple[Map, Map]:
        """Features of `depth_correction`, and the standard deviation (h, w) px of a flow component, by the
        rectified flow (2, H, W) px and its confidence (H, W) on the original left pixels."""
        r, average = self.rectified, self.solver.average_cells
        visible = r.flags(confidence > 0, 0).astype(np.float32)
        share = average(visible)
        mean_confidence = average(r.picture(confidence, 0) * visible) / np.maximum(share, 0.1)
        spread = deviation(image.fill(np.asarray(mean_confidence, np.float32), image.flags(share > 0.1)))
        sizes = self.px_per_mm, self._mm_per_px
        return depth_correction.describe(change, self.solver, flow, share, spread, *sizes), spread

    def _normalise(self, rgb: Pixels, usable: Mask, camera: int) -> tuple[Map, Map]:
        """Rectified picture in local deviations, and the mask, both (H, W) float32."""
        known = image.flags(usable)
        return image.normalise(self.rectified.picture(image.luminance(rgb), camera), known), known


def still_frames(flow: Map, tissue: Mask) -> int:
    """Number of leading frames of a flow (T, H, W, 2) px that are at rest: 1 to 4."""
    count = 1
    while count < min(len(flow), Stereo.max_rest_frames):
        length = np.linalg.norm(flow[count][tissue], axis=-1)
        if length.size and np.quantile(length, 0.98) > Stereo.still_px:
            break
        count += 1
    return count
