"""Statistics of pictures that were drawn with what they are to find."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from synth.fit import parameters
from synth.fit.statistics import View, decode, highlights, measure

MM = 0.0547
SIZE = (360, 480)


def encoded(linear: np.ndarray) -> np.ndarray:
    """The sRGB picture of linear light."""
    value = np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
    return np.clip(np.rint(255 * value), 0, 255).astype(np.uint8)


def tissue(red: float = 0.8, green: float = 0.6, blue: float = 0.4) -> np.ndarray:
    """Plain linear tissue (H, W, 3) with a little grain, so that nothing is exactly flat."""
    grain = 1 + 0.01 * np.random.default_rng(0).standard_normal(SIZE)
    return np.array([red, green, blue]) * grain[..., None]


def seen(linear: np.ndarray) -> dict[str, float]:
    rgb = encoded(linear)
    return measure(View.whole(rgb, np.ones(SIZE, bool), MM))


def test_light_is_decoded_as_encoded() -> None:
    values = np.linspace(0, 1, 50)[:, None, None] * np.ones((1, 1, 3))
    assert decode(encoded(values)) == pytest.approx(values, abs=0.005)


def test_colours_of_plain_tissue() -> None:
    found = seen(tissue())
    for part in ("crown", "flush"):
        assert [found[f"{part} {k}"] for k in "rgb"] == pytest.approx([0.8, 0.6, 0.4], rel=0.02)
    assert np.isnan(found["vein r"])
    assert np.isnan(found["arterial"])


@pytest.mark.parametrize("lost", [0.0, 0.2, 0.5])
def test_light_lost_in_the_corners_is_found(lost: float) -> None:
    whole = View.whole(np.zeros((*SIZE, 3), np.uint8), np.ones(SIZE, bool), MM)
    found = seen(tissue() * (1 - lost * whole.corner2)[..., None])
    assert found["vignette"] == pytest.approx(lost, abs=0.03)
    assert found["crown g"] == pytest.approx(0.6, rel=0.03)


def lines(count: int, width_px: int) -> np.ndarray:
    """Tissue crossed by horizontal red vessels."""
    picture = tissue()
    for y in np.linspace(20, SIZE[0] - 20, count).astype(int):
        cv2.line(picture, (0, int(y)), (SIZE[1], int(y)), (0.75, 0.12, 0.08), width_px)
    return picture


def test_length_of_vessels_is_counted() -> None:
    few, many = seen(lines(4, 3)), seen(lines(8, 3))
    # Lines along the pixels are 1.1 times too long by a rule that is for all directions.
    area = SIZE[0] * MM * SIZE[1] * MM
    assert few["density"] == pytest.approx(1.1 * 4 * SIZE[1] * MM / area, rel=0.2)
    assert many["density"] / few["density"] == pytest.approx(2, rel=0.1)
    assert many["arterial"] == pytest.approx(np.log(0.6 / 0.12), rel=0.1)


def test_a_vein_is_no_artery() -> None:
    picture = tissue()
    cv2.line(picture, (0, 100), (SIZE[1], 260), (0.2, 0.1, 0.15), 24)
    found = seen(picture)
    assert [found[f"vein {k}"] for k in "rgb"] == pytest.approx([0.2, 0.1, 0.15], rel=0.1)
    length = float(np.hypot(SIZE[1], 160))
    assert found["vein share"] == pytest.approx(24 * length / (SIZE[0] * SIZE[1]), rel=0.15)


def test_a_wide_artery_is_no_vein_though_it_is_dark() -> None:
    picture = tissue()
    cv2.line(picture, (0, 100), (SIZE[1], 160), (0.26, 0.05, 0.05), 16)
    found = seen(picture)
    assert np.isnan(found["vein r"])


def test_noise_of_known_size_is_found_and_blur_lowers_sharpness() -> None:
    picture = encoded(lines(8, 3)).astype(float)
    noise = 3 * np.random.default_rng(1).standard_normal(SIZE)[..., None]
    noisy = np.clip(picture + noise, 0, 255).astype(np.uint8)
    usable = np.ones(SIZE, bool)
    assert measure(View.whole(noisy, usable, MM))["noise"] == pytest.approx(3, rel=0.15)
    sharp = measure(View.whole(picture.astype(np.uint8), usable, MM))
    soft = measure(View.whole(cv2.GaussianBlur(picture, (0, 0), 1.5).astype(np.uint8), usable, MM))
    assert soft["sharpness"] < 0.7 * sharp["sharpness"]
    assert soft["noise"] < sharp["noise"]


def test_highlights_are_counted_and_long_ones_known() -> None:
    picture = tissue()
    for x in (60, 200, 340):
        picture[100:106, x : x + 24] = 1.0
    found = highlights(encoded(picture))
    assert found.sum() == 3 * 6 * 24
    told = seen(picture)
    assert told["highlight share"] == pytest.approx(found.mean())
    assert told["highlight area"] == pytest.approx(144 * MM**2)
    assert told["highlight elongation"] == pytest.approx(4, rel=0.05)


def test_pixels_that_are_not_usable_do_not_count() -> None:
    picture = tissue()
    picture[:, 240:] = (0.1, 0.1, 0.6)
    usable = np.zeros(SIZE, bool)
    usable[:, :230] = True
    found = measure(View.whole(encoded(picture), usable, MM))
    assert found["crown r"] == pytest.approx(0.8, rel=0.02)
    assert found["crown b"] == pytest.approx(0.4, rel=0.02)


def test_distance_is_of_relative_differences() -> None:
    one = {"crown r": 0.8, "vignette": 0.2, "vein r": np.nan}
    assert parameters.distance(one, one) == 0
    other = {"crown r": 0.8 * np.e**0.3, "vignette": 0.2, "vein r": 0.4}
    assert parameters.distance(one, other) == pytest.approx(0.3 / np.sqrt(2))
    assert parameters.distance({"vignette": 9.0}, {"vignette": 0.0}) == 1.5
