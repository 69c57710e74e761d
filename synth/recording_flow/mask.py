"""A stage of a video: mask proposals for instruments and highlights of each frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from synth.arrays import Mask, Pixels
from synth.flow import mask_detection
from synth.flow.mask_selection import Proposal
from synth.recording_flow.frame_motion import FrameMotion, RestFrame, Size
from synth.recording_flow.picture_faults import find_fault
from synth.video.read import shrink_mask


class ProposeMasks:
    """Proposes masks, from pictures or from given masks; flow selects among them."""

    def __init__(self, rest: RestFrame, kind: str, tool: Callable[[int, Size], Mask | None] | None) -> None:
        """`kind`: one of `MASKS`; `tool`: the given instrument masks, see `Footage`; None: detected."""
        self._rest, self._kind, self._tool = rest, kind, tool

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with proposals; it is not trusted if its picture shows nothing that could be tracked."""
        trusted = frame.trusted and not find_fault(frame.rgb, self._rest.tissue)
        return replace(frame, proposal=self._propose(frame), trusted=trusted)

    def _propose(self, frame: FrameMotion) -> Proposal:
        glare = tool = known = nothing = np.zeros(frame.rgb.shape[:2], bool)
        if self._kind != "none":
            glare = mask_detection.glare(frame.rgb)
            if self._tool is None:
                tool = mask_detection.tool(frame.rgb)
            elif (given := self._tool(frame.index, self._rest.size)) is not None:
                known = shrink_mask(given, self._rest.shrink, 0)
        if frame.camera is not None:
            if known.any():
                known = frame.camera.undo(known.astype(np.uint8) * 255) > 127
            known = known | frame.camera.outside(known.shape)
        if self._kind == "auto":
            return Proposal(glare, tool, known)
        return Proposal(nothing, nothing, glare | tool | known)


def mask_right(rgb: Pixels, kind: str, left: Mask) -> Mask:
    """Mask (H, W) of tool and highlights in the right picture; `auto`: none if the left picture has none."""
    if kind == "none" or (kind == "auto" and not left.any()):
        return np.zeros(rgb.shape[:2], bool)
    return mask_detection.blocked(rgb)
