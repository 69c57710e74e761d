"""The second eye of a recording, or its depth camera, beside the flow: motion in three dimensions a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bench.recording.folder import Recording
from synth.errors import UserError
from synth.flow import mask
from synth.flow.stereo import calibration
from synth.flow.stereo.depth_camera import DepthTracker
from synth.flow.stereo.rig import Eye, Floats, StereoRig
from synth.flow.stereo.track import Moved, StereoTracker
from synth.recording_flow.pulse import Pulse, Search
from synth.recording_flow.video_flow import Step, VideoFlow, shrink_picture
from synth.system import checked_file
from synth.video.read import Picture

Flags = NDArray[np.bool_]
_LARGEST_BYTES = 1 << 30  # of an array of points
LATE = 0.22
"""Share of the motion that the second eye doesn't show from which on it is of another moment."""
_MOVED_PX = 0.5  # less says nothing of when


@dataclass(frozen=True)
class Sight:
    """What the second eye is good for, for `bench check` and the report."""

    baseline_mm: float
    """NaN of a depth camera."""
    epipolar_px: float
    """Median distance of what matches from its row, on the pictures that flow is computed on; NaN: none."""
    mm_per_px: float
    """What a pixel of the recording spans at the tissue in the rest frame, by the second eye."""
    noise_mm: float
    """Median deviation of depth motion over the tissue, and over the frames looked at."""
    lag: float = 0.0
    """Share of the motion that the second eye doesn't show, exceeded in a tenth of the frames that moved: its
    pictures are of another moment. 0 for a depth camera, which can't tell."""

    def describe(self) -> str:
        """A line for a person."""
        noise = f"depth motion is known to ± {self.noise_mm:.2g} mm"
        if np.isnan(self.baseline_mm):
            return f"a depth camera; {noise}"
        rows = f"rows {self.epipolar_px:.2g} px off"
        if self.lag > LATE:
            rows += f", {100 * self.lag:.0f}% of the motion at another moment than the left eye's"
        return f"a second eye {self.baseline_mm:.3g} mm to the right, {rows}; {noise}"


@dataclass(frozen=True, eq=False)
class OwnMotion:
    """The tissue's own motion, heart and breath, as the flow and as both eyes have it."""

    flow: Pulse
    """[px]."""
    space: Pulse | None
    """[mm]; None without a second eye."""
    search: Search
    """What came of looking for it."""

    def describe(self, mm_per_px: float) -> str:
        """See `Pulse.describe`."""
        return (self.space or self.flow).describe(mm_per_px)

    def rhythms(self, mm_per_px: float) -> list[dict[str, float]]:
        """rate_hz and amplitude_mm of each."""
        seen = self.space or self.flow
        return [
            {"rate_hz": rhythm.rate_hz, "amplitude_mm": mm_per_px * size}
            for rhythm, size in zip(seen.rhythms, seen.amplitudes_px, strict=True)
        ]


class SecondEye:
    """Follows the steps of a `VideoFlow`, each once and in order."""

    def __init__(self, recording: Recording, video: VideoFlow, own: OwnMotion | None = None) -> None:
        """Nothing is read yet. `own`: taken off, as its flow's part is in the video's flow."""
        self._recording, self._video, self._own = recording, video, own
        self._stereo: StereoTracker | None = None
        self._depth: DepthTracker | None = None
        self._rights: Iterator[Picture] = iter(recording.right_frames()) if recording.right else iter(())
        self._noise: list[float] = []
        self._lags: list[float] = []

    @property
    def sight(self) -> Sight | None:
        """What it came to, once steps are through; None where the rest frame showed nothing."""
        noise = float(np.median(self._noise)) if self._noise else float("nan")
        if self._stereo is None:
            if self._depth is None:
                return None
            away, focal = self._depth.distance_mm, float(self._depth.K[0, 0])
            scale = away / focal / self._video.shrink
            return Sight(float("nan"), float("nan"), scale, noise)
        lag = float(np.percentile(self._lags, 90)) if self._lags else 0.0
        r, rest = self._stereo.rectified, self._stereo.rest
        scale = self._stereo.distance_mm / r.focal / self._video.shrink
        return Sight(r.baseline_mm, rest.epipolar_px, scale, noise, lag)

    def move(self, step: Step) -> Moved:
        """Motion of a frame since rest; the first step is the rest frame.

        Raises:
            UserError: the second eye has no such frame, or can't be read; a calibration that isn't its own.
        """
        found, tissue = step.found, self._video.tissue
        if not found.trusted:
            # Nothing was followed: no method's answer counts there.
            return Moved.nothing(tissue.shape)
        blocked, flow, time_s = _or_none(found.blocked, tissue), found.flow, step.picture.time_s
        own = None if time_s is None or found.is_rest else self._own
        if own is not None and time_s is not None:
            # Where the tissue is now, not where it would be if it lay still, is where to look.
            flow = flow + own.flow.at(time_s)
        if self._recording.right:
            right = self._right(step.picture.index)
            if self._stereo is None:
                self._stereo = self._begin(step, right, blocked)
                return Moved.nothing(tissue.shape)
            moved = self._stereo.step(
                step.picture.rgb, right, blocked, self._hidden(right, blocked), flow, found.confidence
            )
            if np.percentile(np.abs(flow[tissue]), 98) > _MOVED_PX:
                self._lags.append(abs(self._stereo.lag))
        else:
            depth = self._depths(step.picture.index)
            if self._depth is None:
                self._depth = DepthTracker(self._K(), depth, blocked, tissue)
                return Moved.nothing(tissue.shape)
            moved = self._depth.step(depth, blocked, flow, found.confidence)
        self._noise.append(float(np.median(moved.deviation[..., 2][tissue])))
        if own is not None and own.space is not None and time_s is not None:
            moved = replace(moved, motion=moved.motion - own.space.at(time_s))
        return moved

    def _begin(self, step: Step, right: NDArray[np.uint8], blocked: Flags) -> StereoTracker:
        about, folder = self._recording.meta.stereo, self._recording.folder
        assert about is not None
        height, width = self._video.size
        rig = calibration.read_rig(folder / about.calibration, (width, height), about.mm_per_unit)
        left = step.picture.rgb
        return StereoTracker(
            shrunk(rig, self._video.shrink),
            left[None],
            right[None],
            blocked,
            self._hidden(right, blocked),
            self._video.tissue,
        )

    def _hidden(self, right: NDArray[np.uint8], left: Flags) -> Flags:
        return _hidden(right, self._video.settings.masks, left)

    def _right(self, index: int) -> NDArray[np.uint8]:
        """The second eye's frame of that number, shrunk as the video's."""
        for picture in self._rights:
            if picture.index == index:
                if picture.rgb.shape[:2] != self._video.size:
                    raise UserError(
                        f"{self._recording.folder}: the right eye's frame {index} is of another size"
                    )
                return shrink_picture(picture.rgb, self._video.shrink)
        raise UserError(f"{self._recording.folder}: the right eye has no frame {index}")

    def _K(self) -> Floats:
        about, shrink = self._recording.meta.depth, self._video.shrink
        assert about is not None
        height, width = self._video.size
        x, y = about.centre_px or ((width - 1) / 2, (height - 1) / 2)
        K = np.array([[about.focal_px, 0, x], [0, about.focal_px, y], [0, 0, 1.0]])
        return _smaller(K, shrink)

    def _depths(self, index: int) -> NDArray[np.float32]:
        """Depth (h, w) mm of a frame; of points their third coordinate."""
        recording, about = self._recording, self._recording.meta.depth
        assert about is not None
        if index >= len(recording.depths):
            raise UserError(f"{recording.folder}: depth/ has no frame {index}")
        path = recording.depths[index]
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
        if found.ndim != 2 or found.shape != self._video.size or found.dtype.kind not in "uif":
            raise UserError(f"{path}: {found.shape} {found.dtype}, but the video is {self._video.size}")
        depth = found.astype(np.float32) * np.float32(about.mm_per_unit)
        known = np.isfinite(depth) & (depth > 0)
        share = _shrunk(known.astype(np.float32), self._video.shrink)
        total = _shrunk(np.where(known, depth, 0).astype(np.float32), self._video.shrink)
        return np.where(share > 0.5, total / np.maximum(share, 1e-6), 0).astype(np.float32)


def shrunk(rig: StereoRig, shrink: int) -> StereoRig:
    """The same pair with pictures `shrink` times smaller, cut as `shrink_picture` cuts them."""
    left, right = (Eye(_smaller(eye.K, shrink), eye.distortion) for eye in (rig.left, rig.right))
    size = (rig.size[0] // shrink, rig.size[1] // shrink)
    return StereoRig(left, right, rig.rotation, rig.translation, size)


def _smaller(K: Floats, shrink: int) -> Floats:
    """K of pictures whose pixels hold shrink x shrink of the old: a picture begins half a pixel early."""
    out = K / shrink
    out[:2, 2] = (K[:2, 2] + 0.5) / shrink - 0.5
    out[2] = [0, 0, 1]
    return np.asarray(out, np.float64)


def _shrunk(field: NDArray[np.float32], shrink: int) -> NDArray[np.float32]:
    height, width = (side // shrink for side in field.shape)
    cut = field[: height * shrink, : width * shrink]
    return np.asarray(cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA), np.float32)


def _hidden(rgb: NDArray[np.uint8], kind: str, left: Flags) -> Flags:
    """(H, W) tool and glare as the right eye's picture alone shows them: nobody said where they are.

    `kind`: one of `video_flow.MASKS`; of `auto`, only where something proved worth masking in the left eye's.
    """
    nothing = np.zeros(rgb.shape[:2], bool)
    if kind == "none" or (kind == "auto" and not left.any()):
        return nothing
    glare = nothing if kind == "tool" else mask.glare(rgb)
    return glare if kind == "glare" else glare | mask.tool(rgb)


def _or_none(blocked: Flags | None, tissue: Flags) -> Flags:
    return np.zeros_like(tissue) if blocked is None else blocked
