"""The masked TV-L1 solver: its parts against formulas, the whole against known warps."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import median_filter

from evidence.flow.chain import ChainTracker, compose
from evidence.flow.scenes import CLEAN, Recipe, Stage, pairs
from synth.flow import confidence, image, track, tvl1
from synth.flow.tvl1 import Settings, Tvl1


def _error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(flow - truth, axis=-1)


def test_derivative_is_exact_for_cubics() -> None:
    y, x = torch.meshgrid(torch.arange(20.0) / 10, torch.arange(24.0) / 10, indexing="ij")
    field = (x**3 - 2 * x * y + y**2)[None, None]
    dx, dy = image.derivative(field)[0]
    inner = (slice(2, -2), slice(2, -2))
    torch.testing.assert_close(dx[inner] * 10, (3 * x**2 - 2 * y)[inner], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(dy[inner] * 10, (2 * y - 2 * x)[inner], atol=1e-4, rtol=1e-4)


def test_median_is_scipys() -> None:
    field = torch.from_numpy(np.random.default_rng(0).normal(size=(1, 2, 17, 23)).astype(np.float32))
    expected = median_filter(field.numpy(), size=(1, 1, 3, 3), mode="nearest")
    np.testing.assert_array_equal(image.median3(field).numpy(), expected)


def test_warp_reads_where_the_flow_points() -> None:
    picture = torch.rand(1, 1, 12, 16, generator=torch.Generator().manual_seed(1))
    flow = torch.zeros(1, 2, 12, 16)
    flow[:, 0], flow[:, 1] = 2, -1
    moved, seen = image.warp(picture, torch.ones_like(picture), flow)
    torch.testing.assert_close(moved[..., 1:, :-2], picture[..., :-1, 2:], atol=1e-5, rtol=0)
    assert seen[..., 1:, :-2].min() == 1
    assert seen[..., 0, :].max() == 0
    assert seen[..., -2:].max() == 0


def test_fill_keeps_what_is_known_and_continues_a_constant() -> None:
    field = torch.full((1, 2, 21, 33), 4.0)
    usable = (torch.rand(1, 1, 21, 33, generator=torch.Generator().manual_seed(1)) > 0.7).float()
    torch.testing.assert_close(image.fill(field * usable, usable), field)


def test_normalisation_takes_out_gain_and_offset() -> None:
    rng = np.random.default_rng(0)
    grey = torch.from_numpy(rng.normal(100, 25, (1, 1, 64, 64)).astype(np.float32))
    every = torch.ones_like(grey)
    once, again = image.normalise(grey, every), image.normalise(1.3 * grey - 20, every)
    # Equal but for the floor under the deviation, 3 grey levels in 25 and in 32.
    torch.testing.assert_close(again, once, rtol=0.05, atol=1e-3)
    assert abs(float(once.std()) - 0.9) < 0.15


def test_proximal_step_solves_its_normal_equations() -> None:
    """Without regulariser (dual step 0 by one step), the data prox is the least-squares solution."""
    s = Settings(weight=1.0, tau=1e6, steps=1, reweights=1, median=False, huber=0.0)
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(40.0), indexing="ij")

    def surface(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return (torch.sin(0.35 * x + 0.2 * y) + torch.cos(0.3 * y - 0.25 * x) + torch.sin(0.5 * y))[
            None, None
        ]

    shifted = torch.tensor([0.2, -0.1]).view(1, 2, 1, 1)
    rest, now = surface(x, y), surface(x - 0.2, y + 0.1)
    every = torch.ones_like(rest)
    flow, _ = tvl1.step(
        tvl1.Level(rest, now, every, every),
        torch.zeros(1, 2, 40, 40),
        torch.zeros(2, 1, 2, 40, 40),
        torch.ones(1, 1, 1, 1),
        s,
    )
    off = (flow - shifted)[..., 6:-6, 6:-6].norm(dim=1)
    assert float(off.median()) < 0.02


@pytest.mark.parametrize("warm", [False, True])
def test_clean_pull(warm: bool) -> None:
    found = []
    for pair in pairs(CLEAN, 2, 21):
        every = np.ones(pair.rest.shape[:2], bool)
        start = 0.9 * pair.flow if warm else None
        flow, trust = Tvl1().flow(pair.rest, pair.now, every, every, start)
        found.append(_error(flow, pair.flow).mean())
        assert np.median(trust) > 0.9
    assert np.mean(found) < 0.06


def test_pull_with_tool_highlights_and_light() -> None:
    mean, contact, hidden = [], [], []
    for pair in pairs(Recipe(), 3, 22):
        flow, trust = Tvl1().flow(pair.rest, pair.now, pair.rest_usable, pair.now_usable)
        error = _error(flow, pair.flow)
        mean.append(error[pair.inside & ~pair.hidden].mean())
        contact.append(error[pair.contact & ~pair.hidden].mean())
        hidden.append(error[pair.hidden].mean())
        assert trust[pair.hidden].mean() < 0.02  # what can't be seen isn't vouched for
    assert np.mean(mean) < 0.15
    assert np.mean(contact) < 0.4
    assert np.mean(hidden) < 0.5


def test_batch_is_single_and_cpu_is_deterministic() -> None:
    three = list(pairs(Recipe(size=96, pull=5), 3, 4))
    solver = Tvl1(device="cpu")
    stacks = [np.stack([getattr(p, k) for p in three]) for k in ("rest", "now", "rest_usable", "now_usable")]
    flow, trust = solver.flows(*stacks)
    for k, pair in enumerate(three):
        alone, sure = solver.flow(pair.rest, pair.now, pair.rest_usable, pair.now_usable)
        np.testing.assert_allclose(flow[k], alone, atol=1e-4)
        np.testing.assert_allclose(trust[k], sure, atol=1e-3)
    again, _ = solver.flows(*stacks)
    np.testing.assert_array_equal(flow, again)


def test_identical_frames_stand_still() -> None:
    (pair,) = pairs(CLEAN, 1, 9)
    flow, _ = Tvl1().flow(pair.rest, pair.rest, pair.rest_usable, pair.rest_usable)
    assert np.abs(flow).max() <= 1e-4


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (3, 2), (31, 57)])
def test_small_and_odd_pictures(size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    every = np.ones(size, bool)
    flow, trust = Tvl1().flow(picture, picture[::-1].copy(), every, every)
    assert flow.shape == (*size, 2)
    assert np.isfinite(flow).all()
    assert np.isfinite(trust).all()


def test_blank_or_masked_pictures_are_not_trusted() -> None:
    rng = np.random.default_rng(1)
    (pair,) = pairs(CLEAN, 1, 9)
    every = np.ones(pair.rest.shape[:2], bool)
    blank = np.clip(rng.normal(128, 2, pair.rest.shape), 0, 255).astype(np.uint8)
    for now, usable in ((blank, every), (pair.now, ~every)):
        flow, trust = Tvl1().flow(pair.rest, now, every, usable)
        assert np.isfinite(flow).all()
        assert trust.mean() < 0.25


def test_confidence_without_agreement_is_nought() -> None:
    (pair,) = pairs(CLEAN, 1, 9)
    every = image.flags(np.ones(pair.rest.shape[:2], bool))
    level = tvl1.pyramid(image.tensor(pair.rest), image.tensor(pair.now), every, every, Settings())[0]
    right = torch.from_numpy(pair.flow).movedim(-1, 0)[None]
    assert float(confidence.judge(level, right, None)[..., 10:-10, 10:-10].mean()) > 0.9
    assert float(confidence.judge(level, right + 12.0, None).mean()) < 0.3


def test_tracker_recovers_after_blank_frames() -> None:
    rng = np.random.default_rng(7)
    stage = Stage.set(Recipe(size=128, pull=8.0), rng)
    rest = stage.rest(rng)
    tracker = track.Tracker("tvl1", rest[0], rest[1], np.ones((128, 128), bool))
    blank = np.full_like(rest[0], 90)
    for share in (0.4, None, None, 1.0):
        if share is None:
            tracker.step(blank, np.zeros((128, 128), bool))
            assert not tracker.trusted
            continue
        shot = stage.against(rest, share, rng)
        flow, trust = tracker.step(shot.now, ~shot.now_usable)
        assert tracker.trusted
        assert _error(flow, shot.flow)[~shot.hidden & shot.inside].mean() < 0.25
        assert trust[shot.hidden].mean() < 0.05


def test_tracker_leaves_a_wrong_start() -> None:
    rng = np.random.default_rng(8)
    stage = Stage.set(Recipe(size=128, pull=8.0, tool=0.0), rng)
    rest = stage.rest(rng)
    tracker = track.Tracker("tvl1", rest[0], rest[1], np.ones((128, 128), bool))
    tracker.start(np.full((128, 128, 2), 25.0, np.float32))
    shot = stage.against(rest, 1.0, rng)
    flow, _ = tracker.step(shot.now, ~shot.now_usable)
    assert tracker.resets == 1
    assert _error(flow, shot.flow).mean() < 0.25


def test_compose_of_translations() -> None:
    one, two = np.full((9, 9, 2), 1.5, np.float32), np.full((9, 9, 2), (-0.5, 2.0), np.float32)
    np.testing.assert_allclose(compose(one, two), np.full((9, 9, 2), (1.0, 3.5)), atol=1e-6)


@pytest.mark.slow
def test_chain_of_steps_drifts_and_rest_to_now_does_not() -> None:
    rng = np.random.default_rng(12)
    stage = Stage.set(Recipe(size=96, pull=4.0, tool=0.0, noise=3.0), rng)
    rest = stage.rest(rng)
    tissue = np.ones((96, 96), bool)
    ours = track.Tracker("tvl1", rest[0], rest[1], tissue)
    chain = ChainTracker("tvl1", rest[0], rest[1], tissue)
    for phase in np.linspace(0, 2 * np.pi, 16)[1:]:
        shot = stage.against(rest, 0.5 - 0.5 * np.cos(phase), rng)
        here, _ = ours.step(shot.now, ~shot.now_usable)
        there, _ = chain.step(shot.now, ~shot.now_usable)
    assert _error(there, shot.flow).mean() > 1.5 * _error(here, shot.flow).mean()


def test_more_noise_asks_for_more_smoothness() -> None:
    """lambda falls with the square of the median residual, and stays where nothing is seen."""
    generator = torch.Generator().manual_seed(3)
    residual = torch.randn(2, 3, 40, 40, generator=generator) * torch.tensor([0.07, 0.1]).view(2, 1, 1, 1)
    every = torch.ones(2, 1, 40, 40)
    factor = tvl1.calm(residual, every, 0.115).flatten()
    assert float(factor[0] / factor[1]) == pytest.approx(2.04, rel=0.1)
    assert tvl1.calm(100 * residual, every, 0.115).flatten().tolist() == pytest.approx([0.45, 0.45])
    assert tvl1.calm(residual, 0 * every, 0.115).flatten().tolist() == [1.0, 1.0]


def test_steepness_of_a_ramp() -> None:
    x = torch.arange(96.0).expand(1, 1, 96, 96)
    flow = torch.cat([0.3 * x, -0.4 * x], 1)
    inner = tvl1.steepness(flow)[..., 32:-32, 32:-32]
    torch.testing.assert_close(inner, torch.full_like(inner, 0.25))
