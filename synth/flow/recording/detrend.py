"""The last stage of a video: pulsation of the tissue, found in a first pass and subtracted in a second."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from synth.flow.recording.find_pulse import PulseEstimate, PulseSearch, SurfaceMotion, find_pulse
from synth.flow.recording.frame_motion import FrameMotion, RestFrame
from synth.flow.recording.harmonic_fit import Span
from synth.flow.recording.shared_motion import find_path


class GatherMotion:
    """Gathers the motion of the tissue in a first pass, in which pulsation is then searched."""

    def __init__(self, rest: RestFrame, mm_per_px: float) -> None:
        """`mm_per_px`: of the flow's pixels, for motion in three dimensions; without it not used."""
        self._rest, self._mm_per_px = rest, np.float32(mm_per_px)
        self._surface = SurfaceMotion(rest.tissue)
        self._depth_weights: list[float] = []

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The same frame."""
        if not frame.trusted or frame.is_rest:
            return frame
        assert frame.time_s is not None
        parts, motion = [frame.flow], frame.motion
        if motion is not None:
            # The search uses the flow, because lateral motion in mm has the noise of depth.
            parts += [motion.motion[..., 2:] / self._mm_per_px, motion.motion[..., :2] / self._mm_per_px]
            lateral, axial = (float(np.median(motion.deviation[..., k][self._rest.tissue])) for k in (0, 2))
            self._depth_weights.append(lateral / max(axial, 1e-9))
        self._surface.add(frame.time_s, np.dstack(parts), frame.confidence)
        return frame

    def search(self, free_s: Sequence[Span], fills_picture: bool, may_pulsate: bool = True) -> PulseSearch:
        """Pulsation of the tissue if it `may_pulsate`, see `find_pulse`, and the camera's motion if tissue
        `fills_picture`."""
        surface = self._surface
        if self._depth_weights:
            surface.depth_weight = min(1.0, float(np.median(self._depth_weights)))
        first_s = surface.time_s[0] if surface.time_s else 0.0
        rest_s = first_s if self._rest.time_s is None else self._rest.time_s
        no_search = PulseSearch(None, np.zeros(0), None, is_living=False)
        pulse_search = find_pulse(surface, rest_s, free_s) if may_pulsate else no_search
        if not fills_picture:
            return pulse_search
        return replace(pulse_search, camera=find_path(surface, pulse_search.pulse))


class Detrend:
    """Subtracts pulsation that is known from the whole video."""

    def __init__(self, pulse: PulseEstimate, mm_per_px: float) -> None:
        """`mm_per_px`: as for `GatherMotion`."""
        self.pulse, self._mm_per_px = pulse, np.float32(mm_per_px)

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame without pulsation in flow and motion."""
        if frame.is_rest or frame.time_s is None:
            return frame
        pulsation, motion = self.pulse.at(frame.time_s), frame.motion
        if motion is not None and frame.trusted:
            motion = replace(motion, motion=motion.motion - pulsation[..., [3, 4, 2]] * self._mm_per_px)
        return replace(frame, flow=frame.flow - pulsation[..., :2], motion=motion)
