"""Errors of recovered motion, transferred from one frame to another.

A frame of which only the truth is known gets motion as a video would show it: its true motion, plus the error
(recovered minus true) and the confidence of another frame, both aligned on the contact. Labels are cheap and
may be of any mechanics; the errors are real ones. The error's size and sign, and the confidence, are also
drawn, so that a network learns neither one estimator's shortfall nor a link between confidence and force.
Without this, one network's force for the same motion varied from 0.44 to 1.2 times the true one with
confidence alone (docs/design.md).

Shares of frames with recovered motion: true motion (`IDEAL`), an error of another frame (`TRANSFERRED`),
recovered motion (`RECOVERED`); the others have their own error with another confidence. Frames without
recovered motion have true motion, or an error of another frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from learn.network.channels import rotate

IDEAL, TRANSFERRED, RECOVERED = 0.25, 0.25, 0.25
FACTOR = 2.0  # largest factor of a transferred error, of either sign
SPREAD = 0.8  # standard deviation of the logarithm of the factor of stated deviations
LARGEST_SCALE = 3.0  # factor by which an error grows with the motion
_LEAST_MM = 0.05  # largest motion of a frame without a contact
_FAR = 0.1  # share of the largest motion; where less moves it is far from the contact


class Transfer(NamedTuple):
    """An error to transfer, and how it is changed."""

    clip: int
    frame: int
    factor: tuple[float, ...]  # of each component of the error


def draw(rng: np.random.Generator, donors: list[tuple[int, int]], components: int) -> tuple[Transfer, float]:
    """A frame out of `donors` (clip, frames of it) with factors, and the factor of the stated deviation."""
    clip, frames = donors[int(rng.integers(len(donors)))]
    factor = tuple(float(value) for value in rng.uniform(-FACTOR, FACTOR, components))
    return Transfer(clip, int(rng.integers(frames)), factor), float(np.exp(rng.normal(0, SPREAD)))


def restate(confidence: Tensor, factor: float) -> Tensor:
    """The confidence for deviations `factor` times as large, as of `learn.data.grid.certainty`."""
    return confidence / (confidence + factor**2 * (1 - confidence)).clamp_min(1e-6)


def transfer(
    true: Tensor, donor_true: Tensor, error: Tensor, confidence: Tensor, transfer: Transfer
) -> tuple[Tensor, Tensor]:
    """Motion and confidence of a frame with the error of another.

    `true`, `donor_true`, `error`: (1, C, N, N) mm; `confidence`: of the error, (1, 1 or 2, N, N) in 0..1. The
    turn or mirror image of the donor is the one whose motion, with the contacts aligned, is most like this
    frame's or most opposite to it; then the error changes sign. If one of the two frames has no contact, the
    error far from the other's contact is added where it is.
    """
    place, size = _contact(true)
    _, donor_size = _contact(donor_true)
    likeness, turn, shift, scale = 0.0, 0, (0, 0), 1.0
    if min(size, donor_size) < _LEAST_MM:
        is_far = donor_true.norm(dim=1, keepdim=True) <= max(_FAR * donor_size, _LEAST_MM)
        error, confidence = error * is_far, torch.where(is_far, confidence, 1.0)
    else:
        for trial in range(8):
            rotated = rotate(donor_true, trial)
            row, column = _contact(rotated)[0]
            offset = place[0] - row, place[1] - column
            similarity = float((_shift(rotated, offset) * true).sum())
            if abs(similarity) > abs(likeness):
                likeness, turn, shift = similarity, trial, offset
        scale = float(np.sign(likeness)) * min(size / donor_size, LARGEST_SCALE)
    factor = scale * error.new_tensor(transfer.factor).view(1, -1, 1, 1)
    planes = rotate(confidence.transpose(0, 1), turn).transpose(0, 1)
    return true + factor * _shift(rotate(error, turn), shift), _shift(planes, shift)


def _contact(motion: Tensor) -> tuple[tuple[int, int], float]:
    """Row and column of the largest motion, and its size [mm]."""
    size = motion.square().sum(1)[0]
    index = int(size.argmax())
    return divmod(index, size.shape[1]), float(size.flatten()[index].sqrt())


def _shift(values: Tensor, shift: tuple[int, int]) -> Tensor:
    """Fields shifted down and right by whole cells, 0 where nothing is known."""
    (down, right), (height, width) = shift, values.shape[2:]
    up, left = max(-down, 0), max(-right, 0)
    padded = pad(values, (max(right, 0), left, max(down, 0), up))
    return padded[..., up : up + height, left : left + width]
