"""A video as the network wants it: displacement of the tissue from the first frame, recovered as it is
decoded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from synth.errors import UserError
from synth.flow import mask
from synth.flow.track import Tracker

SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm")

Step = tuple[NDArray[np.float32], NDArray[np.float32] | None]
"""Flow (H, W, 2) px from the rest frame, and its confidence (H, W) 0..1 if there is one."""


def pictures(path: Path) -> Iterator[NDArray[np.uint8]]:
    """(H, W, 3) uint8 sRGB frames. Raises UserError for a file that is no video or holds no frame."""
    count = 0
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise UserError(f"{path}: holds no video stream")
            for frame in container.decode(container.streams.video[0]):
                yield np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), frame.rotation // 90))
                count += 1
    except (av.error.FFmpegError, OSError) as error:
        # A film cut off in the middle is good up to there.
        if count == 0:
            raise UserError(f"{path}: not a readable video ({error})") from None
    if count == 0:
        raise UserError(f"{path}: holds no frames")


def tissue(path: Path, file: Path | None) -> NDArray[np.bool_]:
    """(H, W) where the film shows tissue: white in the picture `file`; without one everywhere.

    Raises UserError if the picture can't be read, marks nothing or is of another size than the film.
    """
    first = next(pictures(path))
    if file is None:
        return np.ones(first.shape[:2], bool)
    drawn = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    if drawn is None:
        raise UserError(f"{file}: not a readable picture")
    if drawn.shape != first.shape[:2]:
        raise UserError(
            f"{file}: {drawn.shape[1]} x {drawn.shape[0]}, {path.name} is {first.shape[1]} x {first.shape[0]}"
        )
    if not (drawn > 127).any():
        raise UserError(f"{file}: marks no tissue")
    return np.asarray(drawn > 127)


def steps(path: Path, where: NDArray[np.bool_], backend: str) -> Iterator[Step]:
    """Flow and confidence of every frame; the first is the rest frame.

    `where`: (H, W) tissue; `backend`: estimator, as in a job's flow.backend. Raises UserError for an unknown
    estimator.
    """
    tracker: Tracker | None = None
    for rgb in pictures(path):
        blocked = mask.blocked(rgb)
        if tracker is None:
            tracker = Tracker(backend, rgb, blocked, where)
            yield np.zeros((*where.shape, 2), np.float32), (where & ~blocked).astype(np.float32)
        else:
            flow, confidence = tracker.step(rgb, blocked)
            yield flow.astype(np.float32), confidence.astype(np.float32)
