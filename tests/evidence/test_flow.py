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


def make_pair(flow: np.ndarray, hidden: np.ndarray, contact: np.ndarray) -> Pair:
    everywhere, picture = np.ones(hidden.shape, bool), np.zeros((*hidden.shape, 3), np.uint8)
    return Pair(picture, picture, flow, everywhere, everywhere, hidden, contact, everywhere)


def test_error_of_a_known_offset() -> None:
    truth, none = np.zeros((20, 20, 2), np.float32), np.zeros((20, 20), bool)
    truth[..., 0] = 4.0
    error = errors(truth + np.array([0.0, 3.0], np.float32), make_pair(truth, none, ~none))
    assert error["mean"] == pytest.approx(3.0)
    assert error["magnitude"] == pytest.approx(0.25)  # |(4, 3)| = 5 against 4
    assert np.isnan(error["hidden"])

    truth, flow = np.zeros((2, 4, 4, 2), np.float32)
    flow[0, :, 0] = 8.0  # wrong under the tool only
    contact, hidden = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    contact[:2], hidden[0] = True, True
    error = errors(flow, make_pair(truth, hidden, contact))
    assert [error[part] for part in ("contact", "contact_visible", "hidden")] == [4.0, 0.0, 8.0]


def test_scene_agrees_with_its_flow() -> None:
    """The current frame warped by the flow is the rest frame; the inverse of the flow undoes it."""
    (pair,) = pairs(CLEAN, 1, 3)
    x, y = np.moveaxis(pixels(*pair.flow.shape[:2]) + pair.flow, -1, 0)
    warped = map_coordinates(pair.now[..., 1].astype(float), (y, x), order=3, mode="nearest")
    assert np.abs(warped - pair.rest[..., 1])[8:-8, 8:-8].mean() < 0.8  # rounding to 8 bits twice
    field = 10 * Field.draw("pull", 96, np.random.default_rng(0)).at(pixels(96, 96))
    source = inverse(field)
    flow_at_source = [
        map_coordinates(field[..., c], (source[..., 1], source[..., 0]), order=1) for c in (0, 1)
    ]
    assert np.abs(source + np.stack(flow_at_source, -1) - pixels(96, 96))[4:-4, 4:-4].max() < 0.01


def test_video_agrees_with_its_flow() -> None:
    """The current frame warped by the flow is the rest frame, up to the light."""
    recipe = replace(
        CLEAN, surface="drawn grey", motion="twist", peak_px=3.0, reach=0.0, slope=0.5, bulge=0.08
    )
    rest, *later = video(recipe, 96, 6)
    strongest = max(later, key=lambda frame: frame.amplitude)
    assert np.linalg.norm(strongest.flow, axis=-1).max() > 1.0
    inner = (slice(10, -10), slice(10, -10))

    def spread(positions: np.ndarray) -> float:
        warped = map_coordinates(
            strongest.rgb[..., 1].astype(float), (positions[..., 1], positions[..., 0]), order=3
        )
        ratio = warped[inner] / rest.rgb[..., 1][inner]
        return float(np.abs(ratio - np.median(ratio)).mean())

    assert spread(pixels(96, 96) + strongest.flow) < 0.03  # the bulge changes the light
    assert spread(pixels(96, 96)) > 1.5 * spread(pixels(96, 96) + strongest.flow)


CORRUPTED = "black", "covered", "defocus", "jump"  # faults of a frame whose flow says nothing


def track(frames: Sequence[Frame], masks: str) -> tuple[float, float]:
    """Mean endpoint error [px] of visible tissue, and the share of unobstructed tissue that is masked."""
    pictures = [Picture(k, k / 10, frame.rgb) for k, frame in enumerate(frames)]
    flow = VideoPass(Footage(lambda: pictures, "video"), RecordingFlowSettings(rate_hz=None, masks=masks))
    frame_errors, masked_shares = [], []
    for frame, tracked in list(zip(frames, flow.frames(), strict=True))[1:]:
        masked_shares.append(tracked.hidden[frame.free].mean() if frame.free.any() else np.nan)
        if frame.fault not in CORRUPTED and frame.visible.any():
            frame_errors.append(epe(tracked.flow, frame.flow)[frame.visible].mean())
    return float(np.mean(frame_errors)), float(np.nanmean(masked_shares))


@pytest.mark.trial
def test_detected_masks_help_on_average_of_the_tuning_half() -> None:
    videos = [list(video(recipe, 160, 8)) for recipe in recipes("tuning", 12)]
    masked_errors, masked_shares = zip(*(track(frames, "auto") for frames in videos), strict=True)
    plain_errors, _ = zip(*(track(frames, "none") for frames in videos), strict=True)
    assert np.mean(masked_errors) / np.mean(plain_errors) < 0.95
    assert max(masked_shares) < 0.2


def test_errors_bias_and_z_scores_of_stereo_are_those_put_in() -> None:
    true = np.zeros((40_000, 3))
    true[:, 2] = 0.5

    def measure_figures(bias: float, spread: float, deviation: float) -> dict[str, float]:
        estimate = true * (1 - bias) + np.random.default_rng(1).normal(scale=spread, size=true.shape)
        return figures([(true, estimate, np.full_like(true, deviation), np.arange(40_000) < 20_000)])

    right = measure_figures(0.0, 0.02, 0.02)
    assert right["depth_rms_mm"] == pytest.approx(0.02, rel=0.03)
    assert (right["depth_z68"], right["depth_z95"]) == pytest.approx((1.0, 2.0), abs=0.05)
    assert measure_figures(0.1, 0.001, 0.02)["pressed_bias"] == pytest.approx(0.1, abs=0.002)
    assert measure_figures(0.0, 0.02, 0.01)["across_z68"] == pytest.approx(2.0, abs=0.1)
