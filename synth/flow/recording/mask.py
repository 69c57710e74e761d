"""A stage of a video: masks of instruments, highlights and other foreground, detected or given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from synth.arrays import Mask, Pixels
from synth.flow.lookalike import Lookalikes
from synth.flow.recording.frame_motion import FrameMotion, RestFrame, Size
from synth.flow.recording.picture_faults import find_fault
from synth.flow.rest_evidence import RestEvidence
from synth.flow.segmentation import Segmentation, segment
from synth.video.read_video import shrink_mask

_MAX_HIDDEN = 0.4  # share of the tissue: more of it is taken for tissue that looks like instruments


class MaskFrame:
    """Masks what hides the tissue."""

    def __init__(
        self,
        rest: RestFrame,
        kind: str,
        tool: Callable[[int, Size], Mask | None] | None,
        expected: Callable[[int, Size], Mask | None] | None = None,
        lookalikes: Mask | None = None,
    ) -> None:
        """`kind`: one of `MASKS`; `tool`: the given instrument masks, see `Footage`; None: detected;
        `expected`: where, see `Footage`; `lookalikes`: likewise."""
        self._rest, self._kind, self._tool, self._expected = rest, kind, tool, expected
        self._evidence: RestEvidence | None = None  # from the rest frame on
        self._lookalikes: Lookalikes | None = None
        if lookalikes is not None and lookalikes.any():
            self._lookalikes = Lookalikes(rest.rgb, _resize_mask(lookalikes, rest.tissue.shape))

    def process(self, frame: FrameMotion) -> FrameMotion:
        """The frame with its masks; it is not trusted if its picture shows nothing that could be tracked."""
        trusted = frame.trusted and not find_fault(frame.rgb, self._rest.tissue)
        masked = tool = np.zeros(frame.rgb.shape[:2], bool)
        if self._kind != "none":
            segmentation = segment(self._rest.rgb, frame.rgb)
            if self._tool is None:
                if self._lookalikes is not None:
                    segmentation = self._lookalikes.remove(segmentation, frame.rgb)
                classes = self._weigh(segmentation, frame)
                if frame.is_rest:
                    self._evidence = RestEvidence(self._rest.rgb, segmentation)
                elif self._evidence is not None:
                    segmentation = self._evidence.weigh(segmentation, frame.rgb)
                # Shadows change the picture too: with their odds raised, instruments are taken for hands.
                masked = _select_hidden(self._weigh(segmentation, frame), self._rest.tissue)
                tool = classes.objects
            else:
                tool_mask = self._tool(frame.index, self._rest.size)
                tool = tool if tool_mask is None else shrink_mask(tool_mask, self._rest.shrink, 0)
                if frame.camera is not None:
                    tool = frame.camera.undo(tool.astype(np.uint8) * 255) > 127
                masked = tool | segmentation.glare
        if frame.camera is not None:
            masked = masked | frame.camera.outside(masked.shape)
        return replace(frame, masked=masked, tool=tool, trusted=trusted)

    def _weigh(self, segmentation: Segmentation, frame: FrameMotion) -> Segmentation:
        """The classes of a frame, instruments more likely where they are expected."""
        expected = None if self._expected is None else self._expected(frame.index, self._rest.size)
        if expected is None:
            return segmentation
        expected = shrink_mask(expected, self._rest.shrink, 0)
        if frame.camera is not None:
            expected = frame.camera.undo(expected.astype(np.uint8) * 255) > 127
        return segmentation.expect(expected)


class MaskRight:
    """Masks what hides the tissue in pictures of the right camera."""

    def __init__(self, rest: Pixels, kind: str) -> None:
        """Starts with its rest picture (h, w, 3) uint8; `kind`: one of `MASKS`."""
        self._rest, self._kind = rest, kind
        if kind != "none":
            self._at_rest = segment(rest, rest)
            self._evidence = RestEvidence(rest, self._at_rest)

    def mask_rest(self) -> Mask:
        """Mask (h, w) of its rest picture."""
        full_mask = np.ones(self._rest.shape[:2], bool)
        return ~full_mask if self._kind == "none" else _select_hidden(self._at_rest, full_mask)

    def mask(self, rgb: Pixels, tissue: Mask) -> Mask:
        """Mask (h, w) of a later picture (h, w, 3); `tissue`: (h, w), in its rest picture."""
        if self._kind == "none":
            return np.zeros(tissue.shape, bool)
        return _select_hidden(self._evidence.weigh(segment(self._rest, rgb), rgb), tissue)


def _resize_mask(mask: Mask, size: tuple[int, ...]) -> Mask:
    resized = cv2.resize(mask.astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized > 0)


def _select_hidden(segmentation: Segmentation, tissue: Mask) -> Mask:
    """What is hidden; the highlights alone if so much of the tissue is that it is taken for instruments."""
    hidden = segmentation.hidden
    return hidden if (hidden & tissue).sum() <= _MAX_HIDDEN * tissue.sum() else segmentation.glare
