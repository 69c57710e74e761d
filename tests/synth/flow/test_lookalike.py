"""Tissue that looks like an instrument is told from one by its motion, whatever the segmentation says."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow import lookalike
from synth.flow.lookalike import Lookalikes, find_lookalikes
from synth.flow.segmentation import Segmentation

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Field = NDArray[np.float32]
SIZE = 120, 160
PLACES = np.stack(np.meshgrid(*map(np.arange, SIZE[::-1])), axis=-1).astype(np.float32)
BAND = np.abs(PLACES[..., 1] - 60 - 0.25 * (PLACES[..., 0] - 80)) < 9
"""(H, W) a band across the picture, which the segmentation of these tests takes for an instrument."""


def mottle(period: float, seed: int) -> Field:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SIZE), (0, 0), period)
    return np.asarray(noise / noise.std(), np.float32)


TISSUE = np.array([200.0, 140, 120]) + 14 * mottle(1.5, 0)[..., None] + 8 * mottle(5, 1)[..., None]
VEIN = np.array([90.0, 95, 140]) + 9 * mottle(1.5, 2)[..., None] + 8 * mottle(4, 3)[..., None]


def pull(amount_px: float) -> Field:
    """Motion (H, W, 2) px of tissue pulled at the middle, which falls with the distance."""
    squared_distance = np.square(PLACES - [80.0, 60.0]).sum(axis=-1) / 30**2
    return np.asarray(np.exp(-squared_distance)[..., None] * np.float32([0.5, 1.0]) * amount_px, np.float32)


def warp(picture: NDArray[np.float64] | Mask, motion: Field) -> Field:
    source = PLACES - motion
    for _ in range(20):
        source = PLACES - cv2.remap(motion, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
    planes = np.asarray(picture, np.float32)
    return np.asarray(cv2.remap(planes, source[..., 0], source[..., 1], cv2.INTER_CUBIC))


def draw_frame(tissue_motion: Field, band_motion: Field, seed: int) -> Picture:
    """Tissue under a band that moves with it or not."""
    coverage = cv2.GaussianBlur(warp(BAND, band_motion), (0, 0), 0.7)[..., None]
    picture = warp(TISSUE, tissue_motion) * (1 - coverage) + warp(VEIN, band_motion) * coverage
    return np.clip(picture + np.random.default_rng(seed).normal(0, 1, picture.shape), 0, 255).astype(np.uint8)


@pytest.fixture(autouse=True)
def _takes_the_band_for_an_instrument(monkeypatch: pytest.MonkeyPatch) -> None:
    zeros = np.zeros(SIZE, np.float32)
    segmentation = Segmentation(np.where(BAND, np.float32(0.95), zeros), zeros, zeros)
    monkeypatch.setattr(lookalike, "segment", lambda rest, picture: segmentation)


NO_MOTION = np.zeros((*SIZE, 2), np.float32)
REST = draw_frame(NO_MOTION, NO_MOTION, 9)
EVERYWHERE = np.ones(SIZE, bool)


def test_a_band_that_moves_with_the_tissue_is_tissue() -> None:
    frames = [draw_frame(pull(px), pull(px), seed) for seed, px in enumerate((4.0, 6.0, 5.0))]
    lookalikes = find_lookalikes(REST, frames, EVERYWHERE)
    assert (lookalikes & BAND).sum() > 0.85 * BAND.sum()
    assert not (lookalikes & ~BAND).any()


@pytest.mark.parametrize(
    "band_motion",
    [NO_MOTION, NO_MOTION + np.float32([2.0, 4.0]), NO_MOTION + np.float32([4.0, 1.0])],
    ids=["still", "rigid", "along itself"],
)
def test_a_band_that_is_still_or_moves_as_a_rigid_body_stays_an_instrument(band_motion: Field) -> None:
    frames = [draw_frame(pull(5.0 + seed), band_motion, seed) for seed in range(3)]
    assert not find_lookalikes(REST, frames, EVERYWHERE).any()


def test_nothing_is_said_where_nothing_moves_or_nothing_is_taken_for_an_instrument() -> None:
    assert not find_lookalikes(
        REST, [draw_frame(NO_MOTION, NO_MOTION, seed) for seed in range(3)], EVERYWHERE
    ).any()
    frames = [draw_frame(pull(5.0), pull(5.0), 1)]
    assert not find_lookalikes(REST, frames, np.zeros(SIZE, bool)).any()


def test_an_instrument_over_such_tissue_stays_masked_while_the_tissue_around_it_is_freed() -> None:
    picture, rod = draw_frame(pull(5.0), pull(5.0), 4), np.zeros(SIZE, bool)
    rod[:75, 95:105] = True
    picture[rod] = 45
    band = warp(BAND, pull(5.0)) > 0.5
    zeros = np.zeros(SIZE, np.float32)
    segmentation = Segmentation((band | rod).astype(np.float32), zeros, zeros)
    objects = Lookalikes(REST, BAND).remove(segmentation, picture).objects
    assert objects[rod].mean() > 0.98
    rod_margin = cv2.dilate(rod.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
    assert objects[band & ~rod_margin].mean() < 0.03
