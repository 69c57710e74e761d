"""Objects and vessels drawn over pictures for training."""

import numpy as np
import pytest

from weights import paste

_TISSUE = np.full((120, 160, 3), [180, 90, 80], np.float32)


def _rod(mirror: paste.Mirror | None) -> paste.Sprite:
    outline = "line", np.array([[0.1, 0.375], [2.1, 0.375]]), 0.2
    return paste.Sprite((outline,), np.full(3, 50.0), None, 0.0, 0.0, 0.0, (), mirror)


def test_metal_mirrors_tissue_at_its_rim_and_dark_surroundings_at_its_middle() -> None:
    dark = np.full((paste._SIDE, paste._SIDE, 3), 20, np.float32)
    mirror = paste.Mirror(np.ones(3), dark, fade=1.0, edge=0.7, blend=0.05, near=1e-3, reach=0.05, rough=0.01)
    layer = paste.paste(paste.Layer.of(_TISSUE), _rod(mirror), np.zeros(2))
    column = layer.picture[:, 120]
    inside = np.flatnonzero(layer.instrument[:, 120] > 0.9)
    assert len(inside) == pytest.approx(32, abs=2)
    assert np.allclose(column[inside[[0, -1]]], _TISSUE[0, 0], atol=2)
    assert np.allclose(column[59:62], 20, atol=2)


def test_a_lamp_on_one_side_is_a_streak_along_that_side() -> None:
    around = np.full((paste._SIDE, paste._SIDE, 3), 20, np.float32)
    around[: paste._SIDE // 2 - 8] = 200  # slopes towards negative y
    mirror = paste.Mirror(
        np.ones(3), around, fade=1.0, edge=2.0, blend=0.05, near=1e-3, reach=0.0, rough=0.01
    )
    picture = paste.paste(paste.Layer.of(_TISSUE), _rod(mirror), np.zeros(2)).picture
    assert picture[48:52, 60:140].min() > 150
    assert picture[70:74, 60:140].max() < 40


def test_vessels_change_the_picture_but_are_tissue() -> None:
    layer = paste.add_vessels(paste.Layer.of(_TISSUE), np.random.default_rng(3))
    is_changed = np.abs(layer.picture - _TISSUE).max(-1) > 20
    assert 0.02 < is_changed.mean() < 0.7
    assert not layer.instrument.any()


def test_instruments_of_every_kind_are_drawn_within_their_masks() -> None:
    rng = np.random.default_rng(5)
    for _ in range(12):
        instrument = paste.draw_instrument(rng, _TISSUE, _TISSUE)
        layer = paste.paste(paste.Layer.of(_TISSUE), instrument, np.zeros(2))
        assert np.isfinite(layer.picture).all()
        untouched = (layer.instrument == 0) & (layer.shadow < 1e-3)
        soft = 8  # px that defocus reaches
        padded = np.pad(layer.instrument > 0, soft)
        dilated = np.zeros(untouched.shape, bool)
        for y in range(0, 2 * soft + 1, 4):
            for x in range(0, 2 * soft + 1, 4):
                dilated |= padded[y : y + 120, x : x + 160]
        assert np.allclose(layer.picture[untouched & ~dilated], _TISSUE[0, 0], atol=1)
