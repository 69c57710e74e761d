"""Motion in three dimensions through a stereo video: rest to now, each frame starting from the one before."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from synth.errors import UserError
from synth.flow import image, kernels
from synth.flow.confidence import deviation
from synth.flow.estimator import Flags, Flow, Map, Rgb
from synth.flow.stereo import depth_correction, rest
from synth.flow.stereo.depth_motion import Change, Solver, StereoPictures, fine
from synth.flow.stereo.rig import Rectified, StereoRig


@dataclass(frozen=True)
class StereoConstants:
    """Constants of motion in three dimensions; by hand where no source is given."""

    still_px: float = 0.3  # frames whose flow is nearly everywhere below this are at rest
    rests: int = 4  # of these, at most
    in_time: float = 0.12  # share of the motion that cameras of one moment may seem to differ by
    followed: float = 0.3  # confidence of the flow: less under a tool that no mask holds; on tissue 0.9
    across: float = 1.15  # factor of the flow network's deviation, by its coverage at contacts
    along: float = 1.3  # the same of the depth network's
    added: float = 0.4  # share of what the depth's correction adds that may be wrong
    lost: float = 0.05  # of what is visible at rest: the next frame doesn't start from one that shows less


STEREO = StereoConstants()


@dataclass(frozen=True)
class Moved:
    """One frame's motion since rest, on the left eye's rest pixels."""

    motion: NDArray[np.float32]
    """(H, W, 3) mm, the left camera's axes; 0 outside the tissue."""
    deviation: NDArray[np.float32]
    """(H, W, 3) mm, standard deviation of each component; 0 outside the tissue."""

    @classmethod
    def nothing(cls, size: tuple[int, ...]) -> Moved:
        """Of the rest frame itself, (H, W): no motion, and that for certain."""
        return cls(*np.zeros((2, *size, 3), np.float32))


class StereoTracker:
    """The right eye beside a flow of the left one: frames and flow in, motion in three dimensions out.

    The flow comes from a `synth.flow.track.Tracker` (or anything else) and is not changed.
    """

    def __init__(
        self,
        rig: StereoRig,
        lefts: NDArray[np.uint8],
        rights: NDArray[np.uint8],
        left_blocked: Flags,
        right_blocked: Flags,
        tissue: Flags,
    ) -> None:
        """Starts at rest.

        Args:
            rig: the pair of cameras.
            lefts: (n, H, W, 3) uint8, the left eye's first n frames, all at rest; frame 0 is the rest frame.
            rights: the same of the right eye.
            left_blocked: (H, W), tool and glare in the rest frame.
            right_blocked: (H, W), the same of the right eye.
            tissue: (H, W), where there is tissue, in the left eye.

        Raises:
            UserError: the rest pictures don't match, or shapes that don't fit.
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
            np.stack([r.picture(picture @ image.GREY, eye) for picture in pictures])
            for eye, pictures in enumerate((lefts, rights))
        ]
        self.rest = rest.match(greys[0], greys[1], *usable)
        """Rest disparity, and how far off the calibration is."""
        self.solver = Solver((height, width))
        self._left, _ = self._normalised(lefts[0], usable[0], 0)
        right, known = self._normalised(rights[0], usable[1], 1)
        self._right, self._usable = np.empty_like(right), np.empty_like(right)
        aside = np.stack([-self.rest.disparity, np.zeros_like(right)])
        kernels.warp_into(right, known, aside, self._right, self._usable)
        self._usable *= usable[0]
        self.distance_mm = float(np.median(r.depth(self.rest.disparity)[usable[0]]))
        """Median of the tissue's, at rest."""
        self.px_per_mm = r.focal * r.baseline_mm / self.distance_mm**2
        """Change of disparity of tissue that moves 1 mm along the line of sight."""
        self._mm_per_px = float(np.median(r.depth(self.rest.disparity))) / r.focal
        self._change: Map | None = None

    def right_tissue(self) -> Flags:
        """(H, W) where the tissue is in the right eye's rest picture."""
        r = self.rectified
        rows, columns = np.nonzero(r.flags(self.tissue, 0))
        there = np.rint(columns - self.rest.disparity[rows, columns]).astype(int)
        inside = (there >= 0) & (there < self.tissue.shape[1])
        found = np.zeros(self.tissue.shape, np.float32)
        found[rows[inside], there[inside]] = 1
        # Where the tissue is steep, columns stay empty.
        return r.back(cv2.dilate(found, np.ones((3, 5), np.uint8)), 1) > 0

    def step(
        self, left: Rgb, right: Rgb, left_blocked: Flags, right_blocked: Flags, flow: Flow, confidence: Map
    ) -> Moved:
        """Motion since rest in the next frame.

        Args:
            left: (H, W, 3) uint8.
            right: (H, W, 3) uint8.
            left_blocked: (H, W), tool and glare.
            right_blocked: (H, W).
            flow: (H, W, 2) px, the left eye's.
            confidence: (H, W) in 0..1, of that flow.
        """
        r = self.rectified
        now, now_usable = self._normalised(left, r.flags(~left_blocked, 0), 0)
        other, other_usable = self._normalised(right, r.flags(~right_blocked, 1), 1)
        # Where the left eye lost the tissue, what both eyes see there is what came between.
        followed = self._usable * (r.picture(confidence, 0) > STEREO.followed)
        pictures = StereoPictures(self._left, self._right, followed, now, other, now_usable, other_usable)
        straight = r.flow(flow)
        change = self.solver.solve(pictures, straight, self.rest.disparity, self.px_per_mm, self._change)
        lost = float(change.visible.sum()) < STEREO.lost * float(self._usable.sum())
        self._change = None if lost else change.px
        return self._moved(change, straight, confidence, lost)

    def _moved(self, change: Change, flow: Map, confidence: Map, lost: bool) -> Moved:
        r, disparity, solver = self.rectified, self.rest.disparity, self.solver
        self.lag = change.lag
        """Share of the last frame's motion that the right eye didn't show: 0 for eyes of one moment."""
        features, spread = self.describe(change, flow, confidence)
        added, off = depth_correction.correct(features)
        if lost:  # of a second eye that shows nothing there is nothing to correct
            added = np.zeros_like(added)
        # What the second eye doesn't see is known by the plate alone.
        off = np.maximum(
            np.hypot(STEREO.along * off, STEREO.added * added), change.deviation / self.px_per_mm
        )
        # What of another moment's motion passes for depth.
        late = np.sqrt(max(change.lag**2 - STEREO.in_time**2, 0.0)) * solver.coarse(
            np.abs(flow[0]) + np.abs(change.px)
        )
        off = np.hypot(off, late / self.px_per_mm)
        # A change of disparity for the millimetres to be added, at the depth that was found.
        here = r.depth(disparity + change.px)
        nearer = here / (here + fine(added, solver.cell, disparity.shape))
        px = (disparity + change.px + r.shift) * nearer - r.shift - disparity
        motion = r.motion(disparity, px, flow)
        across = STEREO.across * self._mm_per_px * spread
        # Logarithms: a deviation that falls steeply would be interpolated to below 0.
        logs = [fine(np.log(part), solver.cell, disparity.shape) for part in (across, across, off)]
        planes = [r.back(np.ascontiguousarray(motion[..., k])) for k in range(3)]
        inside = self.tissue[..., None]
        return Moved(
            np.stack(planes, axis=-1) * inside,
            np.stack([np.exp(r.back(part)) for part in logs], axis=-1) * inside,
        )

    def describe(self, change: Change, flow: Map, confidence: Map) -> tuple[NDArray[np.float32], Map]:
        """What `depth_correction` sees of a frame, and the deviation (h, w) px of the flow's components.

        Args:
            change: of the solver.
            flow: (2, H, W) px, rectified.
            confidence: (H, W) in 0..1, of that flow, on the left eye's own pixels.
        """
        r, coarse = self.rectified, self.solver.coarse
        seen = r.flags(confidence > 0, 0).astype(np.float32)
        share = coarse(seen)
        sure = coarse(r.picture(confidence, 0) * seen) / np.maximum(share, 0.1)
        spread = deviation(_filled(np.asarray(sure, np.float32), share > 0.1))
        sizes = self.px_per_mm, self._mm_per_px
        return depth_correction.describe(change, self.solver, flow, share, spread, *sizes), spread

    def _normalised(self, rgb: Rgb, usable: Flags, eye: int) -> tuple[Map, Map]:
        """The rectified picture in local deviations and where it is usable, both (H, W) float32."""
        known = usable.astype(np.float32)
        grey = torch.from_numpy(self.rectified.picture(rgb @ image.GREY, eye))[None, None]
        return image.normalise(grey, torch.from_numpy(known)[None, None])[0, 0].numpy(), known


def _filled(field: Map, known: Flags) -> Map:
    """(h, w) what is masked has the deviation of what lies around it."""
    both = (torch.from_numpy(np.asarray(one, np.float32))[None, None] for one in (field, known))
    return np.asarray(image.fill(*both)[0, 0], np.float32)


def still_frames(flow: NDArray[np.float32], tissue: Flags) -> int:
    """How many of the first frames of a flow (T, H, W, 2) px are at rest: 1 to 4."""
    count = 1
    while count < min(len(flow), STEREO.rests):
        length = np.linalg.norm(flow[count][tissue], axis=-1)
        if length.size and np.quantile(length, 0.98) > STEREO.still_px:
            break
        count += 1
    return count
