"""What training minimises: squared error, R², and a heavier price for force where there is none.

Everything here is in physical units. Prediction and target are force density at a reference stiffness of
1 kPa [mN/mm²], and so are the two numbers of the training data that come along: `unit`, the target's 99.9th
percentile, says what a low force is; `spread`, its root mean square over tissue cells, is what errors are
divided by. The squared-error and the R² term then are of one size and their weights mean what they say. (In
the published code the squared error is in (3 N)², about 1e-4, and R² takes nearly all of the gradient.)

Why another loss against ghosts (`hinge`): a squared price, times three or not, fades with the ghost itself,
so it moves large ghosts a little and small ones not at all. The hinge's price is linear: where the best guess
in the mean would be q (in `spread`s) on tissue that is free with probability p, it says q − p·weight/2, or
nothing. Cells that are surely in contact (p = 0) aren't touched. What it costs in R² falls on weak presses,
whose whole map is of the size of that price; `r2_scope` `frame` gives it back: each frame's error is then
measured against the frame's own force, so a weak press weighs as much as a strong one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from synth.errors import UserError
from synth.job.types import NonNegative, Section, Share


class Objective(Section):
    """Which loss, and its weights.

    `antighost` (squared error, dearer where a low force is over-predicted, and R²), `hinge` (squared error,
    R² and a linear price of force on contact-free tissue), `published` (as `antighost`, with the published
    code's R² that is blind to bias), `mse`, `mae`, `huber`.
    """

    kind: Literal["antighost", "hinge", "mse", "mae", "huber", "published"] = "antighost"
    r2_weight: Share = 0.3
    """Share of the R² term; the rest is the squared error. (Heraoui et al.: 0.3.)"""
    r2_scope: Literal["batch", "frame"] = "batch"
    """Over what SSE/SST is taken: the whole batch, as published, or each frame, then their mean."""
    ghost_weight: NonNegative = 3.0
    """Price of a squared over-prediction where the true force is low. (Heraoui et al.: 3.)"""
    low: NonNegative = 0.05
    """A force is low under this share of `unit`."""
    rule: Literal["pixel", "frame"] = "pixel"
    """`pixel`: low where the pixel's own force is; `frame`: in frames whose mean over the tissue is, as
    the published code has it (true for nearly every frame: a contact covers little of the picture)."""
    stray_weight: NonNegative = 8.0
    """`hinge`: price of the mean force density on contact-free tissue [mN/mm²], in units of `spread`."""
    stray_cap: NonNegative = 0.0
    """`hinge`: share of `unit` from which on more force on contact-free tissue costs no more; 0 is none. The
    rim of a strong contact, where the best guess is well above it, then isn't pulled down."""
    ramp: tuple[NonNegative, NonNegative] = (0.25, 0.75)
    """`hinge`: shares of the run between which the price grows from none to full. Paid from the start it is
    cheapest to say nothing, and a network learns that first."""
    free: NonNegative = 0.01
    """`hinge`: tissue is contact-free where its true density is under this share of `unit`."""
    total_weight: NonNegative = 0.0
    """Weight of the squared error of the map's total force, in units of the training data's largest."""
    head_weight: NonNegative = 0.3
    """The same of the total-force head, for a network that has one."""


GHOSTLESS = Objective(kind="hinge", r2_weight=0.5, r2_scope="frame", stray_weight=8.0)
"""What took the ghosts away at no cost in R² (docs/results/learn): its weights were chosen there."""

FRAMEWISE = Objective(kind="hinge", r2_weight=0.5, r2_scope="frame", stray_weight=0.0)
"""Squared error and every frame's own R², in equal parts, and no price of ghosts: for vectors."""


def at(objective: Objective, progress: float) -> Objective:
    """The objective at a point 0..1 of the run."""
    start, full = objective.ramp
    share = min(max((progress - start) / max(full - start, 1e-9), 0.0), 1.0)
    return objective.model_copy(update={"stray_weight": objective.stray_weight * share})


def full(objective: Objective, progress: float) -> bool:
    """Whether nothing of the objective is still to come at a point 0..1 of the run."""
    return objective.kind != "hinge" or objective.stray_weight == 0 or progress >= objective.ramp[1]


SHARES = ("error", "r2", "ghost", "total")
"""The terms that act on the map."""


@dataclass(frozen=True)
class Terms:
    """The parts of the loss, dimensionless, already weighted; they add up to it."""

    error: Tensor
    r2: Tensor
    ghost: Tensor
    total: Tensor
    head: Tensor

    @property
    def sum(self) -> Tensor:
        return self.error + self.r2 + self.ghost + self.total + self.head


def loss(
    prediction: Tensor,
    target: Tensor,
    mask: Tensor,
    objective: Objective,
    unit: float,
    spread: float,
    cell_mm2: float = 1.0,
    force_unit: float = 1.0,
    totals: tuple[Tensor, Tensor] | None = None,
) -> Terms:
    """The objective over all masked cells of a batch.

    `prediction`, `target`: (B, C, N, N) mN/mm² at 1 kPa; `mask`: (B, 1, N, N) 0/1; `unit`, `spread`: the same
    unit; `cell_mm2`: area of a cell; `force_unit`: mN at 1 kPa; `totals`: (B, C) of the total-force head
    and its
    truth, mN at 1 kPa. Raises UserError if the mask is empty.
    """
    cells = mask.sum()
    if cells == 0:
        raise UserError("a batch without a single tissue cell has no loss")
    error = (prediction - target) / spread * mask
    squared = error.square().sum(1, keepdim=True)
    zero = squared.new_zeros(())
    count = cells * prediction.shape[1]
    if objective.kind == "mse":
        fit, share = squared.sum() / count, 0.0
    elif objective.kind == "mae":
        fit, share = error.abs().sum() / count, 0.0
    elif objective.kind == "huber":
        fit, share = (
            torch.nn.functional.huber_loss(error, zero.expand_as(error), reduction="sum") / count,
            0.0,
        )
    else:
        dear = objective.kind != "hinge"
        weight = ghost_weights(prediction, target, mask, objective, unit) if dear else 1.0
        fit, share = (squared * weight).sum() / count, objective.r2_weight
    r2 = zero
    if share > 0:
        blind, whole = objective.kind == "published", objective.r2_scope == "batch"
        r2 = unexplained(prediction, target, mask, spread, bias_blind=blind, by_frame=not whole)
        if objective.kind == "published":
            r2 = r2.clamp(max=1.0)
    ghost = zero
    if objective.kind == "hinge":
        free, cap = objective.free * unit, objective.stray_cap * unit
        ghost = objective.stray_weight * stray(prediction, target, mask, free, cap) / spread
    total, head = zero, zero
    if objective.total_weight > 0:
        gap = ((prediction - target) * mask).sum((2, 3)) * cell_mm2 / force_unit
        total = objective.total_weight * gap.square().sum(1).mean()
    if totals is not None:
        said, true = totals
        head = objective.head_weight * ((said - true) / force_unit).square().sum(1).mean()
    return Terms((1 - share) * fit, share * r2, ghost, total, head)


def stray(prediction: Tensor, target: Tensor, mask: Tensor, free: float, cap: float = 0.0) -> Tensor:
    """Mean over tissue of the force density, at most `cap` (0: any), said where the true one is under `free`.

    `prediction`, `target`: (B, C, N, N), `free` and `cap` in their unit, as is what is returned; `mask`:
    (B, 1, N, N) 0/1. Without a cap, times the tissue's area, it is the force [mN at 1 kPa] that the answer
    puts where nothing touches.
    """
    loose = mask * (_length(target) < free)
    said = _length(prediction).abs()
    return ((said.clamp_max(cap) if cap > 0 else said) * loose).sum() / mask.sum()


def ghost_weights(
    prediction: Tensor, target: Tensor, mask: Tensor, objective: Objective, unit: float
) -> Tensor:
    """(B, 1, N, N): `ghost_weight` where force is over-predicted and low, 1 elsewhere.

    A vector is over-predicted where it is longer than the true one.
    """
    said, true = _length(prediction.detach()), _length(target)
    if objective.rule == "pixel":
        low = true < objective.low * unit
    else:
        mean = (true * mask).sum((1, 2, 3)) / mask.sum((1, 2, 3)).clamp_min(1)
        low = (mean < objective.low * unit).view(-1, 1, 1, 1)
    ghost = low & (said > true)
    return torch.where(ghost, objective.ghost_weight, 1.0)


def unexplained(
    prediction: Tensor,
    target: Tensor,
    mask: Tensor,
    spread: float,
    *,
    bias_blind: bool = False,
    by_frame: bool = False,
) -> Tensor:
    """1 − R² = SSE/SST over the batch's masked cells, each component about its own mean.

    `by_frame` takes the ratio frame by frame and then their mean. `bias_blind` takes the variance of the
    residual instead of SSE, as the published code does: an offset everywhere then costs nothing. What holds
    hardly any force is measured against a tenth of the training data's mean square, so that rest frames don't
    divide by zero.
    """
    over = (2, 3) if by_frame else (0, 2, 3)
    cells = mask.sum(over)
    t = target / spread * mask
    e = (prediction - target) / spread * mask
    count = cells.clamp_min(1)
    sst = t.square().sum(over) - t.sum(over).square() / count
    sse = e.square().sum(over)
    if bias_blind:
        sse = sse - e.sum(over).square() / count
    least = 0.1 * cells.sum(-1).clamp_min(1) * prediction.shape[1]
    return (sse.sum(-1) / sst.sum(-1).clamp_min(least)).mean()


def gradient_shares(terms: Terms, prediction: Tensor) -> dict[str, float]:
    """How much of the gradient on the map each of its terms gives: norms over their sum.

    Must be called before `backward` frees the graph.
    """
    norms: dict[str, float] = {}
    for name in SHARES:
        term = getattr(terms, name)
        if term.requires_grad:
            (g,) = torch.autograd.grad(term, prediction, retain_graph=True, allow_unused=True)
            norms[name] = 0.0 if g is None else float(g.norm())
        else:
            norms[name] = 0.0
    whole = sum(norms.values()) or 1.0
    return {k: v / whole for k, v in norms.items()}


def _length(values: Tensor) -> Tensor:
    """(B, C, …) → (B, 1, …): the value itself for one component, else the vector's length."""
    if values.shape[1] == 1:
        return values
    # A little inside the root: the gradient of a length at zero is not a number.
    return (values.square().sum(1, keepdim=True) + 1e-20).sqrt()
