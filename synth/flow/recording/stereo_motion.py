"""A stage of a video: motion in three dimensions, from a right camera or a depth camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from synth.arrays import Floats, Map, Mask, Pixels
from synth.errors import UserError
from synth.flow.recording.camera_path import CameraTracker
from synth.flow.recording.frame_motion import FrameMotion, RestFrame, Size
from synth.flow.recording.mask import MaskRight
from synth.flow.stereo.depth_camera import DepthTracker
from synth.flow.stereo.rest import find_depth, measure_scale
from synth.flow.stereo.rig import Intrinsics, StereoRig
from synth.flow.stereo.stereo_track import Motion3D, StereoTracker
from synth.video.read_video import Picture, shrink_picture


@dataclass(frozen=True)
class RightVideo:
    """The pictures of a right camera and its calibration."""

    pictures: Callable[[], Iterable[Picture]]  # in order, with the numbers of the left camera's frames
    rig: Callable[[Size], StereoRig]  # of pictures of that size
    mm_per_px: float  # scale of the video's pixels, stated or measured


def measure_video_scale(
    pictures: Iterable[Picture],
    right_pictures: Iterable[Picture],
    rest_frame: int,
    read_rig: Callable[[Size], StereoRig],
    tissue: Callable[[Size], Mask] | None = None,
) -> float:
    """Millimetres per pixel by both cameras, in the first usable frame from `rest_frame` on.

    `read_rig`, `tissue`: of pictures of a size; without tissue the picture's middle counts. UserError: there
    is no such pair of pictures, or they do not match.
    """
    usable = (p for p in pictures if p.index >= rest_frame and not p.damaged and p.time_s is not None)
    left = next(usable, None)
    right = None if left is None else next((p for p in right_pictures if p.index == left.index), None)
    if left is None or right is None:
        number = rest_frame if left is None else left.index
        raise UserError(f"right: no pair of frames {number}, by which the scale is measured")
    size = left.rgb.shape[0], left.rgb.shape[1]
    return measure_scale(read_rig(size), left.rgb, right.rgb, None if tissue is None else tissue(size))


@dataclass(frozen=True)
class DepthVideo:
    """The pictures of a depth camera and its calibration."""

    read: Callable[[FrameMotion, Size], Map | None]  # depth (H, W) mm of a frame, 0: unknown; None: missing
    K: Callable[[Size], Floats]  # (3, 3) of pictures of that size
    mm_per_px: float  # stated scale of the video's pixels


@dataclass(frozen=True)
class StereoQuality:
    """Quality of the right or depth camera, as measured over a video."""

    baseline_mm: float  # NaN for a depth camera
    epipolar_px: float  # median row error of stereo matches, at flow's resolution; NaN for a depth camera
    mm_per_px: float  # of the video's own pixels at the tissue in the rest frame, by stereo or depth
    noise_mm: float  # median stated deviation of depth motion over tissue and frames


class RightCamera:
    """Motion in three dimensions from a right camera."""

    def __init__(self, source: RightVideo, rest: RestFrame, kind: str, name: str) -> None:
        """Reads nothing yet; `kind`: of masks, one of `MASKS`; `name`: of the video, for messages."""
        self._source, self._rest, self._kind, self._name = source, rest, kind, name
        self._pictures: Iterator[Picture] = iter(source.pictures())
        self.stereo: StereoTracker | None = None  # from the rest frame on
        self._camera: CameraTracker | None = None  # motion of the right camera
        self._noise: list[float] = []
        self._pair: tuple[Pixels, Pixels] | None = None  # of the last tracked frame
        self._mask: MaskRight  # from the rest frame on

    @property
    def quality(self) -> StereoQuality | None:
        """The quality over all frames so far; None if the rest frame could not be used."""
        if self.stereo is None:
            return None
        r, rest = self.stereo.rectified, self.stereo.rest
        scale = self.stereo.distance_mm / r.focal / self._rest.shrink
        return StereoQuality(r.baseline_mm, rest.epipolar_px, scale, _median(self._noise))

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame, the rest frame first, with motion in three dimensions; lost without a right picture.

        UserError: a missing rest picture, too few or unreadable pictures, a calibration that doesn't fit.
        """
        if not frame.trusted or (right := self._read_right(frame)) is None:
            return _mark_lost(frame)
        tissue = self._rest.tissue
        masked = frame.hidden
        if self.stereo is None or self._camera is None:
            self._pair, self._mask = (frame.rgb, right), MaskRight(right, self._kind)
            hidden = self._mask.mask_rest()
            self.stereo = self._begin(frame.rgb, right, masked, hidden)
            self._camera = CameraTracker(right, self.stereo.right_tissue(), hidden)
            return replace(frame, right=right, motion=Motion3D.zeros(tissue.shape))
        # Aligning both cameras' surroundings to rest removes motion of the rig relative to the tissue.
        view = self._camera.find(right, frame.time_s) or frame.camera
        right = right if view is None else view.undo(right)
        self._pair = frame.rgb, right
        hidden = self._mask.mask(right, self.stereo.right_tissue())
        if view is not None:
            hidden |= view.outside(tissue.shape)
        motion = self.stereo.step(frame.rgb, right, masked, hidden, frame.flow, frame.confidence)
        self._noise.append(_noise(motion, tissue))
        return replace(frame, right=right, motion=motion)

    def describe(self) -> list[str]:
        """Sentences on this camera's motion, after the last frame."""
        return [] if self._camera is None else self._camera.describe(self._rest.shrink)

    def depth_mm(self) -> Map | None:
        """Depth (h, w) in the last frame, NaN where unknown, by stereo matching; None: unknown."""
        if self.stereo is None or self._pair is None:
            return None
        r, everywhere = self.stereo.rectified, np.full(self._pair[0].shape[:2], True)
        try:
            return r.unrectify(find_depth(r, *self._pair, everywhere))
        except UserError:
            return None

    def _begin(self, left: Pixels, right: Pixels, masked: Mask, hidden: Mask) -> StereoTracker:
        """Starts tracking from the rest pictures; UserError if they don't match, naming a flip that would."""
        rig, tissue = _shrink_rig(self._source.rig(self._rest.size), self._rest), self._rest.tissue
        try:
            return StereoTracker(rig, left[None], right[None], masked, hidden, tissue)
        except UserError as error:
            for flip, flipped in (("mirrored", right[:, ::-1]), ("upside down", right[::-1, ::-1])):
                try:
                    StereoTracker(
                        rig, left[None], np.ascontiguousarray(flipped)[None], masked, hidden, tissue
                    )
                except UserError:
                    continue
                raise UserError(f"{self._name}: the right camera's pictures are {flip}") from None
            raise error

    def _read_right(self, frame: FrameMotion) -> Pixels | None:
        """The right camera's picture of a frame, downsampled as the video is; None: missing."""
        for picture in self._pictures:
            if picture.index > frame.index and not frame.is_rest:
                self._pictures = chain([picture], self._pictures)
                return None
            if picture.index == frame.index:
                if picture.rgb.shape[:2] != self._rest.size:
                    raise UserError(f"{self._name}: frame {frame.index} of the right camera has another size")
                return shrink_picture(picture.rgb, self._rest.shrink)
        raise UserError(f"{self._name}: the right camera has no frame {frame.index}")


class DepthCamera:
    """Motion in three dimensions from a depth camera."""

    def __init__(self, source: DepthVideo, rest: RestFrame) -> None:
        self._source, self._rest = source, rest
        self._tracker: DepthTracker | None = None  # from the rest frame on
        self._noise: list[float] = []
        self._last: Map | None = None

    @property
    def quality(self) -> StereoQuality | None:
        """The quality over all frames so far; None if the rest frame could not be used."""
        if self._tracker is None:
            return None
        scale = self._tracker.distance_mm / float(self._tracker.K[0, 0]) / self._rest.shrink
        return StereoQuality(np.nan, np.nan, scale, _median(self._noise))

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with motion in three dimensions, see `RightCamera.process`."""
        if not frame.trusted or (depth_picture := self._source.read(frame, self._rest.size)) is None:
            return _mark_lost(frame)
        tissue, depth = self._rest.tissue, _shrink_depth(depth_picture, self._rest.shrink)
        self._last = np.where(depth > 0, depth, np.nan).astype(np.float32)
        masked = frame.hidden
        if self._tracker is None:
            K = shrink_K(self._source.K(self._rest.size), self._rest.shrink)
            self._tracker = DepthTracker(K, depth, masked, tissue)
            return replace(frame, motion=Motion3D.zeros(tissue.shape))
        motion = self._tracker.step(depth, masked, frame.flow, frame.confidence)
        self._noise.append(_noise(motion, tissue))
        return replace(frame, motion=motion)

    def depth_mm(self) -> Map | None:
        """Depth (h, w) in the last frame, NaN where unknown; None: unknown."""
        return self._last


def shrink_K(K: Floats, shrink: int) -> Floats:
    """K after averaging shrink x shrink pixels; a picture starts half a pixel before its first centre."""
    out = K / shrink
    out[:2, 2] = (K[:2, 2] + 0.5) / shrink - 0.5
    out[2] = [0, 0, 1]
    return np.asarray(out, np.float64)


def _shrink_rig(rig: StereoRig, rest: RestFrame) -> StereoRig:
    """The rig for pictures downsampled and cropped as by `shrink_picture`."""
    left, right = (
        Intrinsics(shrink_K(camera.K, rest.shrink), camera.distortion) for camera in (rig.left, rig.right)
    )
    size = (rest.size[1] // rest.shrink, rest.size[0] // rest.shrink)
    return StereoRig(left, right, rig.rotation, rig.translation, size)


def _shrink_depth(depth: Map, shrink: int) -> Map:
    """Downsampled depth (h, w) mm: the mean of known pixels, 0 where half of them are unknown."""
    known = np.isfinite(depth) & (depth > 0)
    share = shrink_picture(known.astype(np.float32), shrink)
    total = shrink_picture(np.where(known, depth, 0).astype(np.float32), shrink)
    return np.where(share > 0.5, total / np.maximum(share, 1e-6), 0).astype(np.float32)


def _mark_lost(frame: FrameMotion) -> FrameMotion:
    return replace(frame, trusted=False, motion=Motion3D.zeros(frame.confidence.shape))


def _noise(motion: Motion3D, tissue: Mask) -> float:
    return float(np.median(motion.deviation[..., 2][tissue]))


def _median(values: list[float]) -> float:
    return float(np.median(values)) if values else float("nan")
