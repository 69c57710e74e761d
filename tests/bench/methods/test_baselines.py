"""Baselines on data of a linear solid."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from made_clip import made_clip
from numpy.typing import NDArray

from bench.methods import baselines, comparison
from bench.methods.protocol import FrameMotion, Method, MethodContext
from learn.data.clips import Clip
from synth.dataset import provenance
from synth.errors import UserError
from synth.flow.stereo.track import Moved
from synth.system import cache

N = baselines.GRID.size


def field(at: tuple[float, float], force: NDArray[np.float64]) -> NDArray[np.float32]:
    """A made-up linear solid: both components of displacement follow the in-plane force, (2, N, N) mm."""
    axis = (np.arange(N) - (N - 1) / 2) * baselines.GRID.pitch_mm
    bump = np.exp(-((axis[None] - at[0]) ** 2 + (axis[:, None] - at[1]) ** 2) / 50)
    return (0.05 * force[:2, None, None] * bump).astype(np.float32)


def clips(count: int = 12, frames: int = 5) -> list[Clip]:
    """Pulls in the picture's plane, 0 to 10 mN for each kPa."""
    rng = np.random.default_rng(0)
    axis = (np.arange(N) - (N - 1) / 2) * baselines.GRID.pitch_mm
    mask = (np.hypot(axis[None], axis[:, None]) < 12).astype(np.float32)
    out = []
    for k in range(count):
        direction = rng.normal(size=3) * [1, 1, 0]
        force = np.linspace(0, 10, frames)[:, None] * direction / np.linalg.norm(direction)
        shift = np.stack([field((0.0, 0.0), f) for f in force]) * mask
        out.append(replace(made_clip(k, shift, 2.0 * force, mask), group=str(k % 6)))
    return out


def estimate(method: Method, young: float, stereo: bool = False) -> float:
    """Size of the estimate under (6, 0) mN/kPa; tissue moves half as far in depth."""
    scene = MethodContext(np.ones((96, 96), bool), 36 / 96, young)
    axis = (np.arange(96) - 47.5) * 36 / 96
    bump = np.exp(-(axis[None] ** 2 + axis[:, None] ** 2) / 50)[..., None]
    motion = (0.05 * np.array([6.0, 0.0, 3.0]) * bump).astype(np.float32)
    moved = Moved(motion, np.full_like(motion, 0.01)) if stereo else None
    flow = motion[..., :2] / np.float32(scene.scale_mm_per_px)
    return method(FrameMotion(flow, np.ones((96, 96), np.float32), motion=moved), scene, False).size_mn


def test_linear_solids_force_is_found_and_scales_with_stiffness() -> None:
    method = baselines.Baseline(baselines.fit_ridge(clips(), "recovered"))
    one, other = (estimate(method, young) for young in (1.0, 2.5))
    assert one == pytest.approx(6, rel=0.12)
    assert other == pytest.approx(2.5 * one)


def test_ridge_equals_its_formula_with_the_strength_of_least_error_on_folds_left_out() -> None:
    rng = np.random.default_rng(0)
    x, fold = rng.normal(size=(60, 8)) * np.geomspace(1, 0.01, 8), np.arange(60) % 4
    y = x @ rng.normal(size=(8, 3)) + [0.02, 0.02, 0.5] * rng.normal(size=(60, 3))
    strengths = np.geomspace(1e-6, 1e2, 9)

    def solve(x: NDArray[np.float64], y: NDArray[np.float64], alpha: float) -> NDArray[np.float64]:
        return np.asarray(np.linalg.solve(x.T @ x + alpha * np.eye(8), x.T @ y))

    alphas = strengths * np.trace(x.T @ x) / 8

    def errors_of(alpha: float, k: int) -> NDArray[np.float64]:
        here = fold == k
        return np.asarray(np.square(x[here] @ solve(x[~here], y[~here], alpha) - y[here]).sum(0))

    errors = [sum(errors_of(alpha, k) for k in range(4)) for alpha in alphas]
    parts = (slice(0, 2), slice(2, 3))
    chosen = [int(np.argmin([e[part].sum() for e in errors])) for part in parts]
    assert chosen[0] != chosen[1]
    by_hand = [x @ solve(x, y[:, part], alphas[k]) for part, k in zip(parts, chosen, strict=True)]
    found = baselines.ridge(x, y, fold, strengths, parts).predict(x)
    np.testing.assert_allclose(found, np.concatenate(by_hand, axis=1), rtol=1e-9, atol=1e-12)


def test_a_baseline_fitted_on_stereo_requires_stereo() -> None:
    stereo = []
    for clip in clips():
        moved = clip.displacement["recovered"]
        motion = np.concatenate([moved, 0.5 * moved[:, :1]], axis=1)
        stereo.append(replace(clip, displacement={"motion": motion}))
    method = baselines.Baseline(baselines.fit_ridge(stereo, "motion"), uses_3d=True)
    assert estimate(method, 1.0, stereo=True) == pytest.approx(6, rel=0.12)
    with pytest.raises(UserError, match="right camera"):
        estimate(method, 1.0)


def test_rules_are_fitted_once_for_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    rng = np.random.default_rng(0)
    fitted = [made_clip(k, rng.normal(size=(4, 2, N, N)), rng.normal(size=(4, 3))) for k in range(6)]
    fit = Mock(side_effect=lambda: baselines.fit_ridge(fitted, "recovered"))

    def cached(hashes: str, source: str = "recovered") -> baselines.Linear:
        return comparison.cached_rule(list(hashes), source, fit)

    first, again = cached("ab"), cached("ab")
    assert fit.call_count == 1
    given = fitted[0].displacement["recovered"][1], fitted[0].mask, fitted[0].confidence[1]
    np.testing.assert_array_equal(again(*given), first(*given))
    cached("ac")
    cached("ab", "ideal")
    assert fit.call_count == 3
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:100])  # as on a full disk
    cached("ab")
    assert fit.call_count == 4
    monkeypatch.setattr(provenance, "source", lambda *paths: "other code")
    cached("ab")
    assert fit.call_count == 5
