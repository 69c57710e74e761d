"""Scoring from folder to score.json and report.html, with known displacement and force."""

import json
from pathlib import Path

import numpy as np
import pytest
from fake_recording import Maker, scored

from bench.scoring import metrics, report
from bench.scoring.score import write_result


@pytest.mark.parametrize("footage", ["png", "mp4"])
def test_force_is_recovered_from_the_video(make: Maker, footage: str) -> None:
    scores = scored(make(footage=footage)).methods["bump"].scores
    assert scores["r"] > 0.998
    assert scores["mae_mn"] < 8  # of 120: TV-L1 flattens peaks of a few pixels
    assert abs(scores["lag_s"]) <= 0.025
    assert scores["contact_f1"] == 1
    assert scores["false_positive_rate"] == 0


def test_fast_footage_is_thinned_and_large_pictures_shrunk(make: Maker) -> None:
    folder = make(frames=13, fps=40.0, size=(96, 640))
    result = scored(folder, shrink=0, rate_hz=10.0)
    assert result.tracked.frame == [0, 4, 8, 12]
    assert result.tracked.tissue is not None
    assert result.tracked.tissue.shape == (48, 320)


def test_sensor_gap_is_not_scored(make: Maker) -> None:
    folder = make(frames=20)
    rows = (folder / "force.csv").read_text().splitlines()
    (folder / "force.csv").write_text("\n".join(rows[:51] + rows[120:]) + "\n")  # 0.5 s to 1.2 s gone
    result = scored(folder)
    assert result.sensor_mn is not None
    missing = ~np.isfinite(result.sensor_mn)
    assert missing.tolist() == [0.49 < t < 1.185 for t in result.time_s]


def test_json_has_no_nan_and_the_page_stands_alone_and_escapes(make: Maker, tmp_path: Path) -> None:
    result = scored(make(frames=12, meta={"specimen": "<script>alert(1)</script>"}))
    write_result(result, tmp_path, "</title><script>alert(2)</script>")
    tree = json.loads((tmp_path / "score.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert tree["scores"]["n"] == 12
    assert len(tree["curve"]["predicted_mn"]["bump"]) == 12
    page = (tmp_path / "report.html").read_text()
    assert page.count("<svg") == 5
    for outside in ('src="http', "src='http", 'href="http', "@import", "<script>alert"):
        assert outside not in page


def test_without_stiffness_only_scores_independent_of_a_factor_are_reported(make: Maker) -> None:
    folder = make(frames=30, meta={"young_kpa": "unknown", "press_s": [0.2, 1.2]})
    result = scored(folder)
    scores, calibrated = result.methods["bump"].scores, result.methods["bump"].calibrated
    assert scores["r"] > 0.99
    assert all(np.isnan(scores[key]) for key in ("mae_mn", "rmse_mn", "ccc", "r2", "gain", "contact_f1"))
    assert set(result.methods["bump"].intervals) == {"r"}
    assert calibrated["mae_mn"] < 10  # after the press's gain forces are in newtons
    assert 'id="bland"' not in report.render_report(result, "t")


def test_a_contact_ends_at_samples_that_are_not_scored() -> None:
    time = np.arange(100) / 10.0
    force = np.full(100, 50.0)
    force[:5] = 0
    used = np.ones(100, bool)
    used[40:60] = False
    _, events = metrics.compute_all(time, force, force, 0.0, used)
    assert [(event["from_s"], event["to_s"]) for event in events] == [(0.5, 3.9), (6.0, 9.9)]
