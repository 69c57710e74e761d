"""The flow of a stored sequence recovered anew, by another estimator, on a grid."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from learn.data.clips import Clip
from learn.data.grid import Grid, Resampler, centre
from synth.dataset.store import Sequence
from synth.flow.estimator import Estimator
from synth.flow.track import track


def recover_flow(
    sequence: Sequence, clip: Clip, estimator: str | Estimator, blocked: NDArray[np.bool_], grid: Grid
) -> tuple[Clip, float]:
    """The clip with the flow that an estimator recovers, and the CPU time of the flow over all frames [s].

    Args:
        sequence: rendered, with `rgb` and `tissue`.
        clip: of the sequence on `grid`.
        estimator: or its name.
        blocked: (T, H, W) what is masked: tool, glare.
        grid: of the clip.
    """
    tissue = sequence["tissue"][:].astype(bool)
    scale = float(sequence.attrs["scale_mm_per_px"])
    resample = Resampler((tissue.shape[0], tissue.shape[1]), scale, centre(tissue), grid)
    moved, confidence = np.zeros_like(clip.displacement["ideal"]), np.ones_like(clip.confidence)
    rgb, began = sequence["rgb"][: clip.frames], time.process_time()
    followed = track(estimator, rgb, blocked[: clip.frames], tissue)
    spent = time.process_time() - began
    for t in range(1, clip.frames):
        moved[t] = resample.mean(followed.flow[t].transpose(2, 0, 1) * scale, tissue) * clip.mask
        confidence[t] = resample.mean(followed.confidence[t], tissue) * clip.mask
    found = {**clip.displacement, "recovered": moved}
    return replace(clip, displacement=found, confidence=confidence), spent
