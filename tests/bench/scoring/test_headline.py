"""What a report says first: nothing of lost recordings, shapes without E, the press before all else."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from fake_recording import GAIN_MN_PER_PX, Bump, Maker, force_curve
from numpy.typing import NDArray
from typer.testing import CliRunner

from bench.methods.flow_size import flow_sizes
from bench.methods.protocol import Answer, Scene
from bench.recording import pixel_scale
from bench.recording.folder import open_recording
from bench.scoring import charts, evaluate_recording, pool, report
from bench.scoring.evaluate_recording import Result, Settings
from bench.scoring.headline import headline
from bench.sensor import clock_sync
from learn.inference.video_flow import Flags, FlowHere, Found, Rgb

SIZE = (96, 128)


class Known(FlowHere):
    """A flow that is in proportion to the force, and that loses the frames it is told to."""

    def __init__(self, lost: set[int], fps: float = 10.0) -> None:
        self.lost, self.fps, self.frame = lost, fps, 0

    def begin(self, backend: str, rest: Rgb, blocked: Flags, tissue: Flags) -> None:
        self.shape = tissue.shape

    def ask(self, rgb: Rgb, blocked: Flags) -> object:  # type: ignore[override]
        self.frame += 1
        y, x = np.mgrid[: self.shape[0], : self.shape[1]]
        bump = np.exp(-((x - 64) ** 2 + (y - 48) ** 2) / (2 * 17.0**2))
        peak = float(force_curve(np.array([self.frame / self.fps]))[0]) / GAIN_MN_PER_PX
        lost = self.frame in self.lost
        flow = np.zeros((*self.shape, 2), np.float32)
        flow[..., 0] = 50 * bump if lost else peak * bump
        return lambda: Found(flow, np.full(self.shape, 0.1 if lost else 1.0, np.float32), not lost)


def run(folder: Path, lost: set[int] | None = None) -> Result:
    recording = open_recording(folder)
    found = pixel_scale.find_scale(recording.meta, folder)
    settings = Settings(shrink=1, rate_hz=None)
    flow = Known(lost or set())
    return evaluate_recording.evaluate_recording(
        recording, {"bump": Bump()}, "bump", found, settings, {}, flow=flow
    )


def test_lost_frames_are_out_of_the_scores_gaps_in_the_curves_and_counted(make: Maker) -> None:
    whole, some = run(make("whole")), run(make("some"), {7, 8, 20})
    assert whole.lost.sum() == 0
    method = some.methods["bump"]
    assert np.flatnonzero(some.lost).tolist() == [7, 8, 20]
    assert np.isnan(method.size_mn[some.lost]).all(), "what was said of a lost frame is no answer"
    # 50 px would have been 2 N: an average over all frames knows of it, one over the followed ones doesn't.
    assert method.scores["mae_mn"] < 1
    assert method.scores["n"] == 27
    assert method.scores["dropout"] == pytest.approx(0.1)
    line = next(trace for trace in charts.draw_force(some)["data"] if trace["name"] == "bump")
    assert [k for k, value in enumerate(line["y"]) if value is None] == [7, 8, 20]
    assert len(charts.draw_force(some)["layout"]["shapes"]) == 2
    tree = evaluate_recording.as_json(some)
    assert tree["lost"] == {"frames": 3, "share": 0.1, "most": 0.2}
    assert tree["curve"]["predicted_mn"]["bump"][7] is None
    assert any("3 of 30 frames could not be followed" in note for note in some.notes)
    assert headline(some).refused == ""


def test_force_goes_with_the_scales_square_so_its_error_counts_twice(make: Maker) -> None:
    result = run(make(frames=4, meta={"scale_uncertainty": 0.05, "young_uncertainty": 0.1}))
    assert result.relative_uncertainty == pytest.approx(math.hypot(0.10, 0.1))


def test_lost_frames_have_no_part_in_the_clocks_search(make: Maker, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their flow of 50 px would be the largest motion of all, and into them and out of them."""
    asked: list[np.ndarray] = []

    def find(frame_s: object, speed: np.ndarray, *rest: object) -> clock_sync.Offset:
        asked.append(speed)
        return clock_sync.Offset(0.0, 1.0, 1.0, 0.0, "")

    monkeypatch.setattr(clock_sync, "find_offset", find)
    run(make(meta={"sync": {"method": "correlate", "calibration_s": [0, 2.05]}}), {7, 8, 20})
    assert np.flatnonzero(np.isnan(asked[0])).tolist() == [7, 8, 9, 20]


def test_over_a_fifth_lost_no_number_is_said_first(make: Maker) -> None:
    result = run(make(), set(range(8, 16)))
    said = headline(result)
    assert said.refused.startswith("27% of the frames")
    assert said.tiles == ()
    page = report.render_report(result, "t")
    assert "27% of the frames to be scored were lost" in page
    assert 'class="tile"' not in page


def test_lost_frames_that_are_not_scored_do_not_count(make: Maker) -> None:
    folder = make(meta={"press_s": [0.75, 1.65]})
    assert headline(run(folder, set(range(8, 16)))).refused == ""


@pytest.mark.parametrize("name", ["mean |flow|", "peak |flow|"])
def test_sizes_of_the_flow_are_in_every_table_with_one_gain(make: Maker, name: str) -> None:
    result = run(make())
    assert list(result.methods)[:3] == ["bump", "mean |flow|", "peak |flow|"]
    method = result.methods[name]
    assert method.gain is not None
    assert method.gain.source == "hindsight"
    # The flow is in proportion to the force, so one gain makes either exact.
    assert method.scores["mae_mn"] < 0.01
    assert method.scores["shape_error"] < 1e-4
    shown = {trace["name"]: trace.get("visible", True) for trace in charts.draw_force(result)["data"]}
    assert shown[name] is True


def test_mean_and_peak_of_a_flow_by_hand() -> None:
    flow = np.zeros((10, 20, 2), np.float32)
    flow[..., 0] = np.arange(200).reshape(10, 20)
    seen = np.ones((10, 20), np.float32)
    seen[5:] = 0
    scene = Scene(np.ones((10, 20), bool), 0.5, None)
    sizes = {name: method(flow, seen, scene, False).force_mn[0] for name, method in flow_sizes().items()}
    lengths = 0.5 * np.arange(200)  # what is hidden counts as it is filled in
    assert sizes == pytest.approx({"mean |flow|": lengths.mean(), "peak |flow|": np.percentile(lengths, 98)})
    nothing = flow_sizes()["mean |flow|"](flow, np.zeros_like(seen), scene, False)
    assert math.isnan(nothing.force_mn[0])


def test_the_presss_gain_is_taken_where_there_is_one(make: Maker) -> None:
    folder = make(meta={"press_s": [0.0, 1.3]})
    rows = [row.split(",") for row in (folder / "force.csv").read_text().splitlines()]
    for row in rows[1:]:  # after the press the sensor says half: a gain of the press is twice too large there
        if float(row[0]) > 1.35:
            row[1] = str(0.5 * float(row[1]))
    (folder / "force.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    method = run(folder).methods["mean |flow|"]
    assert method.gain is not None
    assert method.gain.source == "press"
    assert method.scores["gain"] == pytest.approx(2.0, abs=0.01)
    assert method.scores["shape_error"] < 1e-4


def test_scores_of_the_press_come_first(make: Maker) -> None:
    names = [tile.name for tile in headline(run(make(meta={"press_s": [0.2, 1.3]}))).tiles]
    assert names[:3] == [f"{what}, gain of the press" for what in ("MAE", "MAE of event peak", "R²")]
    assert "MAE" in names


def test_unknown_stiffness_shows_shapes_and_no_dash(make: Maker) -> None:
    result = run(make(meta={"young_kpa": "unknown"}))
    tiles = {tile.name: tile.value for tile in headline(result).tiles}
    assert tiles["r"] > 0.999
    assert tiles["shape error"] < 1e-3
    assert all(math.isfinite(value) for value in tiles.values())
    page = report.render_report(result, "t")
    assert "<th>MAE" not in page.split("<h2>Methods</h2>")[1].split("</table>")[0]
    assert "The sensor shows no contact" not in page
    assert "Young's modulus is unknown: the sensor" in page
    # All curves are brought to the sensor's height.
    curves = charts.scale_curves(result)
    assert curves.sensor is not None
    assert np.nanmax(curves.sensor) == pytest.approx(1.0)
    assert np.nanmax(curves.methods["bump"]) == pytest.approx(1.0, abs=0.01)
    assert curves.axis == "force / largest"


def test_a_shape_that_is_wrong_shows(make: Maker) -> None:
    class Late:
        """The bump, but square-rooted: another shape."""

        def __call__(
            self, flow: NDArray[np.float32], confidence: NDArray[np.float32], scene: Scene, picture: bool
        ) -> Answer:
            return Answer(np.sqrt(Bump()(flow, confidence, scene, picture).force_mn))

    folder = make()
    recording = open_recording(folder)
    result = evaluate_recording.evaluate_recording(
        recording, {"late": Late()}, "late", pixel_scale.find_scale(recording.meta, folder),
        Settings(shrink=1, rate_hz=None), {}, flow=Known(set()),
    )  # fmt: skip
    # min over g of mean |g sqrt(x) - x| / mean peak, x being the half-waves: by hand.
    x = force_curve(np.arange(30) / 10)
    g = float(x @ np.sqrt(x) / x.sum())
    peak = np.mean([x[:12].max(), x[12:].max()])
    expected = np.abs(g * np.sqrt(x) - x).mean() / peak
    assert result.methods["late"].scores["shape_error"] == pytest.approx(expected, rel=0.02)


def test_without_a_sensor_sizes_are_brought_to_the_main_method(make: Maker) -> None:
    result = run(make(force=False))
    gain = result.methods["mean |flow|"].gain
    assert gain is not None
    assert gain.source == "bump"
    assert np.nanmax(result.methods["mean |flow|"].size_mn) == pytest.approx(
        np.nanmax(result.methods["bump"].size_mn), rel=0.01
    )


def test_ambiguous_clocks_are_said_drawn_and_scored_as_stated(make: Maker, tmp_path: Path) -> None:
    # Presses every two seconds fit at -2, 0 and 2 s alike.
    about = {"sync": {"method": "correlate", "calibration_s": [3.0, 9.0], "search_s": 2.5}}
    folder = make(frames=130, meta=about)
    result = run(folder)
    assert result.sync is not None
    assert result.sync.refused
    assert not result.aligned
    assert result.methods["bump"].scores["r"] > 0.99, "scored all the same, at the stated clock"
    offsets, r = np.array(result.sync.correlogram).T
    assert offsets[[0, -1]] == pytest.approx([-2.5, 2.5], abs=0.02)
    near = [float(np.nanmax(r[np.abs(offsets - at) < 0.1])) for at in (-2, 0, 2)]
    assert min(near) > 0.9, near
    page = report.render_report(result, "t")
    assert 'id="correlogram"' in page
    assert "clocks could not be aligned" in page
    tree = evaluate_recording.as_json(result)
    assert tree["aligned"] is False
    (tmp_path / "score.json").write_text(json.dumps(tree))
    lone = json.loads(json.dumps(tree)) | {"recording": "other", "sync": None}
    pooled = pool.pool([tree, lone])
    assert pooled["recordings"] == ["other"]
    assert "clocks not aligned" in pooled["left_out"][tree["recording"]]


def test_the_terminal_says_what_is_lost(make: Maker, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import bench.cli
    from bench.scoring import commands

    result = run(make(), set(range(1, 20)))
    monkeypatch.setattr(commands, "score_recording", lambda *given: result)
    done = CliRunner().invoke(bench.cli.app, ["score", str(tmp_path), "--model", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "63% of the frames to be scored were lost" in done.output
