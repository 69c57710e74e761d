"""The correction of flow: its features against closed forms, its gain on pictures that are not rendered."""

import cv2
import numpy as np

from evidence.flow.scenes import Recipe, noise_field, pairs
from synth.flow import correction
from synth.flow.tvl1 import Tvl1


def _described(mirrored: bool) -> np.ndarray:
    """Features of a texture that moved by (0.4, -0.25) px, with a flow of (0, 0)."""
    rng = np.random.default_rng(3)
    coloured = np.stack([128 + 30 * noise_field((104, 88), 12, rng) for _ in range(3)], -1)
    shift = np.float32([[1, 0, 0.4], [0, 1, -0.25]])
    moved = cv2.warpAffine(coloured, shift, (88, 104), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    pictures = np.clip([coloured, moved], 0, 255).astype(np.uint8)
    rest, now = np.ascontiguousarray(pictures[:, :, :: -1 if mirrored else 1])
    greys = rest[..., 1] / np.float32(12), now[..., 1] / np.float32(12)
    every, flow = np.ones((104, 88), bool), np.zeros((104, 88, 2), np.float32)
    return correction.describe(rest, now, every, greys, np.float32(every), flow, np.float32(every))


def test_features_hold_the_remaining_step_and_mirroring_changes_vectors_only() -> None:
    features, mirrored = _described(mirrored=False), _described(mirrored=True)
    assert features.shape == (correction.CHANNELS, 26, 22)
    for x, y in correction.VECTORS[:4]:
        np.testing.assert_allclose(np.median(features[x, 3:-3, 3:-3]), 0.4, atol=0.05)
        np.testing.assert_allclose(np.median(features[y, 3:-3, 3:-3]), -0.25, atol=0.05)
    signs = np.ones((correction.CHANNELS, 1, 1))
    signs[[x for x, _ in correction.VECTORS]] = -1
    np.testing.assert_allclose(signs * mirrored[..., ::-1], features, atol=0.02)


def test_correction_lowers_the_error_on_pictures_that_are_not_rendered() -> None:
    errors = []
    for pair in pairs(Recipe(), 3, 23):
        pictures = pair.rest, pair.now, pair.rest_usable, pair.now_usable
        flows = [Tvl1(corrected=on).flow(*pictures)[0] for on in (False, True)]
        off = [np.linalg.norm(flow - pair.flow, axis=-1)[pair.contact & ~pair.hidden] for flow in flows]
        errors.append([one.mean() for one in off])
    before, after = np.mean(errors, axis=0)
    assert after < before
