"""Second stage of a video: mask proposals for instruments and highlights of each frame."""

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
        rgb, nothing = frame.rgb, np.zeros(frame.rgb.shape[:2], bool)
        glare = nothing if self._kind in ("none", "tool") else mask_detection.glare(rgb)
        tool = known = nothing
        if self._kind not in ("none", "glare"):
            if self._tool is None:
                tool = mask_detection.tool(rgb)
            elif (given := self._tool(frame.index, self._rest.size)) is not None:
                known = shrink_mask(given, self._rest.shrink, 0)
                if frame.camera is not None:
                    known = frame.camera.undo(known.astype(np.uint8) * 255) > 127
        if frame.camera is not None:
            known = known | frame.camera.outside(known.shape)
        if self._kind == "auto":
            return Proposal(glare, tool, known)
        return Proposal(nothing, nothing, glare | tool | known)


def mask_right(rgb: Pixels, kind: str, left: Mask) -> Mask:
    """Mask (H, W) of tool and specular highlights, detected in the right picture.

    `kind`: one of `MASKS`; with `auto` nothing is masked unless something is masked in the left picture.
    """
    nothing = np.zeros(rgb.shape[:2], bool)
    if kind == "none" or (kind == "auto" and not left.any()):
        return nothing
    glare = nothing if kind == "tool" else mask_detection.glare(rgb)
    return glare if kind == "glare" else glare | mask_detection.tool(rgb)
