"""`learn predict`, `bench estimate` and `bench score` give the same forces for a video."""

import json
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from command import run
from fake_model import write_model
from fake_recording import Maker

import bench
import bench.cli
import learn.cli
import synth
from bench.methods import comparison
from bench.methods.relaxation import measure_share_left
from bench.tracking.estimate import apply_physics
from learn.inference.video_motion import Motion
from synth.flow.recording.frame_motion import FrameMotion
from synth.video.read_video import read_frames

FPS, SIZE = 25.0, (96, 704)


@pytest.mark.slow
@pytest.mark.parametrize(("output", "young"), [("vector", 2.0), ("magnitude", None)])
def test_predict_and_score_agree_at_every_frame(
    output: str, young: float | None, make: Maker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loss = ["loss=mse"] if output == "vector" else []
    model = write_model(tmp_path / "model", f"arch.output={output}", *loss)
    meta = {"young_kpa": "unknown" if young is None else young}
    folder = make(frames=13, fps=FPS, size=SIZE, footage="mp4", meta=meta)
    tissue = np.zeros(SIZE, np.uint8)
    tissue[8:-8, 40:-90] = 255
    cv2.imwrite(str(folder / "tissue.png"), tissue)
    # The other methods are slow and not tested here.
    monkeypatch.setattr(comparison, "simpler_methods", dict)

    words = [model, folder / "video.mp4", "--scale", 0.2, "--tissue", folder / "tissue.png"]
    words += [] if young is None else ["--young", young]
    run(learn.cli.app, "predict", *words, "-o", tmp_path / "forces", "--flow", "dis")
    run(bench.cli.app, "score", folder, "--model", model, "-o", tmp_path / "score", "--flow", "dis")
    curve = json.loads((tmp_path / "score" / "score.json").read_text())["curve"]
    with np.load(tmp_path / "forces" / "video.npz") as prediction:
        # Every third of 25 frames a second, as close to ten as whole frames come; half as large as filmed.
        assert prediction["frame"].tolist() == curve["frame"]
        assert 4 <= len(curve["frame"]) < 13
        assert prediction["time_s"] == pytest.approx(np.array(curve["t_s"]), abs=1e-6)
        size = np.array(curve["predicted_mn"]["D2FNet"])
        assert size[0] < 1e-6 * size.max(), "nothing has moved in the rest frame"
        assert np.ptp(size[1:]) > 0.1 * size.max(), "the network's force must vary"
        assert prediction["total_force_mn"] == pytest.approx(size, rel=1e-6, abs=1e-8)
        if output == "vector":
            axes = np.array(curve["predicted_axes_mn"]["D2FNet"])
            assert prediction["force_mn"] == pytest.approx(axes, rel=1e-6, abs=1e-8)
        assert prediction["young_kpa"] == (young or 1.0)
        assert bool(prediction["young_known"]) == (young is not None)


@pytest.mark.slow
def test_a_rest_frame_leaves_out_what_comes_before(make: Maker, tmp_path: Path) -> None:
    path = make(frames=16, footage="mp4") / "video.mp4"
    frames = np.stack([picture.rgb for picture in read_frames(path, FPS)])
    about: dict[str, Any] = {"scale_mm_per_px": 0.2, "young_kpa": 1.0, "living": False, "rate_hz": None}
    about |= {"tissue": np.full(frames.shape[1:3], True), "masks": "none", "membrane": "stripped"}
    late, cut = bench.estimate(frames, rest_frame=3, **about), bench.estimate(frames[3:], **about)
    assert late["frame"].tolist() == (cut["frame"] + 3).tolist()
    assert late["total_force_mn"] == pytest.approx(cut["total_force_mn"], rel=1e-6)
    assert late["total_force_mn"].max() > 0
    with pytest.raises(synth.UserError, match="rest_frame"):
        bench.estimate(next(iter(synth.sample())).path, rest_frame=1)


@pytest.mark.slow
def test_stated_spans_without_contact_tell_the_tissues_own_motion_from_force() -> None:
    side, pitch = 64, 0.5
    y, x = pitch * (np.mgrid[:side, :side] - side / 2)
    times = np.arange(48) / 8

    def move() -> Iterator[FrameMotion]:
        for k, time_s in enumerate(times):
            wave = np.sin(2 * np.pi * 1.1 * time_s)
            press = 1.2 * (time_s >= 4) * np.exp(-(x**2 + y**2) / 18)
            flow = np.stack([0.6 * wave * (y / 16) ** 2, 0.4 * wave * x / 16 + press], axis=-1)
            yield FrameMotion(
                flow.astype(np.float32), np.full((side, side), 0.95, np.float32), index=k, time_s=time_s
            )

    motion = Motion("own", move, np.full((side, side), True), pitch, 1.0)
    unstated, stated = (
        apply_physics(motion, membrane="stripped", free_s=spans)["total_force_mn"]
        for spans in ((), [(0.0, 3.9)])
    )
    before = times < 4
    assert stated[before].max() < 0.6 * unstated[before].max()
    assert stated[~before].min() > 5 * stated[before].max()
    with pytest.raises(synth.UserError, match="free_s"):
        apply_physics(motion, membrane="stripped", free_s=[(7.0, 9.0)])


@pytest.mark.slow
def test_stated_relaxation_lowers_a_held_force_as_the_stiffness_falls() -> None:
    side, pitch, terms = 64, 0.5, ((0.45, 0.5), (0.365, 50.0))
    y, x = pitch * (np.mgrid[:side, :side] - side / 2)
    times = np.concatenate([[0, 0.1, 0.2], 0.5 + np.cumsum([0, 0.1, 0.4, 0.2, 1.0])])

    def move(times: Sequence[float | None]) -> Iterator[FrameMotion]:
        for k, time_s in enumerate(times):
            press = 0.5 * (k >= 3) * np.exp(-(x**2 + y**2) / 18)
            flow = np.stack([press, 0 * press], axis=-1).astype(np.float32)
            yield FrameMotion(flow, np.full((side, side), 0.95, np.float32), index=k, time_s=time_s)

    tissue = np.full((side, side), True)
    motion = Motion("held", partial(move, times.tolist()), tissue, pitch, 1.0)
    elastic, relaxed = (
        apply_physics(motion, membrane="stripped", living=False, relaxation=stated) for stated in ((), terms)
    )
    share = 1 - sum(part * (1 - np.exp(-(times[3:] - times[3]) / tau)) for part, tau in terms)
    # It is pressed between two frames, in 0.3 s.
    ramp = sum(part * (1 - tau / 0.3 * -np.expm1(-0.3 / tau)) for part, tau in terms)
    size = relaxed["total_force_mn"][3:] / elastic["total_force_mn"][3:]
    assert size[0] == pytest.approx(1 - ramp, rel=0.02)
    assert size == pytest.approx(share * size[0], rel=0.12)
    assert (np.diff(size) < 0).all()
    np.testing.assert_allclose(relaxed["force_mn"][3:, 0], size * elastic["force_mn"][3:, 0])
    peaks = (forces["density"][3:].max(axis=(1, 2, 3)) for forces in (relaxed, elastic))
    np.testing.assert_allclose(next(peaks) / next(peaks), size, rtol=1e-4)
    with pytest.raises(synth.UserError, match="relaxation"):
        apply_physics(motion, relaxation=[(0.6, 1.0), (0.5, 2.0)])
    timeless = Motion("held", partial(move, [None] * len(times)), tissue, pitch, 1.0)
    with pytest.raises(synth.UserError, match="relaxation"):
        apply_physics(timeless, relaxation=terms)


class Sine:
    """A force that comes and goes, whatever is seen."""

    def __init__(self, is_elastic: bool) -> None:
        self.is_elastic = is_elastic

    def __call__(self, frame: FrameMotion, scene: bench.MethodContext, picture: bool) -> bench.ForceEstimate:
        force = np.array([10 * np.sin(1 + (frame.time_s or 0)), 0, 5.0])
        density = np.full(scene.tissue.shape, force[0], np.float32) if picture else None
        return bench.ForceEstimate(force, density, low_mn=1.0, high_mn=2.0)


def test_relaxation_is_applied_to_methods_for_elastic_tissue_alone(make: Maker) -> None:
    terms = ((0.45, 0.5), (0.365, 50.0))
    folder = make(frames=10, meta={"relaxation": [list(term) for term in terms]})
    settings = bench.Settings(backend="dis", rate_hz=None, pulse=False)
    methods = {"elastic": Sine(True), "own": Sine(False)}
    tracked = bench.score(folder, methods=methods, main="elastic", settings=settings, baselines=False).tracked
    own, elastic = (np.stack(tracked.force_mn[name]) for name in ("own", "elastic"))
    share = measure_share_left(own, np.array(tracked.time_s), np.array(tracked.trusted), terms)
    assert 0.4 < share.min() < 0.8
    np.testing.assert_allclose(elastic, share[:, None] * own)
    np.testing.assert_allclose(tracked.bounds["elastic"], np.outer(share, [1.0, 2.0]))
    for snapshot in tracked.snapshots:
        assert snapshot.density is not None
        assert snapshot.density == pytest.approx(elastic[snapshot.position, 0], rel=1e-5)


@pytest.mark.parametrize("terms", ["0.4", "0.4:-1", "0.6:1 0.5:2", "0.1:1 0.1:2 0.1:3"])
def test_relaxation_that_is_none_is_refused(terms: str, tmp_path: Path) -> None:
    words = [word for term in terms.split() for word in ("--relaxation", term)]
    source = next(iter(synth.sample())).path
    run(bench.cli.app, "estimate", source, *words, "-o", tmp_path / "forces", code=2)
    assert not (tmp_path / "forces").exists()


@pytest.mark.parametrize("span", ["3", "a:b", "4:2", ""])
def test_a_span_that_cannot_be_read_is_refused(span: str, tmp_path: Path) -> None:
    words = [next(iter(synth.sample())).path, "--free", span, "-o", tmp_path / "forces"]
    run(bench.cli.app, "estimate", *words, code=2)
    assert not (tmp_path / "forces").exists()


@pytest.mark.slow
def test_estimate_and_score_agree_in_force_and_interval(make: Maker, tmp_path: Path) -> None:
    folder = make(
        frames=16,
        footage="mp4",
        meta={"tissue": "ex-vivo", "poisson": [0.4, 0.49], "relaxation": [[0.45, 0.5]]},
    )
    cv2.imwrite(str(folder / "tissue.png"), np.full((96, 128), 255, np.uint8))
    words = [folder / "video.mp4", "--scale", 0.2, "--tissue", folder / "tissue.png", "--young", 1.0]
    words += ["--relaxation", "0.45:0.5", "--membrane", "stripped", "--ex-vivo"]
    run(bench.cli.app, "estimate", *words, "-o", tmp_path / "forces")
    run(bench.cli.app, "score", folder, "-o", tmp_path / "score")
    curve = json.loads((tmp_path / "score" / "score.json").read_text())["curve"]
    with np.load(tmp_path / "forces" / "video.npz") as prediction:
        assert prediction["frame"].tolist() == curve["frame"]
        size = np.array(curve["predicted_mn"]["physics"])
        assert np.ptp(size) > 0.1 * size.max() > 0
        assert prediction["total_force_mn"] == pytest.approx(size, rel=1e-6)
        for end in ("low_mn", "high_mn"):
            ends = curve.get(end, {}).get("physics")
            assert (end in prediction) == (ends is not None), "an interval is stated by both or by neither"
            if ends is not None:
                assert prediction[end] == pytest.approx(np.array(ends, np.float64), rel=1e-6, nan_ok=True)
        low, high, force = (prediction[name] for name in ("low_mn", "high_mn", "total_force_mn"))
    about: dict[str, Any] = {"scale_mm_per_px": 0.2, "young_kpa": 1.0, "membrane": "stripped"}
    about |= {"living": False, "tissue": folder / "tissue.png"}
    about["relaxation"] = [(0.45, 0.5)]
    widened = bench.estimate(folder / "video.mp4", young_uncertainty=0.4, **about)
    is_finite = np.isfinite(high)
    added = 1.645 * 0.4 * force[is_finite]
    assert widened["high_mn"][is_finite] == pytest.approx(
        force[is_finite] + np.hypot(high[is_finite] - force[is_finite], added), rel=1e-3
    )
    assert (widened["low_mn"][is_finite] <= low[is_finite]).all()
    with np.load(tmp_path / "forces" / "video.npz") as prediction:
        total = prediction["density"].sum(axis=(1, 2, 3)) * prediction["pitch_mm"] ** 2
        assert (total >= 0.95 * np.linalg.norm(prediction["force_mn"], axis=1)).all(), (
            "lengths sum up to more"
        )
    assert (tmp_path / "forces" / "video.force.csv").stat().st_size > 0
