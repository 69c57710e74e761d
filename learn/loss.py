"""Training losses: squared error, R², and a penalty on off-target force.

`unit` and `spread` are constants of the training data: the target's 99.9th percentile, against which a force
is low, and its root mean square over tissue cells, by which errors are divided so that the squared-error and
the R² term are of similar size. (In the published code R² takes nearly all of the gradient.)

Off-target force is force on contact-free tissue. Heraoui et al. weight its squared error more (`antighost`),
but the gradient of a square fades with the false force, so small ones remain. `off-target` adds a linear
penalty: with squared error alone, where the conditional mean is q (in units of `spread`) on tissue that is
free with probability p, the minimum is at q − p·OFF_TARGET/2, at least 0. It costs R² on weak presses, whose
forces are of its size; R² by frame makes up for that, as it divides an error by its own frame's force.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from synth.errors import UserError

Loss = Literal["mse", "mse-frame", "antighost", "off-target"]
"""`mse`: squared error. `mse-frame`: squared error and 1 − R² of each frame, in equal parts. `antighost`
(name and loss of Heraoui et al.): squared error, weighted more where a low force is over-predicted, and 1 −
R² of the batch. `off-target`: `mse-frame` and a linear penalty on off-target force, with constants chosen in
docs/results/learn."""
R2_SHARE = {"mse": 0.0, "mse-frame": 0.5, "antighost": 0.3, "off-target": 0.5}
"""Weight of the R² term; the squared error has the rest. (Heraoui et al.: 0.3.)"""
FALSE_POSITIVE = 3.0  # `antighost`: weight of squared over-prediction of a low force (Heraoui et al.: 3)
LOW = 0.05  # `antighost`: a low force is under this share of `unit` (Heraoui et al. compare the frame's mean)
OFF_TARGET = 8.0  # `off-target`: weight of the mean off-target force density, in units of `spread`
FREE = 0.01  # `off-target`: tissue is contact-free where its true density is under this share of `unit`
RAMP = (0.25, 0.75)
"""`off-target`: shares of the run between which the penalty grows from zero to full. At full weight from the
start a network first learns to predict no force."""


def full(kind: Loss, progress: float) -> bool:
    """Whether the loss has its full weights at a point 0..1 of the run."""
    return kind != "off-target" or progress >= RAMP[1]


def loss(
    prediction: Tensor,
    target: Tensor,
    mask: Tensor,
    kind: Loss,
    unit: float,
    spread: float,
    progress: float = 1.0,
) -> Tensor:
    """The loss over all masked cells of a batch, at a point 0..1 of the run.

    `prediction`, `target`: (B, C, N, N) mN/mm² at 1 kPa; `mask`: (B, 1, N, N) 0/1; `unit`, `spread`: in
    mN/mm² too. Raises UserError if the mask is empty.
    """
    cells = mask.sum()
    if cells == 0:
        raise UserError("a batch has no tissue cell: check the tissue masks")
    squared = ((prediction - target) / spread * mask).square().sum(1, keepdim=True)
    if kind == "antighost":
        low = _length(target) < LOW * unit
        over_predicted = low & (_length(prediction.detach()) > _length(target))
        squared = squared * torch.where(over_predicted, FALSE_POSITIVE, 1.0)
    fit, share = squared.sum() / (cells * prediction.shape[1]), R2_SHARE[kind]
    r2 = off_target = squared.new_zeros(())
    if share > 0:
        r2 = unexplained(prediction, target, mask, spread, by_frame=kind != "antighost")
    if kind == "off-target":
        weight = OFF_TARGET * min(max((progress - RAMP[0]) / (RAMP[1] - RAMP[0]), 0.0), 1.0)
        contact_free = mask * (_length(target) < FREE * unit)
        off_target = weight * ((_length(prediction).abs() * contact_free).sum() / cells) / spread
    return (1 - share) * fit + share * r2 + off_target


def unexplained(
    prediction: Tensor, target: Tensor, mask: Tensor, spread: float, *, by_frame: bool = False
) -> Tensor:
    """1 − R² = SSE/SST over the batch's masked cells, each component about its own mean.

    `by_frame`: the mean of the frames' ratios. SST is at least a tenth of the training data's mean square.
    """
    over = (2, 3) if by_frame else (0, 2, 3)
    cells = mask.sum(over)
    t = target / spread * mask
    e = (prediction - target) / spread * mask
    count = cells.clamp_min(1)
    sst = t.square().sum(over) - t.sum(over).square() / count
    least = 0.1 * cells.sum(-1).clamp_min(1) * prediction.shape[1]
    return (e.square().sum(over).sum(-1) / sst.sum(-1).clamp_min(least)).mean()


def _length(values: Tensor) -> Tensor:
    """(B, C, …) → (B, 1, …): the value itself for one component, else the vector's length."""
    if values.shape[1] == 1:
        return values
    # The small constant keeps the gradient of a zero length finite.
    return (values.square().sum(1, keepdim=True) + 1e-20).sqrt()
