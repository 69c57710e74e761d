"""Labels as in the published method, with its noise, stored next to the ground truth for comparison.

After D3MIA/SOFA-NeuroSim-Recorder (`simlib/recorders.py`, `modify_frames_with_noise.py`), whose points are a
mesh's vertices and here are the pixels of tissue. First stage, with a job's `labels: published`: normal noise
on every force label. Second stage: in a share of the frames, points away from the contact get a random
displacement and the label 0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from synth.arrays import Floats, Map, Mask
from synth.geometry.triangles import lengths

_FORCE_SHARE = 0.02  # standard deviation of the first stage's noise, as a share of a label
_FRAMES = 0.3  # share of the frames that the second stage disturbs
_POINTS = 0.05  # share of the tissue's pixels disturbed in such a frame
_RANGE = 0.05  # largest disturbance, as a share of the frame's range of displacement
_ENDS, _MOST_FRAMES = 10, 50  # a tenth of the sequence, at most 50 frames, stays undisturbed at either end
_NEAR, _LEAST_REACH = 1.5, 0.05  # the contact's surroundings: 1.5 times its reach, at least 5% of the picture
_LOW = 30  # percentile of force below which a point may be disturbed


def intensity(traction: NDArray[np.floating], force_mn: float) -> Floats:
    """The published label (H, W, 3) mN of a traction (H, W, 3) kPa, in its axes: scaled so that its largest
    value is the size of the total force, `force_mn`."""
    peak = float(lengths(traction).max(initial=0.0))
    return np.asarray(traction, np.float64) * (force_mn / peak if peak > 0 else 0.0)


def add_noise(label: Floats, tissue: Mask, share: float, rng: np.random.Generator) -> Floats:
    """First stage: normal noise, a `share` of each label (H, W, 3) mN, on those of the tissue (H, W)."""
    out = np.zeros_like(label)
    values = label[tissue]
    rng.random((len(values), 1))  # the published code draws outliers too, of which its example has none
    out[tissue] = values + share * lengths(values)[:, None] * rng.normal(size=values.shape)
    return out


def disturb(flow: Map, label: Floats, tissue: Mask, rng: np.random.Generator) -> tuple[Map, Floats]:
    """Second stage, in one frame: flow (H, W, 2) px and label (H, W) mN with some points disturbed."""
    flow, label = flow.copy(), label.copy()
    positions = np.argwhere(tissue)
    force = label[tissue]
    free = force <= np.percentile(force, _LOW) if len(force) else np.zeros(0, bool)
    contact = positions[force > np.percentile(force, 90)] if force.max(initial=0) > 0 else positions[:0]
    if len(contact):
        centre = contact.mean(axis=0)
        reach = _NEAR * np.linalg.norm(contact - centre, axis=1).max()
        reach = max(reach, _LEAST_REACH * float(np.linalg.norm(np.ptp(positions, axis=0))))
        free &= np.linalg.norm(positions - centre, axis=1) > reach
    candidates = np.flatnonzero(free)
    count = min(int(len(positions) * _POINTS), len(candidates))
    rows, columns = positions[rng.choice(candidates, count, replace=False)].T if count else positions[:0].T
    span = _RANGE * np.ptp(flow[tissue], axis=0) if len(positions) else np.zeros(2)
    flow[rows, columns] += (rng.uniform(-1, 1, (count, 2)) * span).astype(np.float32)
    label[rows, columns] = 0.0
    return flow, label


class PublishedLabels:
    """Both stages for one sequence; frames must be processed in order."""

    def __init__(self, labels: str, tissue: Mask, frames: int, rng: np.random.Generator) -> None:
        """Draws the frames to disturb; `labels` is the job's key, `tissue` (H, W)."""
        ends = min(_MOST_FRAMES, frames // _ENDS)
        candidates = np.arange(ends, frames - ends)
        count = min(int(frames * _FRAMES), len(candidates))
        self._disturbed = set(rng.choice(candidates, count, replace=False).tolist())
        self._share = _FORCE_SHARE if labels == "published" else 0.0
        self._tissue, self._rng = tissue, rng

    def frame(self, t: int, flow: Map, traction: NDArray[np.floating], force_mn: Floats) -> dict[str, Map]:
        """The fields `flow_noisy` (H, W, 2) px and `intensity` (H, W) mN of frame t.

        From the true flow, traction (H, W, 3) kPa and total force (3,). The rest frame has no noise, as all
        motion is measured from it.
        """
        label = intensity(traction, float(np.linalg.norm(force_mn)))
        if t > 0:
            label = add_noise(label, self._tissue, self._share, self._rng)
        size = lengths(label)
        if t in self._disturbed and t > 0:
            flow, size = disturb(flow, size, self._tissue, self._rng)
        return {"flow_noisy": flow, "intensity": size.astype(np.float32)}
