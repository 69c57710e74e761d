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
    away = np.square(PLACES - [80.0, 60.0]).sum(axis=-1) / 30**2
    return np.asarray(np.exp(-away)[..., None] * np.float32([0.5, 1.0]) * amount_px, np.float32)


def moved(picture: NDArray[np.float64] | Mask, by: Field) -> Field:
    source = PLACES - by
    for _ in range(20):
        source = PLACES - cv2.remap(by, source[..., 0], source[..., 1], cv2.INTER_LINEAR)
    planes = np.asarray(picture, np.float32)
    return np.asarray(cv2.remap(planes, source[..., 0], source[..., 1], cv2.INTER_CUBIC))


def frame(tissue_by: Field, band_by: Field, seed: int) -> Picture:
    """Tissue under a band that moves with it or not."""
    cover = cv2.GaussianBlur(moved(BAND, band_by), (0, 0), 0.7)[..., None]
    picture = moved(TISSUE, tissue_by) * (1 - cover) + moved(VEIN, band_by) * cover
    return np.clip(picture + np.random.default_rng(seed).normal(0, 1, picture.shape), 0, 255).astype(np.uint8)


@pytest.fixture(autouse=True)
def _takes_the_band_for_an_instrument(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = np.zeros(SIZE, np.float32)
    found = Segmentation(np.where(BAND, np.float32(0.95), nothing), nothing, nothing)
    monkeypatch.setattr(lookalike, "segment", lambda rest, picture: found)


NONE = np.zeros((*SIZE, 2), np.float32)
REST = frame(NONE, NONE, 9)
EVERYWHERE = np.ones(SIZE, bool)


def test_a_band_that_moves_with_the_tissue_is_tissue() -> None:
    frames = [frame(pull(px), pull(px), seed) for seed, px in enumerate((4.0, 6.0, 5.0))]
    found = find_lookalikes(REST, frames, EVERYWHERE)
    assert (found & BAND).sum() > 0.85 * BAND.sum()
    assert not (found & ~BAND).any()


@pytest.mark.parametrize(
    "band_by",
    [NONE, NONE + np.float32([2.0, 4.0]), NONE + np.float32([4.0, 1.0])],
    ids=["still", "rigid", "along itself"],
)
def test_a_band_that_is_still_or_moves_as_a_rigid_body_stays_an_instrument(band_by: Field) -> None:
    frames = [frame(pull(5.0 + seed), band_by, seed) for seed in range(3)]
    assert not find_lookalikes(REST, frames, EVERYWHERE).any()


def test_nothing_is_said_where_nothing_moves_or_nothing_is_taken_for_an_instrument() -> None:
    assert not find_lookalikes(REST, [frame(NONE, NONE, seed) for seed in range(3)], EVERYWHERE).any()
    frames = [frame(pull(5.0), pull(5.0), 1)]
    assert not find_lookalikes(REST, frames, np.zeros(SIZE, bool)).any()


def test_an_instrument_over_such_tissue_stays_masked_while_the_tissue_around_it_is_freed() -> None:
    picture, rod = frame(pull(5.0), pull(5.0), 4), np.zeros(SIZE, bool)
    rod[:75, 95:105] = True
    picture[rod] = 45
    band = moved(BAND, pull(5.0)) > 0.5
    nothing = np.zeros(SIZE, np.float32)
    found = Segmentation((band | rod).astype(np.float32), nothing, nothing)
    left = Lookalikes(REST, BAND).remove(found, picture).objects
    assert left[rod].mean() > 0.98
    near = cv2.dilate(rod.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
    assert left[band & ~near].mean() < 0.03
