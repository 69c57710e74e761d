"""Features of known motions, and distances in samples of known covariance."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from sklearn.covariance import LedoitWolf
from sklearn.linear_model import Ridge

from learn.uncertainty import out_of_distribution
from learn.uncertainty.error_model import fit_error_model
from learn.uncertainty.features import FLOOR_MM, MOTION, motion_features
from learn.uncertainty.out_of_distribution import describe_out_of_distribution, fit_distribution

Floats = NDArray[np.float64]

EXTENT_MM = 32.0
MEAN = np.array([3.0, 1.0, -2.0])
MIX = np.array([[1.0, 0.0, 0.0], [0.5, 0.7, 0.0], [-0.2, 0.1, 0.4]])


def field(n: int, kind: str) -> NDArray[np.float32]:
    """(1, 2, n, n) mm: the whole picture moved by (0.3, 0.4) mm, or a stretch of 2% in x and 1% in y."""
    axis_mm = (np.arange(n) - (n - 1) / 2) * EXTENT_MM / n
    x, y = np.meshgrid(axis_mm, axis_mm)
    shift = (0.3 + 0 * x, 0.4 + 0 * y) if kind == "moved" else (0.02 * x, 0.01 * y)
    return np.stack(shift)[None].astype(np.float32)


def name_features(features: Floats) -> dict[str, float]:
    return dict(zip(MOTION, features[0].tolist(), strict=True))


@pytest.mark.parametrize("n", [32, 256])
def test_uniform_motion_has_no_divergence(n: int) -> None:
    features = name_features(motion_features(field(n, "moved"), np.ones((n, n), np.float32), None, EXTENT_MM))
    share = 0.5 / (0.5 + FLOOR_MM)
    assert features["log motion"] == pytest.approx(np.log(0.5 + FLOOR_MM), abs=1e-6)
    assert features["uniform share"] == pytest.approx(share, abs=1e-5)
    assert features["spread"] == pytest.approx(share, abs=1e-5)
    assert features["divergence"] == pytest.approx(np.log(FLOOR_MM / (0.5 + FLOOR_MM)), abs=1e-2)
    assert (features["confidence"], features["tissue share"]) == (1, 1)


@pytest.mark.parametrize("n", [32, 256])
def test_a_stretch_has_its_divergence(n: int) -> None:
    mask = np.ones((n, n), np.float32)
    mask[: n // 2] = 0
    confidence = np.full((1, 1, n, n), 0.25, np.float32)
    shift = np.where(mask > 0, field(n, "stretched"), np.float32(99))
    features = name_features(motion_features(shift, mask, confidence, EXTENT_MM))
    # Mean squares over the lower half, of width 32 and height 16 mm, the centre being at its upper edge.
    motion = np.sqrt(0.02**2 * 32**2 / 12 + 0.01**2 * 16**2 / 3)
    assert features["log motion"] == pytest.approx(np.log(motion + FLOOR_MM), abs=0.01)
    expected = np.log((10 * 0.03 + FLOOR_MM) / (motion + FLOOR_MM))
    assert features["divergence"] == pytest.approx(expected, abs=0.02)
    assert (features["confidence"], features["tissue share"]) == (0.25, 0.5)


@pytest.mark.filterwarnings("error")
def test_tissue_smaller_than_a_block_of_cells_has_features() -> None:
    mask = np.zeros((256, 256), np.float32)
    mask[100:102, 100:103] = 1
    features = name_features(motion_features(field(256, "moved"), mask, None, EXTENT_MM))
    assert np.isfinite([*features.values()]).all()
    assert features["tissue share"] == pytest.approx(6 / 256**2)


def cloud(rng: np.random.Generator, sequences: int, frames: int = 10) -> list[Floats]:
    """Moving frames of known middle and covariance."""
    return [MEAN + rng.normal(size=(frames, 3)) @ MIX.T for _ in range(sequences)]


def test_distance_is_mahalanobis_and_its_99th_that_of_chi_squared() -> None:
    rng = np.random.default_rng(0)
    distribution = fit_distribution(cloud(rng, 1000), cloud(rng, 1000))
    assert distribution.frame_limit == pytest.approx(np.sqrt(chi2.ppf(0.99, 3)), rel=0.03)
    outlier = MEAN[None] + 9 * MIX[:, 2]
    assert distribution.distance(outlier)[0] == pytest.approx(9.0, rel=0.03)
    assert distribution.relative_distance(outlier)[0] == pytest.approx(
        9.0 / distribution.frame_limit, rel=0.03
    )


def test_one_in_twenty_recordings_like_the_calibration_is_out_of_distribution() -> None:
    rng = np.random.default_rng(1)
    distribution = fit_distribution(cloud(rng, 300), cloud(rng, 300))
    distribution = distribution.calibrate(cloud(rng, 400, frames=6))
    flags = [
        bool(describe_out_of_distribution(distribution, "abc", frames))
        for frames in cloud(rng, 2000, frames=6)
    ]
    assert np.mean(flags) == pytest.approx(0.05, abs=0.025)
    # The feature that is far is named, though all three go together.
    outlier = cloud(rng, 1)[0] + np.array([0.0, 0.0, -9.0])
    (line,) = describe_out_of_distribution(distribution, ("one", "two", "three"), outlier)
    assert "three (low)" in line
    assert "one (" not in line


def test_frames_at_rest_have_no_distance() -> None:
    rng = np.random.default_rng(2)
    distribution = fit_distribution(cloud(rng, 20), cloud(rng, 20))
    assert distribution.distance(np.array([[-5.0, 80.0, 80.0]]))[0] == 0
    resting = [np.full((4, 3), -5.0)]
    assert fit_distribution(resting, cloud(rng, 3)) is None
    assert fit_distribution(cloud(rng, 3), resting) is None


@pytest.mark.parametrize("count", [12, 400])
def test_the_covariance_is_ledoits_and_wolfs(count: int) -> None:
    rng = np.random.default_rng(3)
    samples = rng.normal(size=(count, 8)) @ rng.normal(size=(8, 8)) + 5
    covariance = out_of_distribution.shrunk_covariance(samples)
    assert covariance == pytest.approx(LedoitWolf().fit(samples).covariance_, rel=1e-9)


def test_the_scale_is_a_ridges() -> None:
    rng = np.random.default_rng(4)
    features = rng.normal(size=(60, 3)) * [1, 10, 0.1] + [0, 5, 2]
    error, weight = np.exp(features[:, 0] + rng.normal(size=60)), rng.uniform(0.2, 2, 60)
    rule = fit_error_model(features, error, weight, 0.1)
    spread = features.std(0)
    theirs = Ridge().fit(features / spread, np.log(error + 0.1), sample_weight=weight / weight.mean())
    assert rule.slopes == pytest.approx(theirs.coef_ / spread, rel=1e-6)
    assert rule.intercept == pytest.approx(float(theirs.intercept_), rel=1e-6)
