"""Measurements of scoring, from pictures to scores, and of their parts."""

from pathlib import Path

import cv2
import numpy as np
import pulsating_tissue
import pytest
from fake_recording import Maker

from bench.methods import physics as physics_method
from bench.methods import posterior
from bench.methods.compliance import TissueKind
from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.methods.physics import GRID
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from bench.tracking.tracking import track_recording
from evidence.curves.models import coarsen
from evidence.pooled import copy_left
from evidence.scoring import degradations, exvivo, stability
from learn.data.clips import Clip
from learn.data.grid import Grid, GridView
from synth.flow.confidence import deviation
from synth.flow.recording.decode import RecordingFlowSettings
from synth.tune.search import change_job


@pytest.mark.trial
def test_a_stereo_stand_in_fits_its_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    job_of, coarse = exvivo.job_of, {"fem.tets": 600, "anatomy.vertices": 4000}
    monkeypatch.setattr(exvivo, "job_of", lambda plan: change_job(job_of(plan), coarse))
    plan = exvivo.Plan(seconds=18.0, fps=0.5, size=(96, 72))
    exvivo.make(plan, 0, tmp_path / "000")
    recording = open_recording(tmp_path / "000")
    left, right = list(recording.frames()), list(recording.right_frames())
    assert len(left) == len(right) == 9
    settings = RecordingFlowSettings("dis", shrink=1, rate_hz=None, pulse=False)
    tracked = track_recording(recording, {}, 35 / 96, settings)
    assert tracked.stereo is not None
    assert tracked.stereo.baseline_mm == pytest.approx(24.0, abs=1e-6)
    assert tracked.stereo.epipolar_px < 0.3, "the calibration fits the images"
    difference = np.abs(left[0].rgb.astype(int) - right[0].rgb.astype(int)).mean()
    assert difference > 4, "the cameras are in different places"
    copy_left(tmp_path / "000", tmp_path / "left")
    left_recording = open_recording(tmp_path / "left")
    assert left_recording.meta.stereo is None
    assert left_recording.meta.scale_mm_per_px == recording.meta.scale_mm_per_px
    np.testing.assert_array_equal(
        [frame.rgb for frame in left_recording.frames()], [frame.rgb for frame in left]
    )


@pytest.mark.trial
def test_a_pulsating_recording_scores_like_a_still_one(tmp_path: Path) -> None:
    def physics(frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        view, mm = GridView(scene.tissue, scene.scale_mm_per_px, GRID), np.float32(scene.scale_mm_per_px)
        displacement, confidence = view.mean(mm * frame.flow.transpose(2, 0, 1)), view.mean(frame.confidence)
        spread = np.broadcast_to(0.12 * deviation(confidence), displacement.shape)  # mm
        basis = posterior.load_basis(len(displacement), TissueKind())
        observation = physics_method.observe(displacement, spread, view.mask)
        mean = posterior.infer(basis, observation, np.zeros((len(displacement), 6, 0))).force.mean
        return ForceEstimate((scene.young_kpa or 1.0) * mean)

    size, name = 128, "physics, frame by frame"
    contact = pulsating_tissue.draw_contact(np.random.default_rng(3), 15.0, size)
    runs = {}
    for case, pulses, remove in (("still", 0, True), ("off", 1, True), ("in", 1, False)):
        folder = tmp_path / case
        pulsating_tissue.record(folder, contact, pulses, size, remove, np.random.default_rng(4))
        runs[case] = pulsating_tissue.score(folder, {name: physics}, "dis")
    assert runs["still"].tracked.pulse == []
    rates = [rhythm["rate_hz"] for rhythm in runs["off"].tracked.pulse]
    assert rates == pytest.approx([1.2, 0.25], rel=0.03)
    errors = {case: run.methods[name].scores["mae_mn"] for case, run in runs.items()}
    # The error is 0.9% of the peak without a pulse; the residual pulse adds another percent.
    sensor = runs["still"].sensor_mn
    assert sensor is not None
    peak = float(np.nanmax(sensor))
    assert errors["off"] < errors["still"] + 0.02 * peak
    assert errors["in"] > 1.5 * errors["still"], "the pulse must matter if it is not removed"


def test_a_coarser_grid_preserves_force_and_motion(clips: list[Clip]) -> None:
    coarse = coarsen(clips[2], 2)
    fine = clips[2].density.sum((2, 3)) * Grid(32).pitch_mm ** 2
    np.testing.assert_allclose(
        coarse.density.sum((2, 3)) * Grid(16).pitch_mm ** 2, fine, rtol=1e-4, atol=1e-6
    )
    largest = [np.abs(c.displacement["ideal"]).max() for c in (clips[2], coarse)]
    assert largest[1] == pytest.approx(largest[0], rel=0.1)


def test_neither_another_finding_nor_a_wide_interval_clears_a_wrong_force() -> None:
    row = {"error": 0.9, "over_time": 0.1, "usual_error": 0.05, "width": 2.0, "held": 1.0, "named": False}
    assert stability.judge(row) == "missed"
    assert stability.judge(row | {"width": 0.8}) == "harmless", "a narrow interval holds the true force"
    assert stability.judge(row | {"width": 0.8, "held": 0.5}) == "missed"
    assert stability.judge(row | {"usual_error": 0.85}) == "harmless", "the undegraded recording errs as much"
    assert stability.judge(row | {"error": 0.0}) == "harmless"
    assert stability.judge(row | {"error": 0.0, "over_time": 0.3}) == "missed"
    assert stability.judge(row | {"error": 0.0, "misnamed": True}) == "missed", "another cause is named"
    assert stability.judge(row | {"named": True}) == "named"
    assert stability.judge(row | {"error": None}) == "held back"
    assert stability.judge(row | {"named": None}) == "no cause to name"


def test_a_change_is_judged_by_its_worst_recording_and_a_wide_interval_is_vague() -> None:
    held_back_row = {"change": "a", "error": None, "named": False}
    named_row = {"change": "a", "error": 0.9, "named": True}
    missed_row = {"change": "b", "error": 0.9, "over_time": 0.1, "named": False}
    harmless_row = {"change": "c", "error": 0.0, "named": None}
    outcomes = stability.judge_all(
        [held_back_row, named_row, missed_row, held_back_row | {"change": "b"}, harmless_row]
    )
    assert outcomes == {"a": "held back", "b": "missed", "c": "no cause to name"}
    assert [stability.is_vague({"width": width}) for width in (None, 0.4, 1.6)] == [False, False, True]


def test_a_degraded_recording_states_what_its_case_does(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=24, meta={"membrane": "stripped"})
    meta = degradations.read_meta(folder)
    meta["sensor"]["free_s"] = [[0.0, 0.2]]
    recording_writer.write_meta(folder, meta)
    case = {"given": 2, "cameras": 2}
    base = stability.degrade(folder, None, case, tmp_path)
    assert "membrane" not in degradations.read_meta(base)
    before = [frame.rgb.copy() for frame in open_recording(base).frames()]
    change, _ = degradations.MONOCULAR["4 frames dropped"]
    degraded = open_recording(stability.degrade(folder, change, case, tmp_path))
    after = [frame.rgb.copy() for frame in degraded.frames()]
    assert len(after) == 20
    assert (after[8] == before[12]).all()


def test_each_degradation_changes_a_recording(tmp_path: Path) -> None:
    source = Maker(tmp_path)(frames=degradations.FRAMES, meta={"membrane": "stripped"})
    for part in ("right", "masks"):
        (source / part).mkdir(exist_ok=True)
    for k, file in enumerate(sorted((source / "frames").iterdir())):
        picture = cv2.imread(str(file))
        cv2.imwrite(str(source / "right" / file.name), picture[:, ::-1])
        mask = np.zeros(picture.shape[:2], np.uint8)
        mask[:, 2 * k : 2 * k + 10] = 255
        cv2.imwrite(str(source / "masks" / f"{k:06d}.png"), mask)
    meta = degradations.read_meta(source)
    recording_writer.write_meta(source, meta | {"sensor": meta["sensor"] | {"free_s": [[0.0, 0.2]]}})

    def read(folder: Path) -> dict[str, bytes]:
        files = (file for file in sorted(folder.rglob("*")) if file.is_file())
        return {str(file.relative_to(folder)): file.read_bytes() for file in files}

    case = {"given": 3, "cameras": 2}
    before = read(stability.degrade(source, None, case, tmp_path))
    for name, (change, _) in (degradations.MONOCULAR | degradations.STEREO).items():
        assert read(stability.degrade(source, change, case, tmp_path)) != before, name
