"""The published method's labels, noise and all, beside the truth: to train in its regime and compare.

After D3MIA/SOFA-NeuroSim-Recorder (`simlib/recorders.py`, `modify_frames_with_noise.py`), whose points are a
mesh's vertices and here are the pixels of tissue. First stage: every force label gets normal noise. Second
stage: in a share of the frames, points away from the contact get a displacement of their own and the label 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.geometry.triangles import lengths
from synth.job.schema import Labels

Map = NDArray[np.float32]
Mask = NDArray[np.bool_]

_ENDS, _MOST_FRAMES = 10, 50  # a tenth of the sequence, at most 50 frames, is left alone at either end
_NEAR, _LEAST_REACH = 1.5, 0.05  # the contact's surroundings: 1.5 times its reach, at least 5% of the picture
_LOW = 30  # percentile of force below which a point may be disturbed


def intensity(traction: NDArray[np.floating], force_mn: float) -> NDArray[np.float64]:
    """The published label: the load scaled so that its largest value is the total force.

    Args:
        traction: (H, W, 3) kPa.
        force_mn: size of the total force.

    Returns:
        (H, W, 3) mN, in the axes of `traction`.
    """
    peak = float(lengths(traction).max(initial=0.0))
    return np.asarray(traction, np.float64) * (force_mn / peak if peak > 0 else 0.0)


def with_noise(
    label: NDArray[np.float64], tissue: Mask, noise: Labels, rng: np.random.Generator
) -> NDArray[np.float64]:
    """First stage: normal noise on the labels (H, W, 3) mN of the tissue (H, W)."""
    out = np.zeros_like(label)
    mine = label[tissue]
    deviation = noise.force_std_mn + noise.force_share * lengths(mine)[:, None]
    deviation = np.where(rng.random((len(mine), 1)) < noise.outliers, noise.outlier_scale, 1.0) * deviation
    out[tissue] = mine + deviation * rng.normal(size=mine.shape) + noise.force_bias_mn
    return out


def noisy_frames(frames: int, noise: Labels, rng: np.random.Generator) -> Mask:
    """Second stage: which frames it disturbs, (T,)."""
    ends = min(_MOST_FRAMES, frames // _ENDS)
    candidates = np.arange(ends, frames - ends)
    count = min(int(frames * noise.noisy_frames), len(candidates))
    chosen = np.zeros(frames, bool)
    chosen[rng.choice(candidates, count, replace=False)] = True
    return chosen


def disturbed(
    flow: Map, label: NDArray[np.float64], tissue: Mask, noise: Labels, rng: np.random.Generator
) -> tuple[Map, NDArray[np.float64]]:
    """Second stage, in one frame.

    Args:
        flow: (H, W, 2) px.
        label: (H, W) mN.
        tissue: (H, W).
        noise: how many points, and how far as a part of the frame's range of displacement.
        rng: of this sequence's labels.

    Returns:
        Flow and label with some points disturbed.
    """
    flow, label = flow.copy(), label.copy()
    place = np.argwhere(tissue)
    force = label[tissue]
    free = force <= np.percentile(force, _LOW) if len(force) else np.zeros(0, bool)
    pressed = place[force > np.percentile(force, 90)] if force.max(initial=0) > 0 else place[:0]
    if len(pressed):
        centre = pressed.mean(axis=0)
        reach = _NEAR * np.linalg.norm(pressed - centre, axis=1).max()
        reach = max(reach, _LEAST_REACH * float(np.linalg.norm(np.ptp(place, axis=0))))
        free &= np.linalg.norm(place - centre, axis=1) > reach
    candidates = np.flatnonzero(free)
    count = min(int(len(place) * noise.noisy_points), len(candidates))
    rows, columns = place[rng.choice(candidates, count, replace=False)].T if count else place[:0].T
    span = noise.noisy_range * np.ptp(flow[tissue], axis=0) if len(place) else np.zeros(2)
    flow[rows, columns] += (rng.uniform(-1, 1, (count, 2)) * span).astype(np.float32)
    label[rows, columns] = 0.0
    return flow, label


@dataclass(frozen=True)
class Published:
    """Both stages for one sequence; frames are asked for in order."""

    noise: Labels
    tissue: Mask
    """(H, W)."""
    chosen: Mask
    """(T,) frames that the second stage disturbs."""
    rng: np.random.Generator

    @classmethod
    def begin(cls, noise: Labels, tissue: Mask, frames: int, rng: np.random.Generator) -> Published:
        """Draws which frames will be disturbed; `tissue` is (H, W)."""
        return cls(noise, tissue, noisy_frames(frames, noise, rng), rng)

    def frame(
        self, t: int, flow: Map, traction: NDArray[np.floating], force_mn: NDArray[np.float64]
    ) -> dict[str, Map]:
        """The fields `flow_noisy` (H, W, 2) px and `intensity` (H, W) mN of frame t.

        Args:
            t: the frame; 0, the rest frame, has no noise: what is measured is measured from it.
            flow: (H, W, 2) px, the truth.
            traction: (H, W, 3) kPa, the truth.
            force_mn: (3,) total force.
        """
        label = intensity(traction, float(np.linalg.norm(force_mn)))
        if t > 0:
            label = with_noise(label, self.tissue, self.noise, self.rng)
        size = lengths(label)
        if self.chosen[t] and t > 0:
            flow, size = disturbed(flow, size, self.tissue, self.noise, self.rng)
        return {"flow_noisy": flow, "intensity": size.astype(np.float32)}
