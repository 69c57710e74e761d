"""Force estimators: ridge regression on motion, a network.

Force rotates with the image, so ridge is fitted on every sequence in its eight rotations and reflections,
which the network draws at random.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.decomposition import TruncatedSVD
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import PredefinedSplit

from learn.data.clips import Clip
from learn.data.grid import settle
from learn.inference.predict import Predictor, total_force
from learn.network.channels import rotate as rotate_tensors
from synth.arrays import Array, Floats, Map

_FOLDS = 4
_COMPONENTS = 200  # principal components of displacement
_BASIS = 150  # sequences that they are found on
_STRENGTHS = np.geomspace(1e-8, 1e2, 21)


def fit_ridge(x: Floats, force: Floats, group: NDArray[np.intp]) -> Any:
    """Ridge regression from displacement to force over E; arguments as `samples` returns them."""
    # Every sequence has the same weight, as in the score; a linear relation may be scaled.
    size = np.array([np.sqrt(np.square(force[group == k]).sum(axis=1).mean()) for k in np.unique(group)])
    x, force = x / size[group, None], force / size[group, None]
    # Across the line of sight force is far more visible in flow than along it. No motion is no force.
    options: dict[str, Any] = {"fit_intercept": False, "scoring": "neg_mean_squared_error"}
    options |= {"alphas": _STRENGTHS * np.square(x).sum() / x.shape[1], "cv": PredefinedSplit(group % _FOLDS)}
    across, along = (RidgeCV(**options).fit(x, force[:, part]) for part in (slice(0, 2), 2))
    return SimpleNamespace(predict=lambda rows: np.column_stack([across.predict(rows), along.predict(rows)]))


def fit_ridge_on_components(fit: Sequence[Clip], source: str) -> Callable[[Clip, str], Floats]:
    """Ridge regression on principal components of the displacement `source`, in eight orientations.

    Returns:
        From a clip and the name of its displacement to its total force (T, 3) mN, camera axes.
    """
    small = [coarsen(clip) for clip in fit]
    # Not centred, so that zero motion stays zero.
    x, _, _ = samples(small[:_BASIS], source)
    basis = TruncatedSVD(min(_COMPONENTS, min(x.shape) - 1), random_state=0).fit(x)
    features, forces, groups = [], [], []
    for start in range(0, len(small), _BASIS):
        x, force, group = samples(small[start : start + _BASIS], source)
        features.append(basis.transform(x))
        forces.append(force)
        groups.append(group + start)
    x, force, group = np.concatenate(features), np.concatenate(forces), np.concatenate(groups)
    regressor = fit_ridge(x, force, group)

    def estimate(clip: Clip, displacement: str) -> Floats:
        force = regressor.predict(basis.transform(rows(coarsen(clip), displacement)))
        return clip.young_kpa * np.asarray(force)

    return estimate


def rotate_clip(clip: Clip) -> list[Clip]:
    """The clip in four rotations by quarter turns and their reflections, with all arrays and the force."""

    def rotate(fields: Array, turn: int) -> Array:
        return rotate_tensors(torch.from_numpy(np.array(fields)), turn).numpy()

    return [
        replace(
            clip,
            displacement={name: rotate(motion, turn) for name, motion in clip.displacement.items()},
            mask=rotate(clip.mask[None, None], turn)[0, 0],
            confidence=rotate(clip.confidence[:, None], turn)[:, 0],
            density=rotate(clip.density, turn),
            force=rotate(clip.force[..., None, None], turn)[..., 0, 0],
        )
        for turn in range(8)
    ]


def rows(clip: Clip, source: str = "recovered") -> Floats:
    """Displacement of a clip, (T, 2 N N) mm, or in stereo (T, 3 N N)."""
    return (clip.displacement[source] * clip.mask).reshape(clip.frames, -1).astype(np.float64)


def samples(fit: Sequence[Clip], source: str = "recovered") -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Frames in all orientations: displacement, force over E (n, 3), and the index of their sequence (n,)."""
    clips = [rotate_clip(clip) for clip in fit]
    x = np.concatenate([rows(t, source) for turns in clips for t in turns])
    force = np.concatenate([t.force / t.young_kpa for turns in clips for t in turns])
    group = np.repeat(np.arange(len(fit)), [sum(t.frames for t in turns) for turns in clips])
    return x, force, group


def coarsen(clip: Clip, times: int = 2) -> Clip:
    """The clip on a grid of `times` wider cells: mean displacement of a cell's tissue, all of its force."""

    def blocks(values: Map) -> Map:
        n = values.shape[-1] // times
        pooled: Map = values.reshape(*values.shape[:-2], n, times, n, times).mean((-3, -1))
        return pooled

    def mean(values: Map) -> Map:
        return (blocks(values * clip.mask) / share * mask).astype(np.float32)

    cover = blocks(np.asarray(clip.mask))
    mask = (cover > 0.5).astype(np.float32)
    share = np.where(mask > 0, cover, np.float32(1))
    return replace(
        clip,
        mask=mask,
        displacement={name: mean(np.asarray(motion)) for name, motion in clip.displacement.items()},
        confidence=mean(np.asarray(clip.confidence)),
        density=np.stack([settle(d, mask) for d in blocks(np.asarray(clip.density))]),
    )


def read_force(predictor: Predictor, clip: Clip, source: str, membrane_known: bool = False) -> Floats:
    """Total force (T, 3) mN estimated by a network with vector output."""
    displacement = np.asarray(clip.displacement[source])
    membrane = clip.membrane if membrane_known else "unknown"
    density = predictor.density(displacement, clip.mask, clip.young_kpa, clip.confidence_of(source), membrane)
    return total_force(density, predictor.grid)


def errors(predicted: Sequence[Floats], true: Sequence[Floats]) -> dict[str, list[float]]:
    """Root mean square error relative to that of the force, for each sequence: (T, 3) mN, camera axes.

    Returns:
        `errors` of the whole vector, and its parts `across` and `along` the line of sight.
    """
    columns: dict[str, list[float]] = {"errors": [], "across": [], "along": []}
    for estimate, force in zip(predicted, true, strict=True):
        mean_square = np.square(force).sum(axis=1).mean()
        relative = np.square(estimate - force).mean(axis=0) / mean_square
        for name, parts in (("errors", relative), ("across", relative[:2]), ("along", relative[2:])):
            columns[name].append(float(np.sqrt(parts.sum())))
    return columns
