"""The headline of a report: no numbers for lost recordings, relative scores without E, the press first."""

import math
import re
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

import fake_intervals
import numpy as np
import pytest
from fake_model import write_model
from fake_recording import GAIN_MN_PER_PX, Bump, Maker, force_curve, score_recording

from bench.methods.flow_size import flow_sizes
from bench.methods.force_fusion import Fusion
from bench.methods.force_interval import VideoEstimates, read_table
from bench.methods.method_interface import ForceEstimate, Method, MethodContext
from bench.methods.network import Model
from bench.scoring import charts
from bench.scoring.answers import answer, find_gains
from bench.scoring.headline import headline
from bench.scoring.result import Result, as_json
from bench.scoring.score_report import render_report
from learn.checkpoint import read_card, write_card
from synth.arrays import Mask, Pixels
from synth.flow.estimator import name_motion
from synth.flow.recording.flow import LocalFlow
from synth.flow.recording.frame_motion import FrameMotion


class KnownFlow(LocalFlow):
    """A flow proportional to the force, which loses the given frames."""

    def __init__(self, lost: set[int], fps: float = 10.0) -> None:
        self.lost, self.fps, self.frame = lost, fps, 0

    def begin(self, backend: str, rest: Pixels, masked: object, tissue: Mask) -> None:
        self.shape = tissue.shape

    def submit(self, rgb: Pixels, masked: object) -> Future[FrameMotion]:
        self.frame += 1
        y, x = np.mgrid[: self.shape[0], : self.shape[1]]
        bump = np.exp(-((x - 64) ** 2 + (y - 48) ** 2) / (2 * 17.0**2))
        peak = float(force_curve(np.array([self.frame / self.fps]))[0]) / GAIN_MN_PER_PX
        lost = self.frame in self.lost
        flow = np.zeros((*self.shape, 2), np.float32)
        flow[..., 0] = 50 * bump if lost else peak * bump
        future: Future[FrameMotion] = Future()
        future.set_result(FrameMotion(flow, np.full(self.shape, 0.1 if lost else 1.0, np.float32), not lost))
        return future


def run(folder: Path, lost: set[int] | None = None, **methods: Method) -> Result:
    return score_recording(folder, methods, flow_here=KnownFlow(lost or set()))


def test_lost_frames_are_not_scored_and_are_gaps_in_the_curves(make: Maker) -> None:
    complete, partial = run(make("whole")), run(make("some"), {7, 8, 20})
    assert complete.lost.sum() == 0
    method = partial.methods["bump"]
    assert np.flatnonzero(partial.lost).tolist() == [7, 8, 20]
    assert np.isnan(method.size_mn[partial.lost]).all(), "a lost frame has no estimate"
    # 50 px would be 2 N: it must not be in the average.
    assert method.scores["mae_mn"] < 1
    assert method.scores["n"] == 27
    assert method.scores["dropout"] == pytest.approx(0.1)
    assert "<svg" in charts.draw_force(partial)
    tree = as_json(partial)
    assert tree["lost"] == {"frames": 3, "share": 0.1, "most": 0.2}
    assert tree["curve"]["predicted_mn"]["bump"][7] is None
    assert headline(partial).refused == ""
    assert "tracking" in {finding.cause for finding in partial.findings}
    assert "frames" in headline(complete).trust
    assert "frames" not in headline(partial).trust, "nothing reassures over a finding"
    most = headline(run(make("most"), set(range(8, 16))))
    assert most.refused
    assert most.tiles == (), "no numbers with over a fifth lost"


def test_scale_uncertainty_counts_twice_as_force_is_proportional_to_its_square(make: Maker) -> None:
    result = run(make(frames=4, meta={"scale_uncertainty": 0.05, "young_uncertainty": 0.1}))
    assert result.relative_uncertainty == pytest.approx(math.hypot(0.10, 0.1))


def test_the_first_number_and_its_share_of_the_peak_are_of_the_same_score(make: Maker) -> None:
    for meta in ({}, {"press_s": [0.2, 1.2]}):
        result = run(make("pressed" if meta else "free", meta=meta))
        method = result.methods[result.main]
        scores, first = method.calibrated if meta else method.scores, headline(result)
        assert (first.tiles[0].value, first.of_peak) == (scores["mae_mn"], scores["mae_of_peak"])


def test_mean_and_peak_length_of_a_flow() -> None:
    flow = np.zeros((10, 20, 2), np.float32)
    flow[..., 0] = np.arange(200).reshape(10, 20)
    visible = np.ones((10, 20), np.float32)
    visible[5:] = 0
    scene = MethodContext(np.ones((10, 20), bool), 0.5, None)
    frame = FrameMotion(flow, visible)
    sizes = {name: method(frame, scene, False).force_mn[0] for name, method in flow_sizes().items()}
    lengths = 0.5 * np.arange(200)  # hidden tissue counts with its filled-in flow
    assert sizes == pytest.approx({"mean |flow|": lengths.mean(), "peak |flow|": np.percentile(lengths, 98)})
    nothing = flow_sizes()["mean |flow|"](FrameMotion(flow, np.zeros_like(visible)), scene, False)
    assert math.isnan(nothing.force_mn[0])


def test_shape_error_of_a_wrong_curve(make: Maker) -> None:
    result = run(make(), late=lambda *inputs: ForceEstimate(np.sqrt(Bump()(*inputs).force_mn)))
    # min over g of mean |g sqrt(x) - x| / mean peak, x being the half-waves.
    x = force_curve(np.arange(30) / 10)
    g = float(x @ np.sqrt(x) / x.sum())
    peak = np.mean([x[:12].max(), x[12:].max()])
    expected = np.abs(g * np.sqrt(x) - x).mean() / peak
    assert result.methods["late"].scores["shape_error"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("motion", [name_motion("tvl1"), "tvl1 0"])
def test_an_interval_has_a_level_for_motion_as_in_training(motion: str, make: Maker, tmp_path: Path) -> None:
    folder = write_model(tmp_path / "model", "arch.output=vector")
    write_card(folder, replace(read_card(folder), motion=[motion], intervals=fake_intervals.make()))
    result = run(make(), network=Model(folder), fusion=Fusion("network", "bump"), bump=Bump())
    methods = as_json(result)["methods"]
    assert ("level" in methods["network"]["interval"]) == (motion != "tvl1 0")
    assert "interval" not in methods["fusion"]
    for note in read_card(folder).doubt(name_motion("tvl1")):
        assert headline(result).warnings[0] == note
        assert render_report(result).count(note) == 1


class Bounded(Bump):
    """A method whose estimates are out of its range."""

    warnings = ("beyond the range",)


def test_the_range_of_the_method_that_the_result_is_about_is_a_finding(make: Maker) -> None:
    folder = make(frames=4)
    for first, second in ((Bump(), Bounded()), (Bounded(), Bump())):
        result = run(folder, first=first, second=second)
        messages = [finding.message for finding in result.findings if finding.message in Bounded.warnings]
        assert len(messages) == isinstance(first, Bounded)
        assert f"second: {Bounded.warnings[0]}" in result.notes or isinstance(first, Bounded)


def test_ambiguous_clocks_are_refused_and_scored_at_the_stated_offset(make: Maker) -> None:
    # Presses every two seconds fit equally at -2, 0 and 2 s.
    about = {"sync": {"method": "correlate", "calibration_s": [3.0, 9.0], "search_s": 2.5}}
    folder = make(frames=130, meta=about)
    result = run(folder)
    assert "ambiguous" in result.sync.refused
    assert "clocks" in {finding.cause for finding in result.findings}
    assert result.methods["bump"].scores["r"] > 0.99, "scored at the stated offset"


def test_the_first_screen_has_four_answers_in_few_words(make: Maker) -> None:
    """Of a recording without findings and of one with many; the rest is folded away."""
    cases = ({7, 8, 20}, {"young_uncertainty": 0.2}), (set(range(3, 20)), {"scale_mm_per_px": 4.0})
    for lost, meta in cases:
        result = run(make(f"lost {len(lost)}", meta=meta), lost)
        page = render_report(result)
        body = re.sub(r"<svg.*?</svg>", "", page[page.index("<body>") :], flags=re.DOTALL)
        screen = re.sub(r"<[^>]+>", " ", body[: body.index("<details")])
        assert len(screen.split()) <= 120
        answers = answer(result)
        assert ("held back" in answers.interval) == bool(result.refused)
        assert len(answers.faults) <= 3
        assert bool(result.findings) == (answers.faults != ("nothing found",))


def test_what_is_not_stated_narrows_this_interval(make: Maker) -> None:
    result = run(make(), physics=Bump())
    curve = result.methods["physics"].size_mn
    video = VideoEstimates(curve, 0.1 * curve, 0.01 * curve, 1, 0.5)
    result.tracked.evidence, result.tracked.stated = video, (True, False, True, False)
    gains = find_gains(result, 10.0, 6.0, 14.0)
    ratios = read_table().stating
    is_narrower = {"camera": ratios["second camera"] < 0.98, "masks": ratios["statements"] ** 0.5 < 0.98}
    for word, is_known in is_narrower.items():
        assert any(word in line for line in gains) == is_known
    result.tracked.evidence = replace(video, cameras=2, stated=1.0)
    assert find_gains(result, 10.0, 6.0, 14.0) == ()
