"""The whole way from a folder to score.json and report.html, displacement and force being known."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fake_recording import Bump, Maker
from rich.console import Console
from typer.testing import CliRunner

from bench.cli import app
from bench.methods.protocol import Answer
from bench.recording import pixel_scale
from bench.recording.folder import open_recording
from bench.scoring import evaluate_recording, metrics, report
from bench.scoring.evaluate_recording import Result, Settings


def run(folder: Path, shrink: int = 1) -> Result:
    recording = open_recording(folder)
    found = pixel_scale.find_scale(recording.meta, folder)
    return evaluate_recording.evaluate_recording(
        recording, {"bump": Bump()}, "bump", found, Settings(shrink=shrink, rate_hz=None), {}
    )


@pytest.mark.parametrize("footage", ["png", "mp4"])
def test_force_is_recovered_from_the_video(make: Maker, footage: str) -> None:
    scores = run(make(footage=footage)).methods["bump"].scores
    assert scores["r"] > 0.998
    assert scores["mae_mn"] < 8  # of 120: TV-L1 flattens peaks of a few pixels
    assert abs(scores["lag_s"]) <= 0.025
    assert scores["contact_f1"] == 1
    assert scores["ghost_rate"] == 0


@pytest.mark.slow
def test_shrunken_flow_keeps_its_unit(make: Maker) -> None:
    folder = make(frames=8, size=(192, 256))
    whole, half = run(folder).methods["bump"].size_mn, run(folder, shrink=2).methods["bump"].size_mn
    # Bump reads pixels, which shrink with the picture: half the displacement in px, hence half the force.
    assert half[3:] == pytest.approx(0.5 * whole[3:], rel=0.2, abs=3)


def test_fast_footage_is_thinned_and_large_pictures_shrunk(make: Maker) -> None:
    folder = make(frames=13, fps=40.0, size=(96, 640))
    recording = open_recording(folder)
    found = pixel_scale.find_scale(recording.meta, folder)
    result = evaluate_recording.evaluate_recording(recording, {"bump": Bump()}, "bump", found, Settings(), {})
    assert result.followed.frame == [0, 4, 8, 12]
    assert result.followed.tissue is not None
    assert result.followed.tissue.shape == (48, 320)
    assert "9 of 13 frames beyond 10 a second left out" in result.notes
    told = [
        note for note in result.notes if "heart and breath were not looked for: the 3 frames over" in note
    ]
    assert len(told) == 1, "a beat may be in so short a film"


def test_frames_before_rest_are_left_out_and_said(make: Maker) -> None:
    result = run(make(frames=10, meta={"rest_frame": 2}))
    assert result.followed.frame == list(range(2, 10))
    assert any("before the rest frame" in note for note in result.notes)


def test_sensor_gap_is_not_scored(make: Maker) -> None:
    folder = make(frames=20)
    rows = (folder / "force.csv").read_text().splitlines()
    (folder / "force.csv").write_text("\n".join(rows[:51] + rows[120:]) + "\n")  # 0.5 s to 1.2 s gone
    result = run(folder)
    assert result.sensor_mn is not None
    missing = ~np.isfinite(result.sensor_mn)
    assert missing.tolist() == [0.49 < t < 1.185 for t in result.time_s]
    assert any("covers" in note for note in result.notes)


def test_without_forces_predictions_only(make: Maker, tmp_path: Path) -> None:
    result = run(make(frames=6, force=False))
    assert result.methods["bump"].scores == {}
    assert any("predictions only" in note for note in result.notes)
    report.write_report(result, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert "nothing is scored" in page
    assert 'id="scatter"' not in page


def test_json_has_no_nan_and_the_page_stands_alone(make: Maker, tmp_path: Path) -> None:
    result = run(make(frames=12))
    evaluate_recording.write_json(result, tmp_path / "score.json")
    tree = json.loads((tmp_path / "score.json").read_text(), parse_constant=lambda name: pytest.fail(name))
    assert tree["scores"]["n"] == 12
    assert len(tree["curve"]["predicted_mn"]["bump"]) == 12
    report.write_report(result, tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count("plotly.js v") == 1
    for outside in ('src="http', "src='http", 'href="http', "@import"):
        assert outside not in page.split("<script>")[0]


@pytest.mark.parametrize("force", [True, False])
def test_the_terminals_table_keeps_its_units(
    make: Maker, force: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    Console(width=80).print(report.terminal_table(run(make(frames=6, force=force))))
    assert "[mN]" in capsys.readouterr().out


def test_page_escapes_what_a_recording_says(make: Maker) -> None:
    result = run(make(frames=5, meta={"specimen": "<script>alert(1)</script>"}))
    page = report.render_report(result, "</title><script>alert(2)</script>")
    assert "<script>alert" not in page


def test_a_method_that_loses_says_so(make: Maker) -> None:
    class Half(Bump):
        def __call__(self, *args: object) -> Answer:  # type: ignore[override]
            return Answer(0.5 * super().__call__(*args).force_mn)  # type: ignore[arg-type]

    folder = make(frames=15)
    recording = open_recording(folder)
    methods = {"net": Half(), "simple": Bump()}
    result = evaluate_recording.evaluate_recording(
        recording, methods, "net", pixel_scale.find_scale(recording.meta, folder), Settings(), {}
    )
    lost_to = report.beaten_by(result)
    assert lost_to[-1] == "simple"
    assert set(lost_to) <= {"mean |flow|", "peak |flow|", "simple"}
    page = report.render_report(result, "t")
    assert "net loses on mean absolute error to: mean |flow| (its gain set in hindsight)" in page


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda f: (f / "meta.yaml").unlink(), "meta.yaml: missing"),
        (lambda f: (f / "video.mp4").write_bytes(b"no video"), "not a readable video"),
        (lambda f: (f / "video.mp4").unlink(), "neither video.mp4 nor frames"),
        (lambda f: (f / "force.csv").write_text("t_s,fx_n\n0,1\n"), "missing column fy_n, fz_n"),
    ],
)
def test_bad_recording_is_one_line_and_exit_2(make: Maker, tmp_path: Path, spoil: object, said: str) -> None:
    folder = make(frames=3, footage="mp4")
    assert callable(spoil)
    spoil(folder)
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["score", str(folder), "--model", str(tmp_path / "none"), "-o", str(out)]
    )
    assert result.exit_code == 2
    assert said in " ".join(result.output.split())
    assert not out.exists()


@pytest.mark.slow
def test_without_stiffness_only_what_no_factor_changes_is_scored(make: Maker) -> None:
    folder = make(frames=30, meta={"young_kpa": "unknown", "press_s": [0.2, 1.2]})
    result = run(folder)
    scores, calibrated = result.methods["bump"].scores, result.methods["bump"].calibrated
    assert scores["r"] > 0.99
    assert all(np.isnan(scores[key]) for key in ("mae_mn", "rmse_mn", "ccc", "r2", "gain", "contact_f1"))
    assert set(result.methods["bump"].intervals) == {"r"}
    assert calibrated["mae_mn"] < 10  # the press's gain gives newtons back
    assert 'id="bland"' not in report.render_report(result, "t")


def test_a_contact_ends_where_samples_are_left_out() -> None:
    time = np.arange(100) / 10.0
    force = np.full(100, 50.0)
    force[:5] = 0
    kept = np.ones(100, bool)
    kept[40:60] = False
    _, events = metrics.compute_all(time, force, force, 0.0, kept)
    assert [(event["from_s"], event["to_s"]) for event in events] == [(0.5, 3.9), (6.0, 9.9)]
