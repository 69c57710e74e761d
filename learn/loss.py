"""Training losses: squared error, R², and a penalty on off-target force.

`unit`, `total` and `spread` are constants of the training data: the 99.9th percentiles of the target and of
its sum over a frame, against which a cell's and a frame's force are low, and the target's root mean square
over tissue cells, by which errors are divided so that the squared-error and the R² term are of similar size.
(In the published code R² takes nearly all of the gradient.)

Off-target force is force on contact-free tissue. Heraoui et al. weight its squared error more, in frames of
a low mean force (`antighost-frame`); `antighost` does so in cells of a low force, in any frame. The gradient
of a square fades with the false force, so small ones remain. `off-target` adds a linear penalty: with squared
error alone, where the conditional mean is q (in units of `spread`) on tissue that is free with probability p,
the minimum is at q − p·OFF_TARGET/2, at least 0. It costs R² on weak presses, whose forces are of its size;
R² by frame makes up for that, as it divides an error by its own frame's force.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from synth.errors import UserError

if TYPE_CHECKING:  # settings name a loss without PyTorch: only methods of tensors are used below
    from torch import Tensor

FALSE_POSITIVE = 3.0  # weight of squared over-prediction of a low force (Heraoui et al.)
LOW = 0.05  # `antighost`: a cell's force is low under this share of `unit`
LOW_FRAME = 0.025  # `antighost-frame`: a frame's, under this share of `total` (theirs: 0.05 of 2 N)
OFF_TARGET = 8.0  # `off-target`: weight of the mean off-target force density, in units of `spread`
FREE = 0.01  # `off-target`: tissue is contact-free where its true density is under this share of `unit`
RAMP = (0.25, 0.75)
"""`off-target`: shares of the run between which the penalty grows from zero to full. At full weight from the
start a network first learns to predict no force."""


@dataclass(frozen=True)
class Frames:
    """Predicted and true maps of a batch, in physical units, and the constants of the training data."""

    prediction: Tensor  # (B, C, N, N) mN/mm² at 1 kPa, as the next
    target: Tensor
    mask: Tensor  # (B, 1, N, N) 0/1
    unit: float  # mN/mm²
    spread: float  # mN/mm²
    total: float  # mN/mm², of a sum over cells
    progress: float = 1.0  # point 0..1 of the run

    def square_errors(self) -> Tensor:
        """Squared error of each cell over `spread`, summed over components, (B, 1, N, N)."""
        return ((self.prediction - self.target) / self.spread * self.mask).square().sum(1, keepdim=True)

    def mean(self, values: Tensor, components: int = 1) -> Tensor:
        """Mean over the masked cells, and over components whose sum is (B, 1, N, N) `values`."""
        return values.sum() / (self.mask.sum() * components)


def mse(frames: Frames) -> Tensor:
    """Squared error."""
    return frames.mean(frames.square_errors(), frames.prediction.shape[1])


def mse_frame(frames: Frames) -> Tensor:
    """Squared error and 1 − R² of each frame, in equal parts."""
    by_frame = measure_unexplained(
        frames.prediction, frames.target, frames.mask, frames.spread, by_frame=True
    )
    return 0.5 * mse(frames) + 0.5 * by_frame


def antighost(frames: Frames) -> Tensor:
    """Squared error, weighted more where the low force of a cell is over-predicted, and three tenths of the
    batch's 1 − R²."""
    return _weigh_over_predicted(frames, _length(frames.target) < LOW * frames.unit)


def antighost_frame(frames: Frames) -> Tensor:
    """As `antighost`, for all cells of a frame whose total force is low: equation 4 of Heraoui et al."""
    total = (_length(frames.target) * frames.mask).sum((1, 2, 3), keepdim=True)
    return _weigh_over_predicted(frames, total < LOW_FRAME * frames.total)


def _weigh_over_predicted(frames: Frames, low: Tensor) -> Tensor:
    over_predicted = low & (_length(frames.prediction.detach()) > _length(frames.target))
    weighed = frames.square_errors() * (1 + (FALSE_POSITIVE - 1) * over_predicted)
    error = frames.mean(weighed, frames.prediction.shape[1])
    return 0.7 * error + 0.3 * measure_unexplained(
        frames.prediction, frames.target, frames.mask, frames.spread
    )


def off_target(frames: Frames) -> Tensor:
    """`mse_frame` and a linear penalty on off-target force, with constants chosen in docs/results/learn."""
    fit = mse_frame(frames)
    weight = OFF_TARGET * min(max((frames.progress - RAMP[0]) / (RAMP[1] - RAMP[0]), 0.0), 1.0)
    contact_free = frames.mask * (_length(frames.target) < FREE * frames.unit)
    penalty = weight * frames.mean(_length(frames.prediction).abs() * contact_free) / frames.spread
    return fit + penalty


@dataclass(frozen=True)
class Loss:
    """A training loss."""

    of: Callable[[Frames], Tensor]
    full_from: float = 0.0  # share of the run from which it has its full weights


LOSSES = {
    "mse": Loss(mse),
    "mse-frame": Loss(mse_frame),
    "antighost": Loss(antighost),
    "antighost-frame": Loss(antighost_frame),
    "off-target": Loss(off_target, RAMP[1]),
}
"""All losses by their names in the settings of a training."""


def is_full(name: str, progress: float) -> bool:
    """Whether a loss has its full weights at a point 0..1 of the run."""
    return progress >= LOSSES[name].full_from


def loss(
    prediction: Tensor,
    target: Tensor,
    mask: Tensor,
    name: str,
    unit: float,
    spread: float,
    total: float,
    progress: float = 1.0,
) -> Tensor:
    """The loss of a name over all masked cells of a batch; arguments as of `Frames`.

    Raises UserError if the mask is empty.
    """
    if mask.sum() == 0:
        raise UserError("a batch has no tissue cell: check the tissue masks")
    return LOSSES[name].of(Frames(prediction, target, mask, unit, spread, total, progress))


def measure_unexplained(
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
