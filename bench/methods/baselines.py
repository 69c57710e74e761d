"""What simpler methods say: fitted on the same sequences as the network, or on physics alone.

All look at the same grid of displacement in millimetres, divided by nothing and normalised by nothing but E:
for a linear solid, force over E is a function of displacement.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from sklearn.decomposition import TruncatedSVD
from sklearn.linear_model import Ridge
from sklearn.model_selection import PredefinedSplit, cross_val_predict
from sklearn.neighbors import KNeighborsRegressor

from bench.methods import compliance, elastic_inverse
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
Space = Literal["never", "where seen", "always"]
"""Whether a rule reads motion in three dimensions."""

FITTED = ("mean", "linear in |d|", "ridge on PCA of flow", "k-NN on PCA of flow")
"""Names of those that need data."""
GRID = Grid(48)
_COMPONENTS = 20
_NEIGHBOURS = 5
_SURE = 0.3


class Baseline:
    """A rule behind the bench's protocol. The last frame put on the grid is shared between baselines."""

    _last: ClassVar[dict[int, tuple[Field, MethodContext, Field, Field]]] = {}
    _view: tuple[MethodContext, GridView] | None = None

    def __init__(self, rule: Rule, space: Space = "never") -> None:
        self._rule, self._space = rule, space

    def __call__(self, flow: Field, confidence: Field, scene: MethodContext, picture: bool) -> ForceEstimate:
        """See `Method`."""
        if self._space == "always":
            raise UserError("fitted on motion in three dimensions: it needs a second eye or depth pictures")
        return self._answer(flow, flow * np.float32(scene.scale_mm_per_px), confidence, scene)

    def in_space(
        self, flow: Field, confidence: Field, moved: Moved, scene: MethodContext, picture: bool
    ) -> ForceEstimate:
        """See `InSpace`."""
        if self._space == "never":
            return self(flow, confidence, scene, picture)
        return self._answer(moved.motion, moved.motion, certainty(moved.deviation), scene)

    def _answer(self, key: Field, shift: Field, sure: Field, scene: MethodContext) -> ForceEstimate:
        """Of displacement (H, W, C) mm and its confidence ([2,] H, W); equal where `key` is the same."""
        view = Baseline._view
        if view is None or view[0] is not scene:
            Baseline._view = view = (scene, GridView(scene.tissue, scene.scale_mm_per_px, GRID))
        last = Baseline._last.get(shift.shape[-1])
        if last is None or last[0] is not key or last[1] is not scene:
            mean = view[1].resample.mean
            last = (key, scene, mean(shift.transpose(2, 0, 1), scene.tissue), mean(sure, scene.tissue))
            Baseline._last[shift.shape[-1]] = last
        return ForceEstimate(assumed_young(scene.young_kpa) * self._rule(last[2], view[1].mask, last[3]))


def physical() -> dict[str, Method]:
    """Those that need no training data; where a second eye sees motion along the view, they read that too."""
    zero: Method = Baseline(lambda moved, mask, sure: np.array([0.0, np.nan, np.nan]))
    return {"zero": zero} | {name: Baseline(rule, "where seen") for name, rule in physical_rules().items()}


def physical_rules() -> dict[str, Rule]:
    """The inverses of the physics."""
    solvers = {
        "Tikhonov, FEM compliance": elastic_inverse.tikhonov,
        "Tikhonov near the contact": elastic_inverse.tikhonov_near,
        "one contact, FEM compliance": elastic_inverse.one_contact,
    }
    return {name: _inverse(solve) for name, solve in solvers.items()}


def as_methods(rules: Mapping[str, Rule], source: str) -> dict[str, Method]:
    """Rules fitted on a displacement `source`, behind the bench's protocol."""
    space: Space = "always" if has_depth(source) else "never"
    return {name: Baseline(rule, space) for name, rule in rules.items()}


def fitted_rules(clips: Sequence[Clip], source: str) -> dict[str, Rule]:
    """Those fitted on sequences: the network's own fit sequences, for a fair table.

    Args:
        clips: on `GRID`.
        source: which displacement, `recovered` or `ideal`, of two eyes `motion` or `motion-ideal`.
    """
    moved = np.concatenate([clip.displacement[source] for clip in clips])
    mask = np.concatenate([np.broadcast_to(clip.mask, (clip.frames, *clip.mask.shape)) for clip in clips])
    force = np.concatenate([clip.force / clip.young_kpa for clip in clips])
    size = np.linalg.norm(force, axis=1)
    peak = np.array([_peak(m, k) for m, k in zip(moved, mask, strict=True)])
    rules: dict[str, Rule] = {
        "mean": partial(_say_linear, 0.0, float(size.mean())),
        "linear in |d|": partial(_say_linear, float(peak @ size) / max(float(peak @ peak), 1e-12), 0.0),
    }
    rows = _rows(moved, mask)
    # Not centred: no motion stays zero.
    basis = TruncatedSVD(min(_COMPONENTS, min(rows.shape) - 1), algorithm="arpack", random_state=0).fit(rows)
    features = basis.transform(rows)
    strengths, fold = np.geomspace(1e-4, 1e2, 13), _groups(clips) % 4
    rules["ridge on PCA of flow"] = partial(_say_regressed, basis, ridge(features, force, fold, strengths))
    rules["k-NN on PCA of flow"] = partial(_say_regressed, basis, nearest(features, force))
    return rules


def _peak(moved: Field, mask: Field) -> float:
    """Displacement that 2% of the tissue exceeds [mm]: the largest, but for outliers."""
    return float(np.percentile(np.linalg.norm(moved, axis=0)[mask > 0], 98)) if (mask > 0).any() else 0.0


# Rules are parts of functions that have a name, so that what is fitted can be kept in a file.


def _say_linear(a: float, b: float, moved: Field, mask: Field, sure: Field) -> Floats:
    """a d + b of the peak displacement d, a magnitude alone."""
    return np.array([a * _peak(moved, mask) + b, np.nan, np.nan])


def _rows(moved: Field, mask: Field) -> Floats:
    """(T, C, N, N) mm, (T, N, N) → masked displacement, (T, C N N)."""
    return (moved * mask[:, None]).reshape(len(moved), -1).astype(np.float64)


def _say_regressed(
    basis: TruncatedSVD,
    regressor: Ridge | KNeighborsRegressor,
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


def _inverse(solve: Callable[[compliance.Compliance, Floats, Floats], Floats]) -> Rule:
    """Displacement at the compliance's points, from the grid, weighted by confidence."""

    def rule(moved: Field, mask: Field, sure: Field) -> Floats:
        known = compliance.build(components=len(moved))
        at = known.points.T[::-1] / GRID.pitch_mm + (GRID.size - 1) / 2
        seen = np.stack([map_coordinates(part, at, order=1, mode="nearest") for part in moved], axis=1)
        # Flow that is hardly sure is wrong; motion in space says how far it is off, and weighs that much.
        sure = sure.reshape(-1, *mask.shape)
        least = _SURE if len(sure) == 1 else 0.0
        used = (map_coordinates(mask * np.where(s > least, s, 0), at, order=1, mode="constant") for s in sure)
        across, *along = (one.astype(np.float64) for one in used)
        if (across > 0).sum() < 20 or not np.abs(seen).max() > 0:
            return np.zeros(3)
        weight = np.stack([across, across, *along], axis=1) if along else across
        return solve(known, seen.astype(np.float64), weight)

    return rule
