"""What training minimises: squared error, R², and a price of background force.

Everything here is in physical units. Prediction and target are force density at a reference stiffness of
1 kPa [mN/mm²], and so are the two numbers of the training data that come along: `unit`, the target's 99.9th
percentile, says what a low force is; `spread`, its root mean square over tissue cells, is what errors are
divided by. The squared-error and the R² term then are of one size and their weights mean what they say. (In
the published code the squared error is in (3 N)², about 1e-4, and R² takes nearly all of the gradient.)

Why another loss against false background force, the "ghosts" (`off-target`): a squared price, times three or
not, fades with the ghost itself, so it moves large ones a little and small ones not at all. A linear price
does: where the best guess in the mean would be q (in `spread`s) on tissue that is free with probability p, it
says q − p·BACKGROUND/2, or nothing. Cells that are surely in contact (p = 0) aren't touched. What it costs in
R² falls on weak presses, whose whole map is of the size of that price; R² by frame gives it back: an error is
then measured against its frame's own force, so a weak press weighs as much as a strong one.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from torch import Tensor

from synth.errors import UserError

Loss = Literal["mse", "mse-frame", "antighost", "off-target"]
"""`mse`: squared error. `mse-frame`: squared error and every frame's own 1 − R², in equal parts. `antighost`:
of Heraoui et al., squared error, dearer where a low force is over-predicted, and 1 − R² of the batch.
`off-target`: `mse-frame` and a linear price of force on contact-free tissue, which took the ghosts away at no
cost in R² (docs/results/learn): its numbers were chosen there."""

R2_SHARE = {"mse": 0.0, "mse-frame": 0.5, "antighost": 0.3, "off-target": 0.5}
"""Share of the R² term; the rest is the squared error. (Heraoui et al.: 0.3.)"""
FALSE_POSITIVE = 3.0
"""`antighost`: price of a squared over-prediction where the true force is low. (Heraoui et al.: 3.)"""
LOW = 0.05
"""`antighost`: a cell's force is low under this share of `unit`. (Heraoui et al. ask the frame's mean.)"""
BACKGROUND = 8.0
"""`off-target`: price of the mean force density on contact-free tissue [mN/mm²], in units of `spread`."""
FREE = 0.01
"""`off-target`: tissue is contact-free where its true density is under this share of `unit`."""
RAMP = (0.25, 0.75)
"""`off-target`: shares of the run between which the price grows from none to full. Paid from the start it is
cheapest to say nothing, and a network learns that first."""


def full(kind: Loss, progress: float) -> bool:
    """Whether nothing of the loss is still to come at a point 0..1 of the run."""
    return kind != "off-target" or progress >= RAMP[1]


SHARES = ("error", "r2", "ghost")
"""Names of the terms of the loss, as in history.jsonl."""


class Terms(NamedTuple):
    """The parts of the loss, dimensionless, already weighted; they add up to it."""

    error: Tensor
    r2: Tensor
    background: Tensor

    @property
    def sum(self) -> Tensor:
        return self.error + self.r2 + self.background


def loss(
    prediction: Tensor,
    target: Tensor,
    mask: Tensor,
    kind: Loss,
    unit: float,
    spread: float,
    progress: float = 1.0,
) -> Terms:
    """The loss over all masked cells of a batch, at a point 0..1 of the run.

    `prediction`, `target`: (B, C, N, N) mN/mm² at 1 kPa; `mask`: (B, 1, N, N) 0/1; `unit`, `spread`: the same
    unit. Raises UserError if the mask is empty.
    """
    cells = mask.sum()
    if cells == 0:
        raise UserError("a batch without a single tissue cell has no loss")
    squared = ((prediction - target) / spread * mask).square().sum(1, keepdim=True)
    if kind == "antighost":
        squared = squared * false_positive_weights(prediction, target, unit)
    fit, share = squared.sum() / (cells * prediction.shape[1]), R2_SHARE[kind]
    r2 = background = squared.new_zeros(())
    if share > 0:
        r2 = unexplained(prediction, target, mask, spread, by_frame=kind != "antighost")
    if kind == "off-target":
        price = BACKGROUND * min(max((progress - RAMP[0]) / (RAMP[1] - RAMP[0]), 0.0), 1.0)
        background = price * background_force(prediction, target, mask, FREE * unit) / spread
    return Terms((1 - share) * fit, share * r2, background)


def background_force(prediction: Tensor, target: Tensor, mask: Tensor, free: float) -> Tensor:
    """Mean over tissue of the force density predicted where the true one is under `free`.

    `prediction`, `target`: (B, C, N, N), `free` in their unit, as is what is returned; `mask`: (B, 1, N, N)
    0/1. Times the tissue's area it is the force [mN at 1 kPa] that the answer puts where nothing touches.
    """
    loose = mask * (_length(target) < free)
    return (_length(prediction).abs() * loose).sum() / mask.sum()


def false_positive_weights(prediction: Tensor, target: Tensor, unit: float) -> Tensor:
    """(B, 1, N, N): `FALSE_POSITIVE` where force is over-predicted and low, 1 elsewhere.

    A vector is over-predicted where it is longer than the true one.
    """
    predicted, true = _length(prediction.detach()), _length(target)
    return torch.where((true < LOW * unit) & (predicted > true), FALSE_POSITIVE, 1.0)


def unexplained(
    prediction: Tensor, target: Tensor, mask: Tensor, spread: float, *, by_frame: bool = False
) -> Tensor:
    """1 − R² = SSE/SST over the batch's masked cells, each component about its own mean.

    `by_frame` takes the ratio frame by frame and then their mean. What holds hardly any force is measured
    against a tenth of the training data's mean square, so that rest frames don't divide by zero.
    """
    over = (2, 3) if by_frame else (0, 2, 3)
    cells = mask.sum(over)
    t = target / spread * mask
    e = (prediction - target) / spread * mask
    count = cells.clamp_min(1)
    sst = t.square().sum(over) - t.sum(over).square() / count
    least = 0.1 * cells.sum(-1).clamp_min(1) * prediction.shape[1]
    return (e.square().sum(over).sum(-1) / sst.sum(-1).clamp_min(least)).mean()


def gradient_shares(terms: Terms, prediction: Tensor) -> dict[str, float]:
    """How much of the gradient on the map each of its terms gives: norms over their sum.

    Must be called before `backward` frees the graph.
    """
    norms = dict.fromkeys(SHARES, 0.0)
    for name, term in zip(SHARES, terms, strict=True):
        if term.requires_grad:
            (g,) = torch.autograd.grad(term, prediction, retain_graph=True, allow_unused=True)
            norms[name] = 0.0 if g is None else float(g.norm())
    total = sum(norms.values()) or 1.0
    return {name: norm / total for name, norm in norms.items()}


def _length(values: Tensor) -> Tensor:
    """(B, C, …) → (B, 1, …): the value itself for one component, else the vector's length."""
    if values.shape[1] == 1:
        return values
    # A little inside the root: the gradient of a length at zero is not a number.
    return (values.square().sum(1, keepdim=True) + 1e-20).sqrt()
