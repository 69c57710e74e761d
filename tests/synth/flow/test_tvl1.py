"""The masked TV-L1 solver against SciPy's solution, flow of known warps, tracking; the correction of flow."""

from unittest.mock import patch

import cv2
import numpy as np
import pytest
import scipy.sparse as sp
import torch
import torch.nn.functional as F
from scipy.sparse.linalg import spsolve
from warped_cortex import CLEAN, Recipe, Stage, noise_field, pairs

from synth.flow import correction, image, track, tvl1
from synth.flow.image import Level
from synth.flow.tvl1 import Tvl1, TVL1Settings


def _measure_error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(flow - truth, axis=-1)


def test_pull_with_tool_highlights_and_light() -> None:
    mean, contact, hidden = [], [], []
    for pair in pairs(Recipe(), 3, 22):
        flow, trust = Tvl1().flow(pair.rest, pair.now, pair.rest_usable, pair.now_usable)
        error = _measure_error(flow, pair.flow)
        mean.append(error[pair.inside & ~pair.hidden].mean())
        contact.append(error[pair.contact & ~pair.hidden].mean())
        hidden.append(error[pair.hidden].mean())
        assert trust[pair.hidden].mean() < 0.02  # no confidence where the tissue is hidden
    assert np.mean(mean) < 0.15
    assert np.mean(contact) < 0.4
    assert np.mean(hidden) < 0.5


@pytest.mark.parametrize("size", [(1, 1), (31, 57)])
def test_small_and_odd_pictures(size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (*size, 3), dtype=np.uint8)
    full_mask = np.ones(size, bool)
    flow, trust = Tvl1().flow(picture, picture[::-1].copy(), full_mask, full_mask)
    assert flow.shape == (*size, 2)
    assert np.isfinite(flow).all()
    assert np.isfinite(trust).all()


def test_blank_or_masked_pictures_are_not_trusted() -> None:
    rng = np.random.default_rng(1)
    (pair,) = pairs(CLEAN, 1, 9)
    full_mask = np.ones(pair.rest.shape[:2], bool)
    blank = np.clip(rng.normal(128, 2, pair.rest.shape), 0, 255).astype(np.uint8)
    for now, usable in ((blank, full_mask), (pair.now, ~full_mask)):
        flow, trust = Tvl1().flow(pair.rest, now, full_mask, usable)
        assert np.isfinite(flow).all()
        assert trust.mean() < 0.25


def test_a_level_that_has_settled_takes_no_further_warps() -> None:
    (pair,) = pairs(CLEAN, 1, 9)
    for now in (pair.rest, pair.now):
        with patch.object(tvl1, "primal_dual", wraps=tvl1.primal_dual) as solver:
            Tvl1(corrected=False).flow(pair.rest, now, pair.rest_usable, pair.now_usable)
        sizes = [call.args[0].size for call in solver.call_args_list]
        assert (sizes.count(max(sizes)) == 1) == (now is pair.rest)


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
        assert _measure_error(flow, shot.flow)[~shot.hidden & shot.inside].mean() < 0.25
        assert trust[shot.hidden].mean() < 0.05


@pytest.mark.slow
def test_flow_from_rest_to_now_does_not_drift() -> None:
    stage = Stage.set(Recipe(size=96, pull=4.0, tool=0.0, noise=3.0), rng := np.random.default_rng(12))
    tracker = track.Tracker("tvl1", *(rest := stage.rest(rng))[:2], np.ones((96, 96), bool))
    shots = [stage.against(rest, 0.5 - 0.5 * np.cos(np.pi * t / 6), rng) for t in range(1, 37)]
    errors = [_measure_error(tracker.step(shot.now, ~shot.now_usable)[0], shot.flow).mean() for shot in shots]
    assert np.mean(errors[24:]) < 1.3 * np.mean(errors[:12])


def test_large_motion_of_a_small_area_is_followed_and_a_wrong_flow_is_let_go() -> None:
    recipe = Recipe(size=128, pull=16.0, reach=0.12, tool=16.0, contrast=0.3)
    stage = Stage.set(recipe, rng := np.random.default_rng(12))
    rest, full_mask = stage.rest(rng), np.ones((128, 128), bool)
    tracker = track.Tracker(Tvl1(corrected=False), *rest[:2], full_mask)
    for step in range(1, 9):
        shot = stage.against(rest, step / 8, rng)
        flow, _ = tracker.step(shot.now, ~shot.now_usable)
    length = np.linalg.norm(shot.flow, axis=-1)
    contact = (length > 0.6 * length.max()) & shot.inside & ~shot.hidden
    # With coarse levels that smooth all of the last flow it is 0.80.
    assert (flow * shot.flow)[contact].sum() / (shot.flow[contact] ** 2).sum() > 0.86
    rest_shot = stage.against(rest, 0.0, rng)
    rest_flow, _ = Tvl1(corrected=False).flow(rest[0], rest_shot.now, ~rest[1], rest_shot.now_usable, flow)
    assert np.linalg.norm(rest_flow, axis=-1)[~rest_shot.hidden].mean() < 0.5


class _FixedConfidence:
    """An estimator of given confidence, with and without the surroundings."""

    def __init__(self, alone: float, around: float) -> None:
        self.confidences, self.widened_calls = (alone, around), []

    def flow(self, rest, now, rest_usable, now_usable, initial=None):  # type: ignore[no-untyped-def]
        self.widened_calls.append(bool(rest_usable[0, 0]))
        size, confidence = rest_usable.shape, self.confidences[self.widened_calls[-1]]
        return np.zeros((*size, 2), "f4"), np.full(size, confidence, "f4")


@pytest.mark.parametrize(("alone", "around"), [(0.3, 0.9), (0.3, 0.4), (0.8, 1.0)])
def test_surroundings_are_tracked_where_tissue_alone_has_low_confidence(alone: float, around: float) -> None:
    widened = (alone, around) == (0.3, 0.9)
    tissue = np.pad(np.ones((16, 16), bool), 8)
    picture, estimator = np.zeros((32, 32, 3), np.uint8), _FixedConfidence(alone, around)
    tracker = track.Tracker(estimator, picture, ~tissue & False, tissue)
    for _ in range(6):
        _, confidence = tracker.step(picture, ~tissue & False)
    assert tracker.widened == widened == estimator.widened_calls[-1]
    assert confidence[16, 16] == pytest.approx(around if widened else alone)
    assert not confidence[~tissue].any()
    assert sum(estimator.widened_calls) <= (6 if widened else 3), "tries with the surroundings are limited"


class _NearSighted:
    """An estimator of still tissue that finds what is within 2 px of where it starts."""

    def __init__(self) -> None:
        self.calls = 0

    def flow(self, rest, now, rest_usable, now_usable, initial=None):  # type: ignore[no-untyped-def]
        self.calls += 1
        start = np.zeros((*rest_usable.shape, 2), "f4") if initial is None else initial
        is_near = np.linalg.norm(start, axis=-1) < 2
        return start * ~is_near[..., None], is_near.astype("f4")


@pytest.mark.parametrize("columns", [8, 1])
def test_flow_that_is_lost_beside_sure_flow_is_solved_again_from_that(columns: int) -> None:
    picture, tissue, estimator = np.zeros((64, 64, 3), np.uint8), np.ones((64, 64), bool), _NearSighted()
    tracker = track.Tracker(estimator, picture, ~tissue, tissue)
    tracker.initial = np.zeros((64, 64, 2), np.float32)
    tracker.initial[:, :columns] = 12.0  # what moved there is gone
    flow, confidence = tracker.step(picture, ~tissue)
    is_wide = columns == 8
    assert estimator.calls == (2 if is_wide else 1), "one column is not worth the time"
    assert np.abs(flow).max() == (0 if is_wide else 12)
    assert confidence.min() == is_wide


def test_a_warp_solves_the_linear_system_that_its_energy_has_without_clipping() -> None:
    """Where |grad w| < h the energy of a warp is quadratic: SciPy solves its normal equations."""
    rng, shape = np.random.default_rng(3), (20, 27)
    tau, gamma, epsilon, huber, hidden = numbers = np.float32([3.5, 0.7, 0.05, 2.0, 1.5])
    before, after = (np.stack([noise_field(shape, 6, rng) for _ in range(6)]).astype("f4") for _ in range(2))
    mask, weight = (rng.random(shape) > 0.2).astype("f4"), rng.uniform(0.1, 0.4, shape).astype("f4")
    start, state = rng.normal(0, 0.2, (2, *shape)).astype("f4"), tvl1.new_state(*shape)
    tvl1.linearise(before, after, mask, weight, start, numbers, state)
    solution = start.copy()
    tvl1.primal_dual(solution, state, tau, 3000)
    scale = np.array([1, gamma, gamma])
    residual = scale[:, None] * (after - before)[:3].reshape(3, -1)
    mean = 0.5 * scale[:, None, None] * (after + before)[[[1, 2], [3, 4], [4, 5]]].reshape(3, 2, -1)
    trust = (weight * mask).ravel() / np.sqrt((residual**2).sum(0) + epsilon**2)
    data = [[sp.diags((mean[:, i] * mean[:, j]).sum(0) * trust) for j in range(2)] for i in range(2)]
    steps = [sp.diags([-1.0, 1.0], [0, 1], (n, n)).tolil() for n in shape]
    for step in steps:
        step[-1] = 0  # no gradient crosses the border
    rows, columns = sp.kron(steps[0], sp.identity(shape[1])), sp.kron(sp.identity(shape[0]), steps[1])
    soft = sp.diags(1 / (huber + hidden * (1 - mask.ravel())))
    smooth = sp.block_diag([rows.T @ soft @ rows + columns.T @ soft @ columns] * 2)
    offset = residual - (mean * start.reshape(2, -1)).sum(1)
    pull = -(trust * (mean * offset[:, None]).sum(0)).ravel()
    expected = spsolve((sp.bmat(data) + smooth).tocsc(), pull).reshape(2, *shape)
    np.testing.assert_allclose(solution, expected, atol=2e-3 * np.abs(expected).max())
    assert np.abs(expected - start).max() > 0.2
    assert max(np.abs(np.diff(expected, axis=k)).max() for k in (1, 2)) < huber


@pytest.mark.parametrize("shape", [(8, 12), (9, 13), (2, 3)])
def test_means_equal_those_of_pytorch(shape: tuple[int, int]) -> None:
    field = torch.randn(3, *shape, generator=torch.Generator().manual_seed(1))
    expected = F.avg_pool2d(field, 2, ceil_mode=True, count_include_pad=False)
    np.testing.assert_allclose(image.halve(field.numpy()), expected, rtol=1e-5, atol=1e-6)
    for radius in (1, 3):
        wide = 2 * radius + 1
        rows = F.avg_pool2d(field, (1, wide), 1, (0, radius), count_include_pad=False)
        expected = F.avg_pool2d(rows, (wide, 1), 1, (radius, 0), count_include_pad=False)
        np.testing.assert_allclose(image.box(field.numpy(), radius), expected, rtol=1e-5, atol=1e-6)


def test_a_soft_mask_keeps_its_weight_and_loses_what_is_at_its_edge() -> None:
    usable = np.full((6, 8), 0.3, np.float32)
    usable[:, 4:] = 0
    visible = image.warp(usable, usable, np.full((2, 6, 8), 0.5, np.float32))[1]
    np.testing.assert_allclose(visible[1, :5], [0.3, 0.3, 0.3, 0, 0], rtol=1e-6)


def test_a_diverged_flow_samples_at_the_border() -> None:
    now = np.arange(20, dtype=np.float32).reshape(4, 5)
    flow = np.full((2, 4, 5), 1e9, np.float32)
    level = Level(now, now, np.ones_like(now), np.ones_like(now))
    assert np.isfinite(tvl1.solve([level], flow, TVL1Settings(warps=1, median=False))).all()


def _describe(mirrored: bool, x: float = 0.4, y: float = -0.25) -> np.ndarray:
    """Features of a texture that moved by (x, y) px, with a flow of (0, 0)."""
    rng = np.random.default_rng(3)
    picture = np.stack([128 + 30 * noise_field((104, 88), 12, rng) for _ in range(3)], -1)
    shift = np.float32([[1, 0, x], [0, 1, y]])
    moved_picture = cv2.warpAffine(
        picture, shift, (88, 104), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )
    pictures = np.clip([picture, moved_picture], 0, 255).astype(np.uint8)
    rest, now = np.ascontiguousarray(pictures[:, :, :: -1 if mirrored else 1])
    greys = rest[..., 1] / np.float32(12), now[..., 1] / np.float32(12)
    full_mask, flow = np.ones((104, 88), bool), np.zeros((104, 88, 2), np.float32)
    return correction.describe(
        rest, now, full_mask, greys, np.float32(full_mask), flow, np.float32(full_mask)
    )


def test_features_hold_the_remaining_step_and_mirroring_changes_vectors_only() -> None:
    features, mirrored = _describe(mirrored=False), _describe(mirrored=True)
    assert features.shape == (correction.CHANNELS, 26, 22)
    for x, y in correction.VECTORS[:4]:
        np.testing.assert_allclose(np.median(features[x, 3:-3, 3:-3]), 0.4, atol=0.05)
        np.testing.assert_allclose(np.median(features[y, 3:-3, 3:-3]), -0.25, atol=0.05)
    signs = np.ones((correction.CHANNELS, 1, 1))
    signs[[x for x, _ in correction.VECTORS]] = -1
    np.testing.assert_allclose(signs * mirrored[..., ::-1], features, atol=0.02)


def test_a_sure_correction_is_ignored_where_pictures_agree_and_smooth_where_nothing_is_visible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prediction = np.repeat(np.float32([0.5, 0.5, -5, -5]), 32 * 24).reshape(4, 32, 24)
    monkeypatch.setattr(correction, "predict", lambda weights, features: prediction)
    features, zero_flow = _describe(mirrored=False, x=0, y=0), np.zeros((104, 88, 2), np.float32)
    variance, nearness = np.exp(-5), np.ones((26, 22), np.float32)
    flow, deviation = correction.correct(features, zero_flow, nearness)
    assert np.abs(flow).max() < 0.02
    np.testing.assert_allclose(deviation, np.sqrt(0.5**2 + variance), rtol=0.02)  # either may be wrong
    known_channels = [index for index, name in enumerate(correction.FEATURES) if name.endswith("known")]
    blank_features = features.copy()
    blank_features[known_channels] = 0  # no contrast: the pictures say nothing
    prediction[:, 10:14, 9:13] = [[[9.0]], [[-9.0]], [[-5]], [[-5]]]
    for x, _ in correction.VECTORS[:-1]:
        blank_features[x : x + 2] = prediction[:2, :26, :22]  # but don't object
    blank_flow, _ = correction.correct(blank_features, zero_flow, nearness)
    share = 0.25 / (0.25 + variance)
    np.testing.assert_allclose(blank_flow[:24, :24], 0.5 * share**2, rtol=1e-3)
    assert np.abs(blank_flow[48:50, 44:46]).min() > 5
    blank_features[correction.FEATURES.index("visible in both"), 8:16, 7:15] = 0
    hidden_flow, hidden_deviation = correction.correct(blank_features, zero_flow, nearness)
    np.testing.assert_allclose(hidden_flow[20:80, 20:70], 0.5 * share**2, rtol=1e-3)
    assert hidden_deviation[48, 44] > 5  # what the network says there is withheld


def test_a_correction_is_confined_to_what_has_appeared_and_not_opposed_to_the_pictures(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prediction = np.repeat(np.float32([0.5, -0.3, -5, -5]), 32 * 24).reshape(4, 32, 24)
    monkeypatch.setattr(correction, "predict", lambda weights, features: prediction)
    features, zero_flow = _describe(mirrored=False), np.zeros((104, 88, 2), np.float32)  # moved (0.4, -0.25)
    known_channels = [index for index, name in enumerate(correction.FEATURES) if name.endswith("known")]
    features[known_channels] = 0  # the pictures don't hold it back, but point there
    nearness = np.zeros((26, 22), np.float32)
    nearness[:, :11] = 1
    flow, deviation = correction.correct(features, zero_flow, nearness)
    assert flow[20:-20, 12:36, 0].min() > 0.4
    assert np.abs(flow[:, 50:]).max() == 0
    assert deviation[52, 70] > 0.4  # what is withheld is not known
    prediction[:2] *= -1
    flow, _ = correction.correct(features, zero_flow, nearness)
    assert np.abs(flow[20:-20, 12:36]).max() < 0.1


def test_what_has_appeared_is_an_object_that_was_not_masked_at_rest() -> None:
    shape, y, x = (240, 320), *np.mgrid[:240, :320]
    full_mask, rod = np.ones(shape, bool), (np.abs(x - 40) < 8) & (y < 100)
    nearness = correction.nearness(full_mask, ~rod)
    assert nearness.shape == (60, 80)
    assert nearness[:30, 9:11].min() == 1
    assert nearness[:, 55:].max() == 0
    assert nearness[10, 38] == pytest.approx(0.69, abs=0.06)  # 107 px away, 0.33 widths of 0.25 to 0.5
    assert not correction.nearness(~rod, ~rod).any()
    assert not correction.nearness(~rod, ~np.roll(rod, 4, 1)).any()  # a highlight's rim that moves
    assert not correction.nearness(full_mask, np.hypot(x - 100, y - 100) > 4).any()  # a small highlight
    assert not correction.nearness(full_mask, full_mask).any()
    assert correction.nearness(full_mask[:1, :1], full_mask[:1, :1]).shape == (1, 1)


def test_without_an_instrument_the_flow_is_the_solvers() -> None:
    pair = next(pairs(CLEAN, 1, 24))
    full_mask = np.ones(pair.rest.shape[:2], bool)
    flows = [
        Tvl1(corrected=corrected).flow(pair.rest, pair.now, full_mask, full_mask)[0]
        for corrected in (False, True)
    ]
    np.testing.assert_array_equal(*flows)


def test_correction_lowers_the_error_on_pictures_that_are_not_rendered() -> None:
    errors = []
    for pair in pairs(Recipe(), 3, 23):
        pictures = pair.rest, pair.now, pair.rest_usable, pair.now_usable
        flows = [Tvl1(corrected=corrected).flow(*pictures)[0] for corrected in (False, True)]
        errors.append([_measure_error(flow, pair.flow)[pair.inside & ~pair.hidden].mean() for flow in flows])
    error_before, error_after = np.mean(errors, axis=0)
    assert error_after < error_before
