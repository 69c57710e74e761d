"""Displacement summed over short steps, as the paper does it: here only to be compared, for it drifts."""

from __future__ import annotations

import cv2
import numpy as np

from synth.flow.estimator import Estimator, Flags, Flow, Map, Rgb, create


class ChainTracker:
    """Like `Tracker`, but each frame is registered to a key frame, itself registered to the one before.

    `every` = 1 is frame to frame (Heraoui et al.); larger values are key frames.
    """

    def __init__(
        self, backend: str | Estimator, rest: Rgb, rest_blocked: Flags, tissue: Flags, every: int = 1
    ) -> None:
        """Starts at rest. Arguments as of `Tracker`; every: frames between key frames."""
        self.estimator = create(backend) if isinstance(backend, str) else backend
        self.tissue, self.every = tissue, every
        self._key, self._key_usable = rest, tissue & ~rest_blocked
        self._to_key: Flow = np.zeros((*tissue.shape, 2), np.float32)
        self._since: Flow | None = None
        self._age = 0

    def step(self, frame: Rgb, blocked: Flags) -> tuple[Flow, Map]:
        """Flow (H, W, 2) px from the rest frame and confidence (H, W) of the last step."""
        step, confidence = self.estimator.flow(self._key, frame, self._key_usable, ~blocked, self._since)
        flow = compose(self._to_key, step)
        self._since, self._age = step, self._age + 1
        if self._age == self.every:
            self._key, self._key_usable, self._to_key = frame, ~blocked, flow
            self._since, self._age = None, 0
        return flow * self.tissue[..., None], confidence * self.tissue


def compose(first: Flow, second: Flow) -> Flow:
    """Flow of one step after another: w(x) + s(x + w(x)), (H, W, 2) px. Bicubic, the border replicated."""
    height, width = first.shape[:2]
    x = np.arange(width, dtype=np.float32) + first[..., 0]
    y = np.arange(height, dtype=np.float32)[:, None] + first[..., 1]
    moved = cv2.remap(second, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(first + moved, np.float32)
