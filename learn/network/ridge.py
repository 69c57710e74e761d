"""A linear map from motion to force on a coarse grid, the best one with a penalty on its square.

What a network has to be better than: force in linear elasticity is linear in motion, and ridge regression
(Hoerl and Kennard 1970) is the linear map that best fits the training data. It has a closed form.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from learn.network.shape import LinearShape


class LinearMap(nn.Module):
    """(B, C of `shape.channels`, N, N) → (B, 1|3, N, N) force map in units of `Scales.target`."""

    def __init__(self, shape: LinearShape) -> None:
        super().__init__()
        self.shape = shape
        blocks = shape.cells**2
        self.linear = nn.Linear(shape.displacements * blocks, shape.components * blocks, bias=False)
        nn.init.zeros_(self.linear.weight)

    def forward(self, x: Tensor) -> Tensor:
        cells = self.shape.cells
        y = self.linear(self.pool(x[:, self.shape.axes]))
        y = y.unflatten(1, (self.shape.components, cells, cells))
        y = F.interpolate(y, size=x.shape[2:], mode="bilinear", align_corners=False) * x[:, 3:4]
        return y if self.shape.components > 1 else F.relu(y)

    def pool(self, fields: Tensor) -> Tensor:
        """Means of fields (B, K, N, N) over the blocks, (B, K blocks)."""
        return F.avg_pool2d(fields, fields.shape[-1] // self.shape.cells).flatten(1)


@torch.no_grad()
def solve(network: LinearMap, batches: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Sets the weights to the ridge regression of the targets (B, 1|3, N, N) on the inputs (B, C, N, N)."""
    from sklearn.linear_model import Ridge  # of the extra `bench`

    pairs = [(network.pool(x[:, network.shape.axes]), network.pool(y)) for x, y in batches]
    motion, force = (torch.cat(parts).cpu().double().numpy() for parts in zip(*pairs, strict=True))
    penalty = network.shape.strength * float(np.square(motion).sum(0).mean())
    regression = Ridge(alpha=penalty, fit_intercept=False).fit(motion, force)
    weight = torch.from_numpy(np.atleast_2d(regression.coef_)).to(network.linear.weight)
    network.linear.weight.copy_(weight)
