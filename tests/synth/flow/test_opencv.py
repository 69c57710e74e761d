"""OpenCV's estimators behind the protocol, against warps known in closed form."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from evidence.flow.scenes import CLEAN, Recipe, Stage, cortex, pairs
from synth.errors import UserError
from synth.flow import estimator, mask, opencv, toolnet, track
from synth.job.schema import Job


def _error(flow: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(flow - truth, axis=-1)


@pytest.mark.parametrize(("name", "bound_px"), [("opencv-tvl1", 0.05), ("dis", 0.08)])
def test_translation(name: str, bound_px: float) -> None:
    fine = np.round(255 * cortex(320, np.random.default_rng(3))).astype(np.uint8)
    rest, now = fine[40:200, 40:200], fine[37:197, 35:195]  # the picture moves by +5, +3
    every = np.ones((160, 160), bool)
    flow, confidence = estimator.create(name).flow(rest, now, every, every)
    inner = (slice(20, -20), slice(20, -20))
    assert _error(flow, np.array([5.0, 3.0]))[inner].mean() < bound_px
    assert confidence[inner].min() > 0.9
    assert flow.dtype == np.float32


def test_pull_with_tool_and_highlights() -> None:
    found = [
        _error(opencv.OpenCvTvl1().flow(p.rest, p.now, p.rest_usable, p.now_usable)[0], p.flow)[
            ~p.hidden
        ].mean()
        for p in pairs(Recipe(), 2, 11)
    ]
    assert np.mean(found) < 0.3


def test_opencv_honours_its_parameters() -> None:
    """Levels and warps change the answer, and a deep pyramid is what a 10 px pull needs."""
    (pair,) = pairs(CLEAN, 1, 5)
    every = np.ones(pair.rest.shape[:2], bool)

    def error(**settings: int) -> float:
        flow, _ = opencv.OpenCvTvl1(**settings).flow(pair.rest, pair.now, every, every)
        return float(_error(flow, pair.flow).mean())

    assert error(levels=1) > 4 * error(levels=5)
    assert error(levels=5, warps=1) > 1.3 * error(levels=5, warps=3)


def test_initial_flow_is_used() -> None:
    (pair,) = pairs(CLEAN, 1, 5)
    every = np.ones(pair.rest.shape[:2], bool)
    single = opencv.OpenCvTvl1(levels=1, warps=1)
    cold = _error(single.flow(pair.rest, pair.now, every, every)[0], pair.flow).mean()
    warm = _error(single.flow(pair.rest, pair.now, every, every, pair.flow)[0], pair.flow).mean()
    assert warm < 0.15 < cold


@pytest.mark.parametrize("size", [(1, 1), (2, 40), (17, 9)])
def test_small_pictures(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (*size, 3), dtype=np.uint8)
    every = np.ones(size, bool)
    for name in ("opencv-tvl1", "dis"):
        flow, confidence = estimator.create(name).flow(picture, picture, every, every)
        assert flow.shape == (*size, 2)
        assert np.isfinite(flow).all()
        assert np.isfinite(confidence).all()


def test_everything_masked_is_finite_and_not_trusted() -> None:
    picture = np.full((64, 64, 3), 128, np.uint8)
    none = np.zeros((64, 64), bool)
    for name in ("opencv-tvl1", "dis"):
        flow, confidence = estimator.create(name).flow(picture, picture, none, none)
        assert np.isfinite(flow).all()
        assert confidence.max() == 0


def test_track_follows_a_pull() -> None:
    rng = np.random.default_rng(7)
    stage = Stage.set(Recipe(size=128, pull=8.0), rng)
    rest = stage.rest(rng)
    shots = [stage.against(rest, share, rng) for share in np.linspace(0, 1, 5)]
    frames = np.stack([rest[0]] + [shot.now for shot in shots[1:]])
    blocked = np.stack([rest[1]] + [~shot.now_usable for shot in shots[1:]])
    tissue = np.ones((128, 128), bool)
    tissue[:, :10] = False
    found = track.track("opencv-tvl1", frames, blocked, tissue)
    assert found.flow.shape == (5, 128, 128, 2)
    assert not found.flow[0].any()
    assert not found.flow[:, :, :10].any()
    assert not found.confidence[:, :, :10].any()
    last = shots[-1]
    assert _error(found.flow[-1], last.flow)[tissue & ~last.hidden].mean() < 0.35


def test_track_refuses_what_does_not_fit() -> None:
    frames = np.zeros((2, 32, 32, 3), np.uint8)
    blocked = np.zeros((2, 32, 32), bool)
    with pytest.raises(UserError, match="no estimator"):
        track.track("farneback", frames, blocked, blocked[0])
    with pytest.raises(UserError, match="differ"):
        track.track("dis", frames, blocked, np.ones((16, 16), bool))
    with pytest.raises(UserError, match="masks"):
        track.track("dis", frames, blocked[:1], blocked[0])


def test_glare_is_found() -> None:
    """A bright, soft spot on tissue is glare; pale tissue and a global change of brightness are not."""
    tissue = np.broadcast_to(np.array([200, 150, 120], np.uint8), (120, 160, 3)).copy()
    for gain in (0.7, 1.0, 1.15):
        assert not mask.glare(np.clip(gain * tissue.astype(float), 0, 255).astype(np.uint8)).any()
    y, x = np.mgrid[:120, :160]
    spot = np.exp(-((x - 70) ** 2 + (y - 50) ** 2) / (2 * 4.0**2))[..., None]
    wet = np.clip(tissue + 200 * spot, 0, 255).astype(np.uint8)
    found = mask.glare(wet)
    assert found[50, 70]
    assert found[spot[..., 0] > 0.3].all()
    assert found.mean() < 0.03


def test_glare_of_the_benchmark() -> None:
    (pair,) = pairs(Recipe(tool=0.0, highlights=0.1), 1, 2)
    found = mask.glare(pair.now, dilate_px=1)
    bright = cv2.erode(pair.glare.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    assert found[bright].mean() > 0.97
    assert found[~pair.glare].mean() < 0.08


def test_tool_is_found_without_weights() -> None:
    (pair,) = pairs(Recipe(highlights=0.0), 1, 2)
    found = mask.grey_bodies(pair.now)
    assert np.count_nonzero(found & pair.tool) / np.count_nonzero(found | pair.tool) > 0.6
    assert not mask.grey_bodies(pair.rest).any()
    blocked = mask.blocked(pair.now)
    assert blocked[pair.tool].mean() > 0.8
    assert blocked.mean() < 0.2


def test_shipped_weights_are_small_say_what_made_them_and_beat_the_rule() -> None:
    card = json.loads(toolnet.WEIGHTS.with_suffix(".json").read_text())
    assert toolnet.WEIGHTS.stat().st_size <= 2_000_000
    assert "--seed" in card["command"]
    assert card["held_out_iou"] > card["held_out_iou_of_the_rule"]
    net = toolnet.load()
    assert net is not None
    assert sum(p.numel() for p in net.parameters()) == card["parameters"]


def test_without_weights_the_rule_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    (pair,) = pairs(Recipe(highlights=0.0), 1, 2)
    monkeypatch.setattr(toolnet, "load", lambda: None)
    assert mask.tool(pair.now)[pair.tool].mean() > 0.8


_PLUGIN = """
import numpy as np
import torch

class Learned:
    def __init__(self):
        self.net = torch.nn.Linear(1, 2)
        with torch.no_grad():
            self.net.weight.zero_()
            self.net.bias.copy_(torch.tensor([1.0, -2.0]))

    def flow(self, rest, now, rest_usable, now_usable, initial=None):
        with torch.inference_mode():
            moved = self.net(torch.ones(*rest.shape[:2], 1)).numpy()
        return moved, (rest_usable & now_usable).astype(np.float32)
"""


def test_another_packages_estimator_is_found_by_its_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "learned_flow.py").write_text(_PLUGIN)
    about = tmp_path / "learned_flow-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: learned-flow\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[sulcus.flow]\nmy-net = learned_flow:Learned\n")
    with pytest.raises(UserError, match="no estimator"):
        estimator.create("my-net")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert "my-net" in estimator.names()
    assert Job.model_validate({"flow": {"backend": "my-net"}}).flow.backend == "my-net"
    frames = np.zeros((2, 24, 32, 3), np.uint8)
    found = track.track("my-net", frames, np.zeros((2, 24, 32), bool), np.ones((24, 32), bool))
    np.testing.assert_array_equal(found.flow[1], np.broadcast_to([1.0, -2.0], (24, 32, 2)))
    assert found.trusted.all()


def test_opencv_gives_one_answer_to_one_input() -> None:
    (pair,) = pairs(Recipe(size=128), 1, 13)
    for name in ("opencv-tvl1", "dis"):
        flows = [estimator.create(name).flow(pair.rest, pair.now, pair.rest_usable, pair.now_usable)[0]
                 for _ in range(5)]  # fmt: skip
        for flow in flows[1:]:
            np.testing.assert_array_equal(flow, flows[0], err_msg=name)
