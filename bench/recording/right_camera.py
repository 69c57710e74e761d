"""The right camera or depth camera of a recording: motion in three dimensions from the flow of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import cv2
import numpy as np

from bench.recording.folder import Recording
from bench.recording.stereo_pairing import StereoPairing
from bench.recording.stereo_timing import StereoTiming
from synth.errors import UserError
from synth.flow import image, mask_detection
from synth.flow.estimator import Flags, Map, Rgb
from synth.flow.stereo import calibration
from synth.flow.stereo.depth_camera import DepthTracker
from synth.flow.stereo.rest import match
from synth.flow.stereo.rig import Floats, Intrinsics, StereoRig
from synth.flow.stereo.track import Moved, StereoTracker
from synth.recording_flow.camera_motion import CameraTracker
from synth.recording_flow.frame_motion import FrameMotion
from synth.recording_flow.video_flow import VideoFlow, shrink_picture
from synth.system import checked_file
from synth.video.read import Picture

_LARGEST_BYTES = 1 << 30  # of an array of points

LATE = 0.22  # share of the motion that the right camera lacks, from which it is out of sync
_MOVED_PX = 0.5  # less motion has no information on timing


@dataclass(frozen=True)
class StereoQuality:
    """Quality of the right or depth camera, for `bench check` and the report."""

    baseline_mm: float  # NaN for a depth camera
    epipolar_px: float  # median row error of stereo matches, at flow's resolution; NaN for a depth camera
    mm_per_px: float  # of the recording's own pixels at the tissue in the rest frame, by stereo or depth
    noise_mm: float  # median stated deviation of depth motion over tissue and frames
    lag: float = 0.0  # share of the motion that the right camera lacks: its pictures are of another moment
    fault: str = ""  # why the right pictures don't belong to the left ones; empty if they do

    def describe(self) -> str:
        """The quality in words."""
        noise = f"depth motion has a standard deviation of {self.noise_mm:.2g} mm"
        if np.isnan(self.baseline_mm):
            return f"depth camera; {noise}"
        late = f"; the right camera lacks {100 * self.lag:.0f}% of the motion: out of sync" * (
            self.lag > LATE
        )
        return f"baseline {self.baseline_mm:.3g} mm, rows {self.epipolar_px:.2g} px off; {noise}{late}"


class RightCamera:
    """Tracks the right or depth camera along with the frames of a `VideoFlow`, each once and in order."""

    def __init__(self, recording: Recording, scale_mm_per_px: float) -> None:
        """`scale_mm_per_px`: of the recording's own pixels. Nothing is read yet."""
        self.scale_mm_per_px, self._recording = scale_mm_per_px, recording
        self._stereo: StereoTracker | None = None
        self._camera: CameraTracker | None = None  # motion of the right camera
        self._depth: DepthTracker | None = None
        self._rights: Iterator[Picture] = iter(recording.right_frames()) if recording.right else iter(())
        self._shrink = 1
        self._noise: list[float] = []
        self._lags: list[float] = []
        self._pairing = StereoPairing()
        self._timing: StereoTiming | None = None
        self._pair: tuple[Rgb, Rgb] | None = None  # of the last tracked frame
        self._depth_now: Map | None = None  # of the last tracked frame

    @property
    def quality(self) -> StereoQuality | None:
        """The quality over all frames so far; None if the rest frame could not be used."""
        noise = float(np.median(self._noise)) if self._noise else float("nan")
        if self._stereo is None:
            if self._depth is None:
                return None
            away, focal = self._depth.distance_mm, float(self._depth.K[0, 0])
            return StereoQuality(float("nan"), float("nan"), away / focal / self._shrink, noise)
        r, rest = self._stereo.rectified, self._stereo.rest
        scale = self._stereo.distance_mm / r.focal / self._shrink
        fault = self._pairing.fault(r) or ("" if self._timing is None else self._timing.fault())
        lag = float(np.percentile(np.abs(self._lags), 90)) if self._lags else 0.0
        return StereoQuality(r.baseline_mm, rest.epipolar_px, scale, noise, lag, fault)

    def follow(self, frame: FrameMotion, video: VideoFlow) -> Moved | None:
        """Motion in three dimensions of a frame since rest; None if its right or depth picture is missing.

        The first frame must be the rest frame.

        Raises:
            UserError: missing rest picture, too few or unreadable pictures, a calibration that doesn't fit.
        """
        self._shrink, tissue = video.shrink, video.tissue
        masked = np.zeros_like(tissue) if frame.masked is None else frame.masked
        if self._recording.right:
            if (right := self._right(frame, video)) is None:
                return None
            if self._stereo is None or self._camera is None:
                self._pair = frame.rgb, right
                hidden = _mask_right(right, video.settings.masks, masked)
                self._stereo = self._begin(self._rig(video), frame.rgb, right, masked, hidden, tissue)
                self._pairing.add(frame.rgb, right, masked)
                self._timing = StereoTiming(self._stereo, frame.rgb, right, tissue & ~masked)
                inside = self._stereo.right_tissue()
                self._camera = CameraTracker(right, inside, mask_detection.blocked(right))
                return Moved.nothing(tissue.shape)
            # Aligning both cameras' surroundings to rest removes motion of the rig relative to the tissue.
            view = self._camera.find(right, frame.time_s) or frame.camera
            right = right if view is None else view.undo(right)
            self._pair = frame.rgb, right
            hidden = _mask_right(right, video.settings.masks, masked)
            if view is not None:
                hidden |= view.outside(tissue.shape)
            moved = self._stereo.step(frame.rgb, right, masked, hidden, frame.flow, frame.confidence)
            if np.percentile(np.abs(frame.flow[tissue]), 98) > _MOVED_PX:
                self._lags.append(self._stereo.lag)
            self._pairing.add(frame.rgb, right, masked)
            if self._timing is not None:
                self._timing.add(frame.rgb, right, frame.time_s or 0.0)
        else:
            if (depth := self._depths(frame, video)) is None:
                return None
            self._depth_now = np.where(depth > 0, depth, np.nan).astype(np.float32)
            if self._depth is None:
                self._depth = DepthTracker(self._K(video), depth, masked, tissue)
                return Moved.nothing(tissue.shape)
            moved = self._depth.step(depth, masked, frame.flow, frame.confidence)
        self._noise.append(float(np.median(moved.deviation[..., 2][tissue])))
        return moved

    def depth_mm(self) -> Map | None:
        """See `DepthSource`; with a right camera by stereo matching of the frame's own pictures."""
        if self._stereo is None or self._pair is None:
            return self._depth_now
        r, anywhere = self._stereo.rectified, np.ones(self._pair[0].shape[:2], bool)
        left, right = (r.picture(rgb @ image.GREY, camera) for camera, rgb in enumerate(self._pair))
        try:
            found = match(left, right, anywhere, anywhere, refine=False)
        except UserError:
            return None
        return r.back(np.where(found.found, r.depth(found.disparity), np.nan).astype(np.float32))

    def _begin(
        self, rig: StereoRig, left: Rgb, right: Rgb, masked: Flags, hidden: Flags, tissue: Flags
    ) -> StereoTracker:
        """Starts tracking from the rest pictures; UserError if they don't match, naming a flip that would."""
        try:
            return StereoTracker(rig, left[None], right[None], masked, hidden, tissue)
        except UserError as error:
            for how, turned in (("mirrored", right[:, ::-1]), ("upside down", right[::-1, ::-1])):
                try:
                    StereoTracker(rig, left[None], np.ascontiguousarray(turned)[None], masked, hidden, tissue)
                except UserError:
                    continue
                raise UserError(f"{self._recording.folder}: the right camera's pictures are {how}") from None
            raise error

    def _rig(self, video: VideoFlow) -> StereoRig:
        """The stereo rig for pictures reduced and cropped as by `shrink_picture`."""
        about, (height, width) = self._recording.meta.stereo, video.size
        assert about is not None
        path = self._recording.folder / about.calibration
        rig = calibration.read_rig(path, (width, height), about.mm_per_unit)
        left, right = (
            Intrinsics(_smaller(one.K, video.shrink), one.distortion) for one in (rig.left, rig.right)
        )
        size = (width // video.shrink, height // video.shrink)
        return StereoRig(left, right, rig.rotation, rig.translation, size)

    def _right(self, frame: FrameMotion, video: VideoFlow) -> Rgb | None:
        """The right camera's picture of a frame, shrunk as the video is; None: missing."""
        index = frame.index
        for picture in self._rights:
            if picture.index > index and not frame.is_rest:
                self._rights = chain([picture], self._rights)
                return None
            if picture.index == index:
                if picture.rgb.shape[:2] != video.size:
                    folder = self._recording.folder
                    raise UserError(f"{folder}: frame {index} of the right camera has another size")
                return shrink_picture(picture.rgb, video.shrink)
        raise UserError(f"{self._recording.folder}: the right camera has no frame {index}")

    def _K(self, video: VideoFlow) -> Floats:
        about, (height, width) = self._recording.meta.depth, video.size
        assert about is not None
        x, y = about.centre_px or ((width - 1) / 2, (height - 1) / 2)
        return _smaller(np.array([[about.focal_px, 0, x], [0, about.focal_px, y], [0, 0, 1.0]]), video.shrink)

    def _depths(self, frame: FrameMotion, video: VideoFlow) -> Map | None:
        """Depth (h, w) mm of a frame, or the third coordinate of its points; None: missing."""
        recording, about = self._recording, self._recording.meta.depth
        assert about is not None
        if frame.index not in recording.depths:
            if not frame.is_rest and frame.index < max(recording.depths):
                return None
            raise UserError(f"{recording.folder}: depth/ has no frame {frame.index}")
        path = recording.depths[frame.index]
        if path.suffix == ".npy":
            checked_file.check_file(path, _LARGEST_BYTES)
            try:
                found = np.load(path, allow_pickle=False)
            except (OSError, ValueError, EOFError):
                raise UserError(f"{path}: not a readable array") from None
        else:
            found = checked_file.read_picture(path, cv2.IMREAD_UNCHANGED)
        if found.ndim == 3 and found.shape[2] == 3 and found.dtype.kind == "f":
            found = found[..., 2]
        if found.ndim != 2 or found.shape != video.size or found.dtype.kind not in "uif":
            raise UserError(f"{path}: {found.shape} {found.dtype}, but the video is {video.size}")
        depth = found.astype(np.float32) * np.float32(about.mm_per_unit)
        known = np.isfinite(depth) & (depth > 0)
        share = shrink_picture(known.astype(np.float32), video.shrink)
        total = shrink_picture(np.where(known, depth, 0).astype(np.float32), video.shrink)
        return np.where(share > 0.5, total / np.maximum(share, 1e-6), 0).astype(np.float32)


def _smaller(K: Floats, shrink: int) -> Floats:
    """K after averaging shrink x shrink pixels; a picture starts half a pixel before its first centre."""
    out = K / shrink
    out[:2, 2] = (K[:2, 2] + 0.5) / shrink - 0.5
    out[2] = [0, 0, 1]
    return np.asarray(out, np.float64)


def _mask_right(rgb: Rgb, kind: str, left: Flags) -> Flags:
    """Mask (H, W) of tool and specular highlights, detected in the right picture.

    `kind`: one of `MASKS`; with `auto` nothing is masked unless something is masked in the left picture.
    """
    nothing = np.zeros(rgb.shape[:2], bool)
    if kind == "none" or (kind == "auto" and not left.any()):
        return nothing
    glare = nothing if kind == "tool" else mask_detection.glare(rgb)
    return glare if kind == "glare" else glare | mask_detection.tool(rgb)
