"""What simpler methods say, fitted on the same sequences as the network.

All look at the same grid of displacement in millimetres, divided by nothing and normalised by nothing but E:
for a linear solid, force over E is a function of displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD
from sklearn.linear_model import Ridge
from sklearn.model_selection import PredefinedSplit, cross_val_predict
from sklearn.neighbors import KNeighborsRegressor

from bench.methods.protocol import Field, ForceEstimate, Method, MethodContext
from learn.data.clips import assumed_young, has_depth
from learn.data.grid import Grid, GridView, certainty
from synth.errors import UserError
from synth.flow.stereo.track import Moved

if TYPE_CHECKING:
    from learn.data.clips import Clip

Floats = NDArray[np.float64]
Rule = Callable[[Field, Field, Field], Floats]
"""Displacement (2, N, N) mm, mask (N, N) 0/1, confidence (N, N) → force over E, (3,) mN/kPa; NaN: magnitude
only, in x. Of two eyes (3, N, N) mm and (2, N, N), across and along the view."""

RIDGE = "ridge on PCA of flow"
"""The one that needs data."""
GRID = Grid(48)
_COMPONENTS = 20
_NEIGHBOURS = 5


class Baseline:
    """A rule behind the bench's protocol."""

    def __init__(self, rule: Rule, in_space: bool = False) -> None:
        """`in_space`: whether the rule reads motion in three dimensions."""
        self._rule, self._space = rule, in_space
        self._view: tuple[MethodContext, GridView] | None = None

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        if self._space:
            raise UserError("fitted on motion in three dimensions: it needs a second eye or depth pictures")
        return self._answer(flow * np.float32(scene.scale_mm_per_px), confidence, scene)

    def in_space(
        self, flow: Field, confidence: Field, moved: Moved, scene: MethodContext, picture: bool
    ) -> ForceEstimate:
        """See `Uses3D`."""
        if not self._space:
            return self(flow, confidence, scene, picture)
        return self._answer(moved.motion, certainty(moved.deviation), scene)

    def _answer(self, shift: Field, sure: Field, scene: MethodContext) -> ForceEstimate:
        """Of displacement (H, W, C) mm and its confidence ([2,] H, W)."""
        if self._view is None or self._view[0] is not scene:
            self._view = scene, GridView(scene.tissue, scene.scale_mm_per_px, GRID)
        view = self._view[1]
        mean = view.resample.mean
        given = mean(shift.transpose(2, 0, 1), scene.tissue), view.mask, mean(sure, scene.tissue)
        return ForceEstimate(assumed_young(scene.young_kpa) * self._rule(*given))


def as_methods(rules: Mapping[str, Rule], source: str) -> dict[str, Method]:
    """Rules fitted on a displacement `source`, behind the bench's protocol."""
    return {name: Baseline(rule, has_depth(source)) for name, rule in rules.items()}


def fitted_rules(clips: Sequence[Clip], source: str) -> dict[str, Rule]:
    """Those fitted on sequences: the network's own fit sequences, for a fair table.

    Args:
        clips: on `GRID`.
        source: which displacement, `recovered` or `ideal`, of two eyes `motion` or `motion-ideal`.
    """
    moved = np.concatenate([clip.displacement[source] for clip in clips])
    mask = np.concatenate([np.broadcast_to(clip.mask, (clip.frames, *clip.mask.shape)) for clip in clips])
    force = np.concatenate([clip.force / clip.young_kpa for clip in clips])
    rows = _rows(moved, mask)
    # Not centred: no motion stays zero.
    basis = TruncatedSVD(min(_COMPONENTS, min(rows.shape) - 1), algorithm="arpack", random_state=0).fit(rows)
    features = basis.transform(rows)
    strengths, fold = np.geomspace(1e-4, 1e2, 13), _groups(clips) % 4
    return {RIDGE: partial(_say_regressed, basis, ridge(features, force, fold, strengths))}


# A rule is a part of a function that has a name, so that what is fitted can be kept in a file.


def _rows(moved: Field, mask: Field) -> Floats:
    """(T, C, N, N) mm, (T, N, N) → masked displacement, (T, C N N)."""
    return (moved * mask[:, None]).reshape(len(moved), -1).astype(np.float64)


def _say_regressed(
    basis: TruncatedSVD,
    regressor: Ridge,
    moved: Field,
    mask: Field,
    sure: Field,
) -> Floats:
    said = regressor.predict(basis.transform(_rows(moved[None], mask[None])))
    return np.asarray(said[0], np.float64)


def ridge(
    x: Floats,
    y: Floats,
    fold: NDArray[np.intp],
    strengths: Floats,
    parts: Sequence[slice] = (slice(None),),
) -> Ridge:
    """Ridge without intercept: no motion is no force. Its strength by cross-validation.

    Args:
        x: (n, features).
        y: (n, targets).
        fold: (n,) the fold that leaves each sample out.
        strengths: to choose from, in units of the features' mean sum of squares.
        parts: columns of `y` that share a strength.
    """
    alphas = strengths * np.square(x).sum() / x.shape[1]
    best = np.full(y.shape[1], alphas[0])
    if len(np.unique(fold)) > 1:
        models = [Ridge(alpha, fit_intercept=False, solver="cholesky") for alpha in alphas]
        said = [cross_val_predict(model, x, y, cv=PredefinedSplit(fold)) for model in models]
        errors = np.square(np.stack(said) - y).sum(axis=1)
        for part in parts:
            best[part] = alphas[errors[:, part].sum(axis=1).argmin()]
    return Ridge(best, fit_intercept=False, solver="cholesky").fit(x, y)


def nearest(x: Floats, y: Floats) -> KNeighborsRegressor:
    """Mean of the most alike samples."""
    return KNeighborsRegressor(min(_NEIGHBOURS, len(x)), algorithm="brute").fit(x, y)


def _groups(clips: Sequence[Clip]) -> NDArray[np.intp]:
    names = sorted({clip.group for clip in clips})
    return np.concatenate([np.full(clip.frames, names.index(clip.group)) for clip in clips])
