"""Simple methods on data they must get right, and physics against physics with another mesh."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from known_contacts import contacts
from made_clip import made_clip
from numpy.typing import NDArray

from bench.methods import baselines, compliance, elastic_inverse
from bench.methods.protocol import InSpace, Method, MethodContext
from learn.data.clips import Clip
from synth.errors import UserError
from synth.flow.stereo.track import Moved

N = baselines.GRID.size
Solve = Callable[[compliance.Compliance, NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]


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


@pytest.fixture(scope="module")
def methods() -> dict[str, Method]:
    return baselines.as_methods(baselines.fitted_rules(clips(), "recovered"), "recovered")


def ask(method: Method, force: NDArray[np.float64], young: float) -> float:
    scene = MethodContext(np.ones((96, 96), bool), 36 / 96, young)
    axis = (np.arange(96) - 47.5) * 36 / 96
    bump = np.exp(-(axis[None] ** 2 + axis[:, None] ** 2) / 50)
    flow = (0.05 * force[:2] * bump[..., None] / scene.scale_mm_per_px).astype(np.float32)
    return method(flow, np.ones((96, 96), np.float32), scene, False).size_mn


@pytest.mark.parametrize("name", ["linear in |d|", "ridge on PCA of flow"])
def test_linear_solids_force_is_found_and_scales_with_stiffness(
    methods: dict[str, Method], name: str
) -> None:
    force = np.array([6.0, 0, 0])
    assert ask(methods[name], force, 1.0) == pytest.approx(6, rel=0.12)
    assert ask(methods[name], force, 2.5) == pytest.approx(2.5 * ask(methods[name], force, 1.0))


def test_ridge_is_its_formula_with_the_strength_that_errs_least_on_folds_left_out() -> None:
    rng = np.random.default_rng(0)
    x, fold = rng.normal(size=(60, 8)) * np.geomspace(1, 0.01, 8), np.arange(60) % 4
    y = x @ rng.normal(size=(8, 3)) + [0.02, 0.02, 0.5] * rng.normal(size=(60, 3))
    strengths = np.geomspace(1e-6, 1e2, 9)

    def solve(x: NDArray[np.float64], y: NDArray[np.float64], alpha: float) -> NDArray[np.float64]:
        return np.asarray(np.linalg.solve(x.T @ x + alpha * np.eye(8), x.T @ y))

    alphas = strengths * np.trace(x.T @ x) / 8
    errors = [
        sum(
            np.square(x[fold == k] @ solve(x[fold != k], y[fold != k], a) - y[fold == k]).sum(0)
            for k in range(4)
        )
        for a in alphas
    ]
    parts = (slice(0, 2), slice(2, 3))
    chosen = [int(np.argmin([e[part].sum() for e in errors])) for part in parts]
    assert chosen[0] != chosen[1]
    by_hand = [x @ solve(x, y[:, part], alphas[k]) for part, k in zip(parts, chosen, strict=True)]
    said = baselines.ridge(x, y, fold, strengths, parts).predict(x)
    np.testing.assert_allclose(said, np.concatenate(by_hand, axis=1), rtol=1e-9, atol=1e-12)


def test_mean_and_zero_do_not_look(methods: dict[str, Method]) -> None:
    assert ask(methods["mean"], np.zeros(3), 2.0) == pytest.approx(2.0 * 5.0)
    assert ask(baselines.physical()["zero"], np.array([9.0, 0, 0]), 2.0) == 0


@pytest.fixture(scope="module")
def known() -> compliance.Compliance:
    return compliance.build(point_mm=1.5, node_mm=2.0, tets=1500)


def moved(known: compliance.Compliance, load: list[float]) -> NDArray[np.float64]:
    """Displacement (P, 3) mm, camera axes, for four loads of (3,) mN, world axes, on another mesh."""
    block = compliance.ElasticBlock.build(2500)
    held = block.embed(np.array([[2.0, -3.0], [2.5, -3.0], [2.0, -2.5], [1.5, -3.0]]))
    u = block.embed(known.points).move(block.system.solve(held.gather(np.tile(load, (4, 1)))))
    return np.asarray(u * [1, -1, -1])


SOLVERS = [elastic_inverse.tikhonov, elastic_inverse.tikhonov_near, elastic_inverse.one_contact]


@pytest.mark.slow
@pytest.mark.parametrize("solve", SOLVERS)
def test_force_across_the_view_with_noise(known: compliance.Compliance, solve: Solve) -> None:
    seen = moved(known, [7.5, 10.0, 0.0])[:, :2]
    noise = 0.1 * np.random.default_rng(0).normal(size=seen.shape)
    assert solve(known, seen + noise, np.ones(len(seen)))[:2] == pytest.approx([30, -40], abs=6)
    assert np.abs(solve(known, 0 * seen, np.ones(len(seen)))).max() < 1e-9


@pytest.mark.slow
def test_one_contact_finds_the_force_along_the_view(known: compliance.Compliance) -> None:
    forces, fields = contacts(known, 3, 3.0, 2500, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    for force, field in zip(forces, fields, strict=True):
        noisy = field + 0.1 * rng.normal(size=field.shape)
        said = 3.0 * elastic_inverse.one_contact(known, noisy, np.ones(len(field)))
        assert said == pytest.approx(force, abs=0.12 * np.linalg.norm(force) + 4)


def test_noise_at_the_edge_leads_nowhere_outside(known: compliance.Compliance) -> None:
    rng = np.random.default_rng(1)
    for seen in (np.ones(len(known.points)), (known.points[:, 0] > 9).astype(float)):
        noise = 0.05 * rng.normal(size=(len(known.points), 2))
        found = elastic_inverse.contact(known, noise, seen)
        assert np.hypot(*found.place[:2]) <= 12
        assert np.isfinite(found.force).all()
        assert np.isfinite(elastic_inverse.tikhonov_near(known, noise, seen)).all()


def test_fitted_on_two_eyes_asks_for_two() -> None:
    told = []
    for clip in clips():
        moved = clip.displacement["recovered"]
        told.append(
            replace(clip, displacement={"motion": np.concatenate([moved, 0.5 * moved[:, :1]], axis=1)})
        )
    method = baselines.as_methods(baselines.fitted_rules(told, "motion"), "motion")["ridge on PCA of flow"]
    force = np.array([6.0, 0, 0])
    scene = MethodContext(np.ones((96, 96), bool), 36 / 96, 1.0)
    axis = (np.arange(96) - 47.5) * 36 / 96
    bump = np.exp(-(axis[None] ** 2 + axis[:, None] ** 2) / 50)[..., None]
    seen = (0.05 * np.array([*force[:2], 0.5 * force[0]]) * bump).astype(np.float32)
    flow, sure = seen[..., :2] / np.float32(scene.scale_mm_per_px), np.ones((96, 96), np.float32)
    assert isinstance(method, InSpace)
    said = method.in_space(flow, sure, Moved(seen, np.full_like(seen, 0.01)), scene, False)
    assert said.size_mn == pytest.approx(6, rel=0.12)
    with pytest.raises(UserError, match="second eye"):
        method(flow, sure, scene, False)


@pytest.mark.slow
@pytest.mark.parametrize("solve", SOLVERS)
def test_a_force_along_the_view_is_seen_by_two_eyes(solve: Solve) -> None:
    known = compliance.build(point_mm=1.5, node_mm=2.0, tets=1500, components=3)
    # 40 mN into the tissue, away from the camera.
    seen = moved(known, [2.5, 0.0, -10.0])
    seen += 0.05 * np.random.default_rng(0).normal(size=seen.shape)
    weight = np.ones((len(known.points), 3))
    assert solve(known, seen, weight) == pytest.approx([10, 0, 40], abs=5)
    # What isn't trusted has no part in it.
    spoilt = seen + np.where(known.points[:, :1] < -6, 5.0, 0.0)
    weight[known.points[:, 0] < -6] = 0
    assert solve(known, spoilt, weight) == pytest.approx([10, 0, 40], abs=6)
