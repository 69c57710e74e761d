"""A probability distribution of a force as a mixture of Gaussians, and the interval of its magnitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import ndtri, softmax

from synth.arrays import Floats, Ints

_DRAWS = 400  # by hand: 20 draws lie below a quantile of 0.05
_SURELY = 6.25  # 90% quantile of chi-squared with 3 degrees of freedom; below it 0 is in the interval


@dataclass(frozen=True, eq=False)
class ForceMixture:
    """A method's probability distribution of a force, a mixture of M Gaussians."""

    weight: Floats  # (M,) with sum 1
    force: Floats  # (M, 3), mN or, over E, mN/kPa
    covariance: Floats  # (M, 3, 3)
    world: Ints | None = None  # (M,) assumption on the tissue of each component; None: the same

    @property
    def mean(self) -> Floats:
        """(3,)."""
        return np.asarray(self.weight @ self.force, np.float64)

    @cached_property
    def draws(self) -> Floats:
        """Forces (N, 3) of the distribution, always the same."""
        weight = self.weight / self.weight.sum()
        # The sum may round to less than the last draw's place.
        indices = np.searchsorted(np.cumsum(weight)[:-1], (np.arange(_DRAWS) + 0.5) / _DRAWS)
        root = np.linalg.cholesky(self.covariance + 1e-12 * np.eye(3))
        return np.asarray(self.force[indices] + np.einsum("nab,nb->na", root[indices], _normals()[0]))

    @property
    def mean_size(self) -> float:
        """Mean of the magnitude, by the draws."""
        return float(np.linalg.norm(self.draws, axis=1).mean())

    def find_size(self, cameras: int) -> float:
        """The estimate of the magnitude: with one camera its mean, as force along the line of sight does not
        show and the mean force is without it; with two that of the mean, to which noise does not add."""
        return self.mean_size if cameras == 1 else float(np.linalg.norm(self.mean))

    def centre_at(self, mean: Floats) -> ForceMixture:
        """The distribution moved so that its mean is `mean` (3,)."""
        return replace(self, force=self.force + (mean - self.mean))

    def scale_by(self, factor: float) -> ForceMixture:
        """The distribution of forces `factor` times as large."""
        return replace(self, force=factor * self.force, covariance=factor**2 * self.covariance)

    def condition_on(self, world: int) -> ForceMixture:
        """The distribution under one assumption on the tissue."""
        component = self.world == world
        weight = np.maximum(self.weight[component], 1e-300)
        return ForceMixture(weight / weight.sum(), self.force[component], self.covariance[component])

    def with_gain(self, gain: float) -> ForceMixture:
        """The distribution with a further relative standard deviation `gain` of every force."""
        outer = np.einsum("ma,mb->mab", self.force, self.force)
        return replace(self, covariance=self.covariance + gain**2 * outer)

    def observe(self, force: Floats, covariance: Floats) -> ForceMixture:
        """The posterior after an independent estimate `force` (3,) with error `covariance` (3, 3).

        A product of Gaussians (Bishop, Pattern Recognition and Machine Learning, 2006, section 2.3).
        """
        total, difference = self.covariance + covariance, force - self.force
        correction = np.linalg.solve(total, difference[..., None])[..., 0]
        log = np.log(self.weight) - 0.5 * (
            (difference * correction).sum(axis=1) + np.linalg.slogdet(total)[1]
        )
        return replace(
            self,
            weight=softmax(log),
            force=self.force + np.einsum("mab,mb->ma", self.covariance, correction),
            covariance=self.covariance - self.covariance @ np.linalg.solve(total, self.covariance),
        )


def mix(parts: Sequence[ForceMixture], weight: Floats, worlds: Sequence[int]) -> ForceMixture:
    """The mixture of distributions with weights of sum 1, each under an assumption `worlds`."""
    return ForceMixture(
        np.concatenate([share * part.weight for share, part in zip(weight, parts, strict=True)]),
        np.concatenate([part.force for part in parts]),
        np.concatenate([part.covariance for part in parts]),
        world=np.repeat(worlds, [len(part.weight) for part in parts]),
    )


def size_interval(force: ForceMixture, gain: float, cameras: int = 2) -> tuple[float, float]:
    """90% interval of the force's magnitude, in its unit, by reproducible draws.

    It holds the interval under each assumption on the tissue, as evidence between them is not reliable.
    `gain`: relative standard deviation of all forces. It starts at 0 if 0 is in the 90% region; with one
    camera it then ends at the 98th percentile, as pressing along the optical axis hardly shows.
    """
    if force.world is not None and len(worlds := np.unique(force.world)) > 1:
        size = force.find_size(cameras)
        ends = [size_interval(force.condition_on(world), gain, cameras) for world in worlds]
        return min(size, *(low for low, _ in ends)), max(size, *(high for _, high in ends))
    size, forces = force.find_size(cameras), force.draws
    sizes = np.linalg.norm(forces, axis=1) * np.exp(gain * _normals()[1])
    spread = np.cov(forces.T) + 1e-12 * np.eye(3)
    if force.mean @ np.linalg.solve(spread, force.mean) < _SURELY:
        return 0.0, max(float(np.quantile(sizes, 0.9 if cameras == 2 else 0.98)), size)
    low, high = np.quantile(sizes, (0.05, 0.95))
    return min(float(low), size), max(float(high), size)


@lru_cache(maxsize=1)
def _normals() -> tuple[Floats, Floats]:
    rng = np.random.default_rng(0)
    return rng.normal(size=(_DRAWS, 3)), rng.permutation(ndtri((np.arange(_DRAWS) + 0.5) / _DRAWS))
