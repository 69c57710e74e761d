"""Stages of a video that remove the camera's motion: from the pictures before flow, or from the flow."""

from __future__ import annotations

from dataclasses import replace

from synth.flow.confidence import add_deviation
from synth.flow.recording.camera_path import CameraPath, CameraTracker, Course, describe_course
from synth.flow.recording.find_pulse import average_cells
from synth.flow.recording.frame_motion import FrameMotion, RestFrame
from synth.flow.recording.shared_motion import SharedMotion


class RegisterCamera:
    """Aligns pictures with the rest frame by the motion of rigid surroundings.

    Where tissue fills the picture (`is_blind`) that motion is not known before the whole video has been
    tracked: a second pass takes the path that was found on the tissue in the first.
    """

    def __init__(self, rest: RestFrame, first: FrameMotion, path: CameraPath | None) -> None:
        """`first`: the rest frame with its masks; `path`: from a first pass."""
        self._rest, self._path = rest, path
        self._tracker = CameraTracker(rest.rgb, rest.tissue, first.hidden)
        self.is_blind = self._tracker.is_blind
        self._course: Course = []  # along the path

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with its picture as of the camera at rest."""
        if self._path is None:
            camera = self._tracker.find(frame.rgb, frame.time_s)
        elif (camera := self._path.at(time_s := frame.time_s or 0.0)) is not None:
            last = self._course[-1][1] if self._course else None
            self._course.append((time_s, camera, camera.distance_px(last, self._rest.tissue.shape)))
        return frame if camera is None else replace(frame, rgb=camera.undo(frame.rgb), camera=camera)

    def describe(self) -> list[str]:
        """Sentences on the camera's motion, after the last frame."""
        sentences = self._tracker.describe(self._rest.shrink)
        return sentences + _describe_on_tissue(self._course, self._rest)


class RegisterOnTissue:
    """Removes from the flow the camera motion that is found on the tissue, frame by frame.

    For streams whose tissue fills the picture: they have no first pass.
    """

    def __init__(self, rest: RestFrame) -> None:
        self._rest, self._shared = rest, SharedMotion(rest.tissue)

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame without camera motion in flow and picture."""
        if not frame.trusted or frame.time_s is None or frame.is_rest:
            return frame
        cells = average_cells(frame.flow, frame.confidence * self._rest.tissue)
        camera = self._shared.add(frame.time_s, *cells)
        if camera is None:
            return frame
        confidence = add_deviation(frame.confidence, camera.deviation_px)
        steady, rgb = camera.steady(frame.flow), camera.undo(frame.rgb)
        return replace(frame, flow=steady, confidence=confidence, rgb=rgb, camera=camera)

    def describe(self) -> list[str]:
        """Sentences on the camera's motion, after the last frame."""
        return _describe_on_tissue(self._shared.course, self._rest)


def _describe_on_tissue(course: Course, rest: RestFrame) -> list[str]:
    caveat = "it is estimated on tissue alone, which contacts and pulsation move too"
    return [f"{describe_course(course, rest.shrink)}; {caveat}"] if course else []
