"""Statistics of pictures against pictures whose statistics are known."""

import numpy as np
import pytest

from evidence.render.picture_statistics import distances, pool, spread, statistics, tiles


def grey(light: np.ndarray) -> np.ndarray:
    return np.repeat(np.clip(light, 0, 255).astype(np.uint8)[..., None], 3, axis=2)


def test_white_noise_has_a_flat_spectrum_and_gaussian_gradients() -> None:
    found = statistics(grey(128 + 12 * np.random.default_rng(0).standard_normal((256, 256))))
    assert found["spectrum slope"] == pytest.approx(0, abs=0.3)
    assert found["gradient kurtosis"] == pytest.approx(3, abs=0.15)
    assert found["a mean"] == pytest.approx(0, abs=0.1)


def test_a_spectrum_of_known_slope_is_found() -> None:
    rng = np.random.default_rng(1)
    frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.fftfreq(256)[None])
    frequency[0, 0] = 1
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((256, 256))) / frequency).real
    assert statistics(grey(128 + 30 * field / field.std()))["spectrum slope"] == pytest.approx(-2, abs=0.25)


def test_elongation_is_the_ratio_of_a_highlights_sides() -> None:
    light = np.full((200, 200), 150.0)
    light[20:24, 20:40] = 255
    light[100:104, 100:104] = 255
    light[150:153, 20:35] = 255
    assert statistics(grey(light))["highlight elongation"] == pytest.approx(5, rel=0.02), "of 1, 5 and 5"
    light[150:153, 20:35] = 150
    assert statistics(grey(light))["highlight elongation"] == pytest.approx((5 + 1) / 2, rel=0.02)


def test_highlights_are_counted_and_sized() -> None:
    light = np.full((200, 200), 150.0)
    light[20:24, 20:24] = 255
    light[100:108, 60:68] = 255
    found = statistics(grey(light))
    assert found["highlight share"] == pytest.approx((16 + 64) / 40_000)
    assert found["highlight area median"] == pytest.approx(40)


def test_tiles_lie_inside_the_mask() -> None:
    inside = np.zeros((160, 180), bool)
    inside[4:136, 10:143] = True
    picture = np.repeat(inside[..., None], 3, axis=2) * np.uint8(9)
    crops = tiles(picture, inside, side=128, step=1)
    assert len(crops) == 5 * 6
    assert min(crop.min() for crop in crops) == 9
    noise = np.random.default_rng(2).integers(80, 160, (3, 128, 128)).astype(float)
    pictures = [grey(light + 10 * k) for k, light in enumerate(noise)]
    low, middle, high = spread(pictures, pool(pictures))["L mean"]
    assert low < middle < high


def test_a_histogram_is_as_far_as_its_brightness() -> None:
    noise = np.random.default_rng(3).integers(80, 120, (64, 64)).astype(float)
    same, lighter = (
        distances(grey(noise), pool([grey(noise)])),
        distances(grey(noise + 60), pool([grey(noise)])),
    )
    assert same["L histogram"] < 0.5
    lift = statistics(grey(noise + 60))["L mean"] - statistics(grey(noise))["L mean"]
    assert lighter["L histogram"] == pytest.approx(lift, rel=0.05)
    assert lighter["a histogram"] < 0.5


def test_noise_is_the_spread_over_seeds_as_a_share_of_the_light() -> None:
    from types import SimpleNamespace

    from evidence.render import cost

    def frame(_: object, __: object, ___: object, seed: int) -> SimpleNamespace:
        light = np.random.default_rng(seed).normal(0.5, 0.05, (300, 300))
        light[:, :100] *= 100
        return SimpleNamespace(radiance=np.repeat(light[..., None], 3, axis=2))

    case = SimpleNamespace(studio=SimpleNamespace(frame=frame), vertices=None, tips=None, shafts=None)
    where = np.zeros((300, 300), bool)
    where[:, 100:] = True
    found = cost._noise(case, where)  # type: ignore[arg-type]
    # Of four draws: chi's mean with three degrees of freedom is 0.92 of the deviation.
    assert found["noise_mean"] == pytest.approx(0.1 * 0.921, rel=0.02)
    assert found["noise_median"] < found["noise_mean"]
