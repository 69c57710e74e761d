"""What appeared since rest is told from tissue that moved and from shadows, whatever it looks like."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from synth.flow.rest_evidence import Limits, RestEvidence, align, compare
from synth.flow.segmentation import Segmentation

Picture = NDArray[np.uint8]
Field = NDArray[np.float32]
SIZE = 240, 320
HIDING = 0.9  # probability above which an instrument hides tissue
Y, X = np.mgrid[: SIZE[0], : SIZE[1]].astype(np.float32)
VEIN = np.abs(Y - 60 - 0.1 * X) < 12
ROD = (np.abs(X - 200 - 0.4 * (Y - 120)) < 13) & (Y > 120)
SHADOW = (np.abs(X - 155 - 0.4 * (Y - 130)) < 13) & (Y > 130)


def mottle(period: float, seed: int) -> Field:
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=SIZE), (0, 0), period)
    return np.asarray(noise / noise.std(), np.float32)


def draw_tissue() -> Field:
    pink = np.array([200.0, 140, 120]) + 10 * mottle(2, 0)[..., None] + 8 * mottle(7, 1)[..., None]
    blue = np.array([95.0, 105, 150]) + 9 * mottle(3, 2)[..., None]
    return np.where(cv2.blur(VEIN.astype(np.float32), (3, 3))[..., None] > 0.5, blue, pink).astype(np.float32)


def deform_tissue(planes: Field, amount_px: float) -> Field:
    pull = amount_px * np.exp(-((X - 180) ** 2 + (Y - 110) ** 2) / 60**2)
    return np.asarray(cv2.remap(planes, X - 0.6 * pull, Y - 0.8 * pull, cv2.INTER_CUBIC))


def draw_picture(planes: Field, seed: int) -> Picture:
    noise = np.random.default_rng(seed).normal(0, 1, planes.shape)
    return np.clip(cv2.GaussianBlur(planes, (0, 0), 0.6) + noise, 0, 255).astype(np.uint8)


REST = draw_picture(draw_tissue(), 5)


def make_segmentation(instrument: Field) -> Segmentation:
    background = np.full(SIZE, 0.02, np.float32)
    return Segmentation(instrument.astype(np.float32), background, background)


def draw_scene(shaft: bool) -> Picture:
    planes = deform_tissue(draw_tissue(), 6)
    if shaft:
        planes = np.where(SHADOW[..., None], 0.55 * planes, planes)
        offset = (X - 200 - 0.4 * (Y - 120)) / 13
        steel = (60 + 120 * np.exp(-((offset - 0.2) ** 2) / 0.05))[..., None] + np.zeros(3)
        planes = np.where(ROD[..., None], steel, planes)
    return draw_picture(planes.astype(np.float32), 6)


def test_a_vein_that_moved_with_the_tissue_is_none_that_appeared() -> None:
    probability = np.where(VEIN, 0.4, 0.02)  # it isn't sure
    segmentation = make_segmentation(np.where(deform_tissue(VEIN.astype(np.float32), 6) > 0.5, 0.93, 0.02))
    refined = RestEvidence(REST, make_segmentation(probability)).weigh(segmentation, draw_scene(shaft=False))
    share_before, share_after = (np.mean(result.instrument > HIDING) for result in (segmentation, refined))
    assert share_before > 0.05
    assert share_after < 0.1 * share_before


def test_a_shaft_that_appeared_is_masked_whole_and_its_shadow_is_not() -> None:
    core = ROD & (np.abs(X - 200 - 0.4 * (Y - 120)) < 8)
    probability = np.where(core, 0.85, np.where(ROD, 0.7, np.where(VEIN, 0.6, 0.02)))
    refined = RestEvidence(REST, make_segmentation(np.where(VEIN, 0.6, 0.02))).weigh(
        make_segmentation(probability), draw_scene(shaft=True)
    )
    instrument = refined.instrument > HIDING
    assert np.sum(instrument & ROD) / np.sum(instrument | ROD) > 0.75
    assert np.mean(instrument[SHADOW & ~ROD]) < 0.1


def test_what_lies_still_since_rest_stays_what_it_was_taken_for() -> None:
    planes = np.where(ROD[..., None], np.float32(90), draw_tissue())
    segmentation = make_segmentation(np.where(ROD, 0.97, 0.02))
    picture = draw_picture(np.where(ROD[..., None], np.float32(90), deform_tissue(draw_tissue(), 4)), 8)
    inner = cv2.erode(ROD.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    refined = RestEvidence(draw_picture(planes, 7), segmentation).weigh(segmentation, picture)
    assert np.mean(refined.instrument[inner] > HIDING) > 0.97


def shrink(planes: Field | Picture) -> NDArray[np.generic]:
    return np.asarray(cv2.resize(planes, (160, 120), interpolation=cv2.INTER_AREA))


def test_the_rest_frame_is_aligned_to_tissue_that_moved() -> None:
    frame, rest, vein = shrink(draw_scene(shaft=False)), shrink(REST), shrink(VEIN.astype(np.float32))
    aligned, moved_vein = align(frame, rest, vein)
    error_before, error_after = (
        np.abs(frame - picture.astype(np.float32))[5:-5, 5:-5].mean() for picture in (rest, aligned)
    )
    assert error_after < 0.6 * error_before
    expected = shrink(deform_tissue(VEIN.astype(np.float32), 6))
    assert np.mean(np.abs(moved_vein - expected)) < 0.5 * np.mean(np.abs(vein - expected))


def test_a_picture_without_texture_tells_nothing_and_what_differs_has_changed() -> None:
    plain_picture = np.full((120, 160, 3), 120, np.uint8)
    frame = plain_picture.copy()
    frame[40:80, 60:100] = 120 + round(2 * Limits.changed)
    changed, same = compare(frame, plain_picture)
    assert changed[44:76, 64:96].all()
    assert not changed[:36].any()
    assert not same.any()


@pytest.mark.parametrize("size", [(12, 90), (61, 47), (7, 5)])
def test_pictures_of_any_size_are_weighed(size: tuple[int, int]) -> None:
    frame = np.random.default_rng(3).integers(0, 256, (*size, 3), np.uint8)
    segmentation = Segmentation(*np.full((3, *size), 0.4, np.float32))
    result = RestEvidence(frame, segmentation).weigh(segmentation, frame)
    assert result.instrument.shape == size
    assert result.instrument.dtype == np.float32
    assert np.isfinite(result.instrument).all()
