"""Baselines fitted on the network's sequences: of a linear solid displacement gives the force over E."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD
from sklearn.linear_model import Ridge
from sklearn.model_selection import PredefinedSplit, cross_val_predict

from bench.methods.protocol import Field, ForceEstimate, FrameMotion, MethodContext
from learn.data.clips import assumed_young
from learn.data.grid import Grid, GridView, certainty
from synth.arrays import Floats
from synth.errors import UserError

if TYPE_CHECKING:
    from learn.data.clips import Clip

Rule = Callable[[Field, Field, Field], Floats]
"""Displacement (2 or, in stereo, 3, N, N) mm, mask (N, N) 0/1, confidence (N, N) or (2, N, N), lateral and in
depth → force over E, (3,) mN/kPa; NaN: magnitude only, in x."""

RIDGE = "ridge on PCA of flow"
GRID = Grid(48)
_COMPONENTS = 20


class Baseline:
    """A rule as a `Method`."""

    def __init__(self, rule: Rule, uses_3d: bool = False) -> None:
        """`uses_3d`: whether the rule requires motion in three dimensions."""
        self._rule, self._uses_3d = rule, uses_3d
        self._view: tuple[MethodContext, GridView] | None = None

    def __call__(self, frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        shift, confidence = frame.flow * np.float32(scene.scale_mm_per_px), frame.confidence
        if self._uses_3d:
            if frame.motion is None:
                raise UserError(
                    "fitted on motion in three dimensions: needs a right camera or depth pictures"
                )
            shift, confidence = frame.motion.motion, certainty(frame.motion.deviation)
        if self._view is None or self._view[0] is not scene:
            self._view = scene, GridView(scene.tissue, scene.scale_mm_per_px, GRID)
        view = self._view[1]
        fields = view.mean(shift.transpose(2, 0, 1)), view.mask, view.mean(confidence)
        return ForceEstimate(assumed_young(scene.young_kpa) * self._rule(*fields))


@dataclass(frozen=True, eq=False)
class Linear:
    """A `Rule` that ignores confidence."""

    matrix: Floats  # (3, C N N) mN/(kPa mm)

    def __call__(self, moved: Field, mask: Field, confidence: Field) -> Floats:
        return np.asarray(self.matrix @ _rows(moved[None], mask[None])[0], np.float64)


def fit_ridge(clips: Sequence[Clip], source: str) -> Linear:
    """`RIDGE` fitted on the network's own fit sequences, on `GRID`, with displacement from `source`."""
    moved = np.concatenate([clip.displacement[source] for clip in clips])
    mask = np.concatenate([np.broadcast_to(clip.mask, (clip.frames, *clip.mask.shape)) for clip in clips])
    force = np.concatenate([clip.force / clip.young_kpa for clip in clips])
    rows = _rows(moved, mask)
    # Not centred, so that no motion stays zero.
    basis = TruncatedSVD(min(_COMPONENTS, min(rows.shape) - 1), algorithm="arpack", random_state=0).fit(rows)
    features = basis.transform(rows)
    names = sorted({clip.group for clip in clips})
    fold = np.concatenate([np.full(clip.frames, names.index(clip.group) % 4) for clip in clips])
    strengths = np.geomspace(1e-4, 1e2, 13)
    return Linear(ridge(features, force, fold, strengths).coef_ @ basis.components_)


def _rows(moved: Field, mask: Field) -> Floats:
    """(T, C, N, N) mm, (T, N, N) → masked displacement, (T, C N N)."""
    return (moved * mask[:, None]).reshape(len(moved), -1).astype(np.float64)


def ridge(
    x: Floats, y: Floats, fold: NDArray[np.intp], strengths: Floats, parts: Sequence[slice] = (slice(None),)
) -> Ridge:
    """Ridge regression without intercept (no motion is no force), its strength by cross-validation.

    `x`: (n, features); `y`: (n, targets); `fold`: (n,) the fold that leaves each sample out; `strengths`:
    candidates, in units of the features' mean sum of squares; `parts`: columns of `y` that share a strength.
    """
    alphas = strengths * np.square(x).sum() / x.shape[1]
    best = np.full(y.shape[1], alphas[0])
    if len(np.unique(fold)) > 1:
        models = [Ridge(alpha, fit_intercept=False, solver="cholesky") for alpha in alphas]
        found = [cross_val_predict(model, x, y, cv=PredefinedSplit(fold)) for model in models]
        errors = np.square(np.stack(found) - y).sum(axis=1)
        for part in parts:
            best[part] = alphas[errors[:, part].sum(axis=1).argmin()]
    return Ridge(best, fit_intercept=False, solver="cholesky").fit(x, y)
