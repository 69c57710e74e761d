"""OpenCV's estimators against translations, and estimators of plug-ins."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_package
from warped_cortex import cortex

from synth.errors import UserError
from synth.flow import estimator, track
from synth.job.schema import Job
from synth.plugins import ESTIMATORS


@pytest.mark.parametrize(("name", "bound_px"), [("opencv-tvl1", 0.05), ("dis", 0.08)])
def test_translation(name: str, bound_px: float) -> None:
    picture = np.round(255 * cortex(320, np.random.default_rng(3))).astype(np.uint8)
    rest, now = picture[40:200, 40:200], picture[37:197, 35:195]  # the picture moves by +5, +3
    full_mask = np.ones((160, 160), bool)
    flow, confidence = estimator.create(name).flow(rest, now, full_mask, full_mask)
    inner = (slice(20, -20), slice(20, -20))
    assert np.linalg.norm(flow - [5.0, 3.0], axis=-1)[inner].mean() < bound_px
    assert confidence[inner].min() > 0.9
    assert flow.dtype == np.float32


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
    entry_points = {ESTIMATORS.group: {"my-net": "learned_flow:Learned"}}
    tiny_package.install(tmp_path, "learned_flow", _PLUGIN, entry_points, monkeypatch)
    assert "my-net" in ESTIMATORS.names()
    assert Job.model_validate({"flow": {"backend": "my-net"}}).flow.backend == "my-net"
    frames = np.zeros((2, 24, 32, 3), np.uint8)
    result = track.track("my-net", frames, np.zeros((2, 24, 32), bool), np.ones((24, 32), bool))
    np.testing.assert_array_equal(result.flow[1], np.broadcast_to([1.0, -2.0], (24, 32, 2)))
    assert result.trusted.all()


@pytest.mark.parametrize(
    "expression", ["f, 1.5 * c", "f, c - 1.5", "np.nan * f, c", "f[1:], c", "f", "exit(0)"]
)
def test_invalid_results_of_an_estimator_are_reported_with_its_name(expression: str) -> None:
    class Wrong:
        def flow(self, rest: Any, *others: Any) -> Any:
            return eval(expression, {"np": np, "f": np.zeros((24, 32, 2)), "c": np.ones((24, 32))})

    frames = np.zeros((2, 24, 32, 3), np.uint8)
    with pytest.raises(UserError, match="Wrong"):
        track.track(Wrong(), frames, np.zeros((2, 24, 32), bool), np.ones((24, 32), bool))
