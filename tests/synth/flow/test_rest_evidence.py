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


def tissue() -> Field:
    pink = np.array([200.0, 140, 120]) + 10 * mottle(2, 0)[..., None] + 8 * mottle(7, 1)[..., None]
    blue = np.array([95.0, 105, 150]) + 9 * mottle(3, 2)[..., None]
    return np.where(cv2.blur(VEIN.astype(np.float32), (3, 3))[..., None] > 0.5, blue, pink).astype(np.float32)


def pulled(planes: Field, amount_px: float) -> Field:
    pull = amount_px * np.exp(-((X - 180) ** 2 + (Y - 110) ** 2) / 60**2)
    return np.asarray(cv2.remap(planes, X - 0.6 * pull, Y - 0.8 * pull, cv2.INTER_CUBIC))


def picture(planes: Field, seed: int) -> Picture:
    noise = np.random.default_rng(seed).normal(0, 1, planes.shape)
    return np.clip(cv2.GaussianBlur(planes, (0, 0), 0.6) + noise, 0, 255).astype(np.uint8)


REST = picture(tissue(), 5)


def classes(instrument: Field) -> Segmentation:
    nothing = np.full(SIZE, 0.02, np.float32)
    return Segmentation(instrument.astype(np.float32), nothing, nothing)


def scene(shaft: bool) -> Picture:
    planes = pulled(tissue(), 6)
    if shaft:
        planes = np.where(SHADOW[..., None], 0.55 * planes, planes)
        across = (X - 200 - 0.4 * (Y - 120)) / 13
        steel = (60 + 120 * np.exp(-((across - 0.2) ** 2) / 0.05))[..., None] + np.zeros(3)
        planes = np.where(ROD[..., None], steel, planes)
    return picture(planes.astype(np.float32), 6)


def test_a_vein_that_moved_with_the_tissue_is_none_that_appeared() -> None:
    looks = np.where(VEIN, 0.4, 0.02)  # it isn't sure
    now = classes(np.where(pulled(VEIN.astype(np.float32), 6) > 0.5, 0.93, 0.02))
    refined = RestEvidence(REST, classes(looks)).weigh(now, scene(shaft=False))
    before, after = (np.mean(one.instrument > HIDING) for one in (now, refined))
    assert before > 0.05
    assert after < 0.1 * before


def test_a_shaft_that_appeared_is_masked_whole_and_its_shadow_is_not() -> None:
    middle = ROD & (np.abs(X - 200 - 0.4 * (Y - 120)) < 8)
    looks = np.where(middle, 0.85, np.where(ROD, 0.7, np.where(VEIN, 0.6, 0.02)))
    refined = RestEvidence(REST, classes(np.where(VEIN, 0.6, 0.02))).weigh(classes(looks), scene(shaft=True))
    found = refined.instrument > HIDING
    assert np.sum(found & ROD) / np.sum(found | ROD) > 0.75
    assert np.mean(found[SHADOW & ~ROD]) < 0.1


def test_what_lies_still_since_rest_stays_what_it_was_taken_for() -> None:
    planes = np.where(ROD[..., None], np.float32(90), tissue())
    held = classes(np.where(ROD, 0.97, 0.02))
    later = picture(np.where(ROD[..., None], np.float32(90), pulled(tissue(), 4)), 8)
    inner = cv2.erode(ROD.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
    refined = RestEvidence(picture(planes, 7), held).weigh(held, later)
    assert np.mean(refined.instrument[inner] > HIDING) > 0.97


def small(planes: Field | Picture) -> NDArray[np.generic]:
    return np.asarray(cv2.resize(planes, (160, 120), interpolation=cv2.INTER_AREA))


def test_the_rest_frame_is_aligned_to_tissue_that_moved() -> None:
    frame, rest, vein = small(scene(shaft=False)), small(REST), small(VEIN.astype(np.float32))
    aligned, moved = align(frame, rest, vein)
    before, after = (np.abs(frame - one.astype(np.float32))[5:-5, 5:-5].mean() for one in (rest, aligned))
    assert after < 0.6 * before
    expected = small(pulled(VEIN.astype(np.float32), 6))
    assert np.mean(np.abs(moved - expected)) < 0.5 * np.mean(np.abs(vein - expected))


def test_a_picture_without_texture_tells_nothing_and_what_differs_has_changed() -> None:
    plain = np.full((120, 160, 3), 120, np.uint8)
    frame = plain.copy()
    frame[40:80, 60:100] = 120 + round(2 * Limits.changed)
    changed, same = compare(frame, plain)
    assert changed[44:76, 64:96].all()
    assert not changed[:36].any()
    assert not same.any()


@pytest.mark.parametrize("size", [(12, 90), (61, 47), (7, 5)])
def test_pictures_of_any_size_are_weighed(size: tuple[int, int]) -> None:
    frame = np.random.default_rng(3).integers(0, 256, (*size, 3), np.uint8)
    found = Segmentation(*np.full((3, *size), 0.4, np.float32))
    weighed = RestEvidence(frame, found).weigh(found, frame)
    assert weighed.instrument.shape == size
    assert weighed.instrument.dtype == np.float32
    assert np.isfinite(weighed.instrument).all()
