"""A picture of a recording's tracking, for `bench check`."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from synth.arrays import Mask
from synth.flow.confidence import LOW_CONFIDENCE
from synth.publish.picture import Rgb, arrow_gain, arrows, framed, legible, overlay, tile
from synth.recording_flow.frame_motion import FrameMotion

_COUNT = 5
_TISSUE, _MASKED = (60, 230, 90), (230, 40, 220)
_LEGEND = "green: tissue; magenta: masked; arrows: trusted motion"


def draw_tracking(frames: Sequence[FrameMotion], tissue: Mask, shrink: int) -> Rgb:
    """The rest frame, the frame with the largest motion and three others, in order: (H, W, 3).

    Args:
        frames: the rest frame first.
        tissue: (h, w) of the rest frame.
        shrink: factor by which the frames are smaller than the video; lengths are in the video's pixels.
    """
    trusted = [tissue & (one.confidence > LOW_CONFIDENCE) for one in frames]
    lengths = [np.linalg.norm(one.flow, axis=-1) * where for one, where in zip(frames, trusted, strict=True)]
    most = [float(np.percentile(length[tissue], 99)) for length in lengths]
    strongest = int(np.argmax(most))
    others = [k for k in range(1, len(frames)) if k != strongest]
    between = [others[k] for k in np.linspace(0, len(others) - 1, min(_COUNT - 2, len(others))).astype(int)]
    gain, panels = arrow_gain(2 * tissue.shape[1], max(most)), []
    for k in sorted({0, strongest, *between}):
        frame, picture = frames[k], legible(frames[k].rgb)
        hidden = frame.masked if k else frames[strongest].rest_masked
        times = picture.shape[1] // tissue.shape[1]
        outline, moving, masked = (
            legible(np.asarray(one, np.uint8)[..., None])[..., 0] > 0
            for one in (tissue, trusted[k], np.zeros_like(tissue) if hidden is None else hidden)
        )
        picture = overlay(picture, np.full_like(picture, 255), 0.3 * outline)
        picture = overlay(picture, np.full_like(picture, _MASKED), 0.5 * masked)
        edges = cv2.findContours(outline.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
        cv2.drawContours(picture, edges, -1, _TISSUE, 2)
        flow = times * frame.flow.repeat(times, axis=0).repeat(times, axis=1)
        picture = arrows(picture, flow, moving, gain)
        time = "" if frame.time_s is None else f", {frame.time_s:.2f} s"
        caption = f"{most[k] * shrink:.1f} px at most, arrows x{gain}" if k else "rest frame"
        caption = caption if frame.trusted else "tracking lost"
        panels.append(framed(picture, f"frame {frame.index}{time}: {caption}"))
    legend = framed(np.full_like(picture, 255), _LEGEND)
    return tile([*panels, legend])
