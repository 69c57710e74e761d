"""OpenCV's estimators against translations, detection of masks, and estimators of plug-ins."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_package

from evidence.flow.scenes import Recipe, cortex, pairs
from synth.errors import UserError
from synth.flow import estimator, mask_detection, toolnet, track
from synth.job.schema import Job
from synth.plugins import ESTIMATORS


@pytest.mark.parametrize(("name", "bound_px"), [("opencv-tvl1", 0.05), ("dis", 0.08)])
def test_translation(name: str, bound_px: float) -> None:
    fine = np.round(255 * cortex(320, np.random.default_rng(3))).astype(np.uint8)
    rest, now = fine[40:200, 40:200], fine[37:197, 35:195]  # the picture moves by +5, +3
    every = np.ones((160, 160), bool)
    flow, confidence = estimator.create(name).flow(rest, now, every, every)
    inner = (slice(20, -20), slice(20, -20))
    assert np.linalg.norm(flow - [5.0, 3.0], axis=-1)[inner].mean() < bound_px
    assert confidence[inner].min() > 0.9
    assert flow.dtype == np.float32


def test_glare_is_found() -> None:
    """A bright, soft spot on tissue is glare; pale tissue and a global change of brightness are not."""
    tissue = np.broadcast_to(np.array([200, 150, 120], np.uint8), (120, 160, 3)).copy()
    for gain in (0.7, 1.0, 1.15):
        assert not mask_detection.glare(np.clip(gain * tissue.astype(float), 0, 255).astype(np.uint8)).any()
    y, x = np.mgrid[:120, :160]
    spot = np.exp(-((x - 70) ** 2 + (y - 50) ** 2) / (2 * 4.0**2))[..., None]
    wet = np.clip(tissue + 200 * spot, 0, 255).astype(np.uint8)
    found = mask_detection.glare(wet)
    assert found[50, 70]
    assert found[spot[..., 0] > 0.3].all()
    assert found.mean() < 0.03


def test_tool_is_found_without_weights() -> None:
    (pair,) = pairs(Recipe(highlights=0.0), 1, 2)
    found, tool = mask_detection.grey_bodies(pair.now), ~pair.now_usable  # without highlights
    assert np.count_nonzero(found & tool) / np.count_nonzero(found | tool) > 0.6
    assert not mask_detection.grey_bodies(pair.rest).any()
    blocked = mask_detection.blocked(pair.now)
    assert blocked[tool].mean() > 0.8
    assert blocked.mean() < 0.2


def test_bundled_weights_are_small_and_those_of_their_card() -> None:
    card = json.loads(toolnet.WEIGHTS.with_suffix(".json").read_text())
    assert toolnet.WEIGHTS.stat().st_size <= 2_000_000
    net = toolnet.load()
    assert sum(p.numel() for p in net.parameters()) == card["parameters"]


_PLUGIN = """
import numpy as np

class Learned:
    def flow(self, rest, now, rest_usable, now_usable, initial=None):
        moved = np.broadcast_to(np.float32([1, -2]), (*rest.shape[:2], 2))
        return moved, (rest_usable & now_usable).astype(np.float32)
"""


def test_the_estimator_of_a_plug_in_is_found_by_its_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError):
        estimator.create("my-net")
    points = {ESTIMATORS.group: {"my-net": "learned_flow:Learned"}}
    tiny_package.install(tmp_path, "learned_flow", _PLUGIN, points, monkeypatch)
    assert "my-net" in ESTIMATORS.names()
    assert Job.model_validate({"flow": {"backend": "my-net"}}).flow.backend == "my-net"
    frames = np.zeros((2, 24, 32, 3), np.uint8)
    found = track.track("my-net", frames, np.zeros((2, 24, 32), bool), np.ones((24, 32), bool))
    np.testing.assert_array_equal(found.flow[1], np.broadcast_to([1.0, -2.0], (24, 32, 2)))
    assert found.trusted.all()


@pytest.mark.parametrize("wrong", ["f, 1.5 * c", "f, c - 1.5", "np.nan * f, c", "f[1:], c", "f", "exit(0)"])
def test_invalid_results_of_an_estimator_are_reported_with_its_name(wrong: str) -> None:
    class Wrong:
        def flow(self, rest: Any, *others: Any) -> Any:
            return eval(wrong, {"np": np, "f": np.zeros((24, 32, 2)), "c": np.ones((24, 32))})

    frames = np.zeros((2, 24, 32, 3), np.uint8)
    with pytest.raises(UserError, match="Wrong"):
        track.track(Wrong(), frames, np.zeros((2, 24, 32), bool), np.ones((24, 32), bool))
