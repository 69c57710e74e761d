"""Measurements of flow: errors, ground truth of scenes and videos, figures of stereo."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from evidence.flow.measure import epe, errors
from evidence.flow.scenes import CLEAN, Field, Frame, Pair, inverse, pairs, pixels, recipes, video
from evidence.flow.stereo import figures
from synth.flow.recording.decode import Footage, RecordingFlowSettings
from synth.flow.recording.video_pass import VideoPass
from synth.video.read_video import Picture


def known(flow: np.ndarray, hidden: np.ndarray, contact: np.ndarray) -> Pair:
    every, picture = np.ones(hidden.shape, bool), np.zeros((*hidden.shape, 3), np.uint8)
    return Pair(picture, picture, flow, every, every, hidden, contact, every)


def test_error_of_a_known_offset() -> None:
    truth, none = np.zeros((20, 20, 2), np.float32), np.zeros((20, 20), bool)
    truth[..., 0] = 4.0
    error = errors(truth + np.array([0.0, 3.0], np.float32), known(truth, none, ~none))
    assert error["mean"] == pytest.approx(3.0)
    assert error["magnitude"] == pytest.approx(0.25)  # |(4, 3)| = 5 against 4
    assert np.isnan(error["hidden"])

    truth, flow = np.zeros((2, 4, 4, 2), np.float32)
    flow[0, :, 0] = 8.0  # wrong under the tool only
    contact, hidden = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    contact[:2], hidden[0] = True, True
    error = errors(flow, known(truth, hidden, contact))
    assert [error[part] for part in ("contact", "contact_visible", "hidden")] == [4.0, 0.0, 8.0]


def test_scene_agrees_with_its_flow() -> None:
    """The current frame warped by the flow is the rest frame; the inverse of the flow undoes it."""
    (pair,) = pairs(CLEAN, 1, 3)
    x, y = np.moveaxis(pixels(*pair.flow.shape[:2]) + pair.flow, -1, 0)
    moved = map_coordinates(pair.now[..., 1].astype(float), (y, x), order=3, mode="nearest")
    assert np.abs(moved - pair.rest[..., 1])[8:-8, 8:-8].mean() < 0.8  # rounding to 8 bits twice
    field = 10 * Field.draw("pull", 96, np.random.default_rng(0)).at(pixels(96, 96))
    source = inverse(field)
    there = [map_coordinates(field[..., c], (source[..., 1], source[..., 0]), order=1) for c in (0, 1)]
    assert np.abs(source + np.stack(there, -1) - pixels(96, 96))[4:-4, 4:-4].max() < 0.01


def test_video_agrees_with_its_flow() -> None:
    """The current frame warped by the flow is the rest frame, up to the light."""
    plain = replace(
        CLEAN, surface="drawn grey", motion="twist", peak_px=3.0, reach=0.0, slope=0.5, bulge=0.08
    )
    rest, *later = video(plain, 96, 6)
    one = max(later, key=lambda shown: shown.amplitude)
    assert np.linalg.norm(one.flow, axis=-1).max() > 1.0
    inner = (slice(10, -10), slice(10, -10))

    def spread(at: np.ndarray) -> float:
        moved = map_coordinates(one.rgb[..., 1].astype(float), (at[..., 1], at[..., 0]), order=3)
        ratio = moved[inner] / rest.rgb[..., 1][inner]
        return float(np.abs(ratio - np.median(ratio)).mean())

    assert spread(pixels(96, 96) + one.flow) < 0.03  # the bulge changes the light
    assert spread(pixels(96, 96)) > 1.5 * spread(pixels(96, 96) + one.flow)


CORRUPTED = "black", "covered", "defocus", "jump"  # faults of a frame whose flow says nothing


def track(shown: Sequence[Frame], masks: str) -> tuple[float, float]:
    """Mean endpoint error [px] of visible tissue, and the share of unobstructed tissue that is masked."""
    pictures = [Picture(k, k / 10, one.rgb) for k, one in enumerate(shown)]
    flow = VideoPass(Footage(lambda: pictures, "video"), RecordingFlowSettings(rate_hz=None, masks=masks))
    error, covered = [], []
    for one, found in list(zip(shown, flow.frames(), strict=True))[1:]:
        covered.append(found.hidden[one.free].mean() if one.free.any() else np.nan)
        if one.fault not in CORRUPTED and one.visible.any():
            error.append(epe(found.flow, one.flow)[one.visible].mean())
    return float(np.mean(error)), float(np.nanmean(covered))


@pytest.mark.trial
def test_detected_masks_help_on_average_of_the_tuning_half() -> None:
    videos = [list(video(one, 160, 8)) for one in recipes("tuning", 12)]
    detected, covered = zip(*(track(shown, "auto") for shown in videos), strict=True)
    without, _ = zip(*(track(shown, "none") for shown in videos), strict=True)
    assert np.mean(detected) / np.mean(without) < 0.95
    assert max(covered) < 0.2


def test_errors_bias_and_z_scores_of_stereo_are_those_put_in() -> None:
    true = np.zeros((40_000, 3))
    true[:, 2] = 0.5

    def measured(bias: float, spread: float, deviation: float) -> dict[str, float]:
        found = true * (1 - bias) + np.random.default_rng(1).normal(scale=spread, size=true.shape)
        return figures([(true, found, np.full_like(true, deviation), np.arange(40_000) < 20_000)])

    right = measured(0.0, 0.02, 0.02)
    assert right["depth_rms_mm"] == pytest.approx(0.02, rel=0.03)
    assert (right["depth_z68"], right["depth_z95"]) == pytest.approx((1.0, 2.0), abs=0.05)
    assert measured(0.1, 0.001, 0.02)["pressed_bias"] == pytest.approx(0.1, abs=0.002)
    assert measured(0.0, 0.02, 0.01)["across_z68"] == pytest.approx(2.0, abs=0.1)
