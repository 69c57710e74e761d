"""Simple methods on data they must get right, and physics against physics with another mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.methods import baselines, compliance, corotational, inverse
from bench.methods.protocol import InSpace, Method, Scene
from evidence.scoring import inverse as inverse_experiment
from learn.data.clips import Clip
from synth.errors import UserError
from synth.flow.stereo.track import Moved

N = baselines.GRID.size


def field(at: tuple[float, float], force: NDArray[np.float64]) -> NDArray[np.float32]:
    """A made-up linear solid: both components of displacement follow the in-plane force, (2, N, N) mm."""
    axis = (np.arange(N) - (N - 1) / 2) * baselines.GRID.pitch_mm
    bump = np.exp(-((axis[None] - at[0]) ** 2 + (axis[:, None] - at[1]) ** 2) / 50)
    return (0.05 * force[:2, None, None] * bump).astype(np.float32)


def clips(count: int = 12, frames: int = 5) -> list[Clip]:
    rng = np.random.default_rng(0)
    axis = (np.arange(N) - (N - 1) / 2) * baselines.GRID.pitch_mm
    mask = (np.hypot(axis[None], axis[:, None]) < 12).astype(np.float32)
    out = []
    for k in range(count):
        young = float(rng.uniform(0.5, 3))
        direction = rng.normal(size=3) * [1, 1, 0]
        force = np.linspace(0, 10, frames)[:, None] * direction / np.linalg.norm(direction)
        moved = np.stack([field((0.0, 0.0), f) for f in force]) * mask
        density = np.repeat(
            force[:, :, None, None] * mask / (mask.sum() * baselines.GRID.pitch_mm**2), 1, axis=1
        )
        out.append(
            Clip(
                name=str(k), content_hash=str(k), group=str(k % 6), family="healthy", gesture="pull",
                young_kpa=young, mask=mask, displacement={"recovered": moved},
                confidence=np.ones((frames, N, N), np.float32),
                density=density.astype(np.float32), force=young * force,
            )
        )  # fmt: skip
    return out


@pytest.fixture(scope="module")
def methods() -> dict[str, Method]:
    return baselines.fitted(clips(), "recovered")


def ask(method: Method, force: NDArray[np.float64], young: float) -> float:
    scene = Scene(np.ones((96, 96), bool), 36 / 96, young)
    axis = (np.arange(96) - 47.5) * 36 / 96
    bump = np.exp(-(axis[None] ** 2 + axis[:, None] ** 2) / 50)
    flow = (0.05 * force[:2] * bump[..., None] / scene.scale_mm_per_px).astype(np.float32)
    return method(flow, np.ones((96, 96), np.float32), scene, False).size_mn


@pytest.mark.parametrize("name", ["linear in |d|", "power law in |d|", "ridge on PCA of flow"])
def test_linear_solids_force_is_found_and_scales_with_stiffness(
    methods: dict[str, Method], name: str
) -> None:
    force = np.array([6.0, 0, 0])
    assert ask(methods[name], force, 1.0) == pytest.approx(6, rel=0.12)
    assert ask(methods[name], force, 2.5) == pytest.approx(2.5 * ask(methods[name], force, 1.0))


def test_neighbours_and_trees_answer_within_the_data(methods: dict[str, Method]) -> None:
    assert 2 < ask(methods["k-NN on PCA of flow"], np.array([5.0, 0, 0]), 1.0) < 10
    assert ask(methods["boosting per pixel"], np.array([8.0, 0, 0]), 1.0) > 2 * ask(
        methods["boosting per pixel"], np.zeros(3), 1.0
    )


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


def test_nearest_is_the_mean_of_the_five_most_alike() -> None:
    rng = np.random.default_rng(0)
    x, y, asked = rng.normal(size=(40, 6)), rng.normal(size=(40, 3)), rng.normal(size=(7, 6))
    order = np.square(asked[:, None] - x).sum(-1).argsort(axis=1)[:, :5]
    np.testing.assert_allclose(baselines.nearest(x, y).predict(asked), y[order].mean(axis=1), rtol=1e-12)
    assert baselines.nearest(x[:2], y[:2]).predict(asked)[0] == pytest.approx(y[:2].mean(axis=0))


def test_mean_and_zero_do_not_look(methods: dict[str, Method]) -> None:
    assert ask(methods["mean"], np.zeros(3), 2.0) == pytest.approx(2.0 * 5.0)
    assert ask(baselines.physical()["zero"], np.array([9.0, 0, 0]), 2.0) == 0


@pytest.fixture(scope="module")
def known() -> compliance.Compliance:
    return compliance.build(point_mm=1.5, node_mm=2.0, tets=1500)


@pytest.fixture(scope="module")
def across(known: compliance.Compliance) -> NDArray[np.float64]:
    """Displacement at the compliance's points for (30, -40, 0) mN on another mesh, with 0.1 mm of noise."""
    rng = np.random.default_rng(0)
    block = compliance.Block.build("linear", 2500, 2)
    held = block.carry(np.array([[2.0, -3.0], [2.5, -3.0], [2.0, -2.5], [1.5, -3.0]]))
    load = held.gather(np.tile([7.5, 10.0, 0.0], (4, 1)))
    u = block.carry(known.points).move(block.system.solve(load))
    return np.asarray((u * [1, -1, -1])[:, :2] + 0.1 * rng.normal(size=(len(known.points), 2)))


@pytest.mark.slow
@pytest.mark.parametrize("solve", [inverse.tikhonov, inverse.tikhonov_near, inverse.one_contact])
def test_force_across_the_view_with_another_mesh_and_noise(
    known: compliance.Compliance, across: NDArray[np.float64], solve: object
) -> None:
    assert callable(solve)
    total = solve(known, across, np.ones(len(known.points)))
    assert total[:2] == pytest.approx([30, -40], abs=6)


@pytest.mark.slow
def test_one_contact_finds_the_force_along_the_view(known: compliance.Compliance) -> None:
    forces, fields, _ = inverse_experiment.contacts(known, 3, 3.0, 2500, np.random.default_rng(3))
    rng = np.random.default_rng(4)
    for force, field in zip(forces, fields, strict=True):
        noisy = field + 0.1 * rng.normal(size=field.shape)
        said = 3.0 * inverse.one_contact(known, noisy, np.ones(len(field)))
        assert said == pytest.approx(force, abs=0.12 * np.linalg.norm(force) + 4)


@pytest.mark.slow
def test_corotational_contact_undoes_what_the_tissues_turn_looks_like(known: compliance.Compliance) -> None:
    forces, fields, _ = inverse_experiment.contacts(
        known, 3, 3.0, 2000, np.random.default_rng(5), "corotational"
    )
    everywhere = np.ones(len(known.points))
    linear, turned = (
        np.mean(
            [
                np.linalg.norm(3.0 * solve(known, u, everywhere) - f)
                for f, u in zip(forces, fields, strict=True)
            ]
        )
        for solve in (inverse.one_contact, corotational.one_contact)
    )
    assert turned < 0.6 * linear


@pytest.mark.slow
def test_loads_past_the_laws_range_stay_with_the_linear_answer(known: compliance.Compliance) -> None:
    _, fields, _ = inverse_experiment.contacts(known, 1, 3.0, 2000, np.random.default_rng(6))
    field = 3 * fields[0]
    said = corotational.one_contact(known, field, np.ones(len(known.points)))
    assert said == pytest.approx(inverse.one_contact(known, field, np.ones(len(known.points))))


def test_noise_at_the_edge_leads_nowhere_outside(known: compliance.Compliance) -> None:
    rng = np.random.default_rng(1)
    for seen in (np.ones(len(known.points)), (known.points[:, 0] > 9).astype(float)):
        noise = 0.05 * rng.normal(size=(len(known.points), 2))
        found = inverse.contact(known, noise, seen)
        assert np.hypot(*found.place[:2]) <= 12
        assert np.isfinite(found.force).all()
        assert np.isfinite(corotational.one_contact(known, noise, seen)).all()
        assert np.isfinite(inverse.tikhonov_near(known, noise, seen)).all()


def test_inverse_of_nothing_is_nothing(known: compliance.Compliance) -> None:
    none = np.zeros((len(known.points), 2))
    for solve in (inverse.tikhonov, inverse.tikhonov_near, inverse.one_contact, corotational.one_contact):
        assert np.abs(solve(known, none, np.ones(len(none)))).max() < 1e-9


def test_fitted_on_two_eyes_asks_for_two() -> None:
    told = []
    for clip in clips():
        moved = clip.displacement["recovered"]
        told.append(
            replace(clip, displacement={"motion": np.concatenate([moved, 0.5 * moved[:, :1]], axis=1)})
        )
    method = baselines.fitted(told, "motion")["ridge on PCA of flow"]
    force = np.array([6.0, 0, 0])
    scene = Scene(np.ones((96, 96), bool), 36 / 96, 1.0)
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
@pytest.mark.parametrize("solve", [inverse.tikhonov, inverse.tikhonov_near, inverse.one_contact])
def test_a_force_along_the_view_is_seen_by_two_eyes(solve: object) -> None:
    assert callable(solve)
    known = compliance.build(point_mm=1.5, node_mm=2.0, tets=1500, components=3)
    rng = np.random.default_rng(0)
    block = compliance.Block.build("linear", 2500, 2)
    held = block.carry(np.array([[2.0, -3.0], [2.5, -3.0], [2.0, -2.5], [1.5, -3.0]]))
    # 40 mN into the tissue, away from the camera.
    u = block.carry(known.points).move(block.system.solve(held.gather(np.tile([2.5, 0.0, -10.0], (4, 1)))))
    seen = u * [1, -1, -1] + 0.05 * rng.normal(size=(len(known.points), 3))
    weight = np.ones((len(known.points), 3))
    total = solve(known, seen, weight)
    assert total == pytest.approx([10, 0, 40], abs=5)
    # What isn't trusted has no part in it.
    spoilt = seen + np.where(known.points[:, :1] < -6, 5.0, 0.0)
    weight[known.points[:, 0] < -6] = 0
    assert solve(known, spoilt, weight) == pytest.approx([10, 0, 40], abs=6)
