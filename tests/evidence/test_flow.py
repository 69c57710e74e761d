"""The flow bench: files, figures, charts, streams, scenes."""

from __future__ import annotations

import json
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from fake_model import write_model
from scipy.ndimage import map_coordinates
from typer.testing import CliRunner

from bench.cli import app
from bench.flow import files
from bench.methods.network import Model
from bench.methods.protocol import Answer, Scene
from bench.recording.folder import open_recording
from bench.recording.writer import write_video
from bench.tracking import live
from bench.tracking.tracking import track_recording
from evidence.flow.measure import MeanInpainting, against, divergence, measure
from evidence.flow.scenes import CLEAN, Recipe, Stage, inverse, pairs, pull_field
from learn.inference.video import Picture, read_video
from learn.inference.video_flow import Footage, Settings
from synth.errors import UserError
from synth.flow.opencv import Dis


@pytest.mark.parametrize(("suffix", "within"), [(".flo", 0.0), (".png", 1 / 128)])
def test_flow_files_return_what_was_written(tmp_path: Path, suffix: str, within: float) -> None:
    flow = np.random.default_rng(0).uniform(-300, 300, (7, 5, 2)).astype(np.float32)
    known = np.ones((7, 5), bool)
    known[2, 3] = False
    path = tmp_path / f"flow{suffix}"
    files.write_flow(path, flow, known)
    back, there = files.read_flow(path)
    np.testing.assert_array_equal(there, known)
    assert np.abs(back - flow)[known].max() <= within
    assert not back[2, 3].any()


def test_flo_bytes_are_middleburys(tmp_path: Path) -> None:
    path = tmp_path / "a.flo"
    files.write_flow(path, np.array([[[1.0, -2.0], [3.0, 4.0]]], np.float32))
    data = path.read_bytes()
    assert data[:4] == b"PIEH"
    assert np.frombuffer(data, "<i4", 2, 4).tolist() == [2, 1]
    assert np.frombuffer(data, "<f4", 4, 12).tolist() == [1.0, -2.0, 3.0, 4.0]


def test_kitti_png_is_readable_by_its_formula(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    files.write_flow(path, np.full((2, 2, 2), (1.5, -2.25), np.float32))
    blue, green, red = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[0, 0].tolist()
    assert ((red - 2**15) / 64, (green - 2**15) / 64, blue) == (1.5, -2.25, 1)


def test_flow_files_refuse_what_they_cannot_read(tmp_path: Path) -> None:
    bad = tmp_path / "bad.flo"
    bad.write_bytes(b"PIEH" + np.array([1000, 1000], "<i4").tobytes())
    eight = tmp_path / "eight.png"
    cv2.imwrite(str(eight), np.zeros((4, 4, 3), np.uint8))
    for path in (bad, eight, tmp_path / "none.flo", tmp_path / "a.txt"):
        with pytest.raises(UserError):
            files.read_flow(path)
    with pytest.raises(UserError, match="511"):
        files.write_flow(tmp_path / "far.png", np.full((2, 2, 2), 600.0, np.float32))


def test_error_of_a_known_offset() -> None:
    truth = np.zeros((20, 20, 2), np.float32)
    truth[..., 0] = 4.0
    every = np.ones((20, 20), bool)
    error = against(truth + np.array([0.0, 3.0], np.float32), truth, every, every, ~every, 0.0)
    assert error.mean == pytest.approx(3.0)
    assert error.magnitude == pytest.approx(0.25)  # |(4, 3)| = 5 against 4
    assert np.isnan(error.hidden)


def test_contact_counts_hidden_points_and_contact_seen_does_not() -> None:
    truth = np.zeros((4, 4, 2), np.float32)
    flow = truth.copy()
    flow[0, :, 0] = 8.0  # wrong under the tool only
    contact, hidden = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    contact[:2], hidden[0] = True, True
    error = against(flow, truth, ~hidden, contact, hidden, 0.0)
    assert (error.contact, error.contact_seen, error.hidden) == (4.0, 0.0, 8.0)


def test_divergence_of_a_linear_field() -> None:
    y, x = np.mgrid[:30, :30].astype(np.float32)
    found = divergence(np.stack([0.3 * x, -0.1 * y], -1))
    np.testing.assert_allclose(found[8:-8, 8:-8], 0.2, atol=1e-5)


def test_scene_holds_its_own_truth() -> None:
    """The now frame, read where the flow points, is the rest frame; the inverse of the flow undoes it."""
    (pair,) = pairs(CLEAN, 1, 3)
    height, width = pair.flow.shape[:2]
    y, x = np.mgrid[:height, :width].astype(np.float64)
    at = (y + pair.flow[..., 1], x + pair.flow[..., 0])
    moved = map_coordinates(pair.now[..., 1].astype(float), at, order=3, mode="nearest")
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(moved - pair.rest[..., 1])[inner].mean() < 0.8  # rounding to 8 bits twice
    field = pull_field(Recipe(size=96))
    source = inverse(field)
    there = np.stack(
        [map_coordinates(field[..., c], (source[..., 1], source[..., 0]), order=1) for c in (0, 1)], -1
    )
    grid = np.stack(np.meshgrid(np.arange(96.0), np.arange(96.0)), -1)
    assert np.abs(source + there - grid)[4:-4, 4:-4].max() < 0.01


def test_masking_beats_mean_inpainting() -> None:
    made = list(pairs(Recipe(size=128, pull=6.0), 2, 5))
    assert measure(Dis(), made).mean < measure(MeanInpainting(Dis()), made).mean


def test_bench_flow_scores_a_pair(tmp_path: Path) -> None:
    (pair,) = pairs(Recipe(size=96, pull=4.0, tool=0.0, highlights=0.0), 1, 3)
    for name, picture in (("a.png", pair.rest), ("b.png", pair.now)):
        cv2.imwrite(str(tmp_path / name), picture[..., ::-1])
    files.write_flow(tmp_path / "truth.flo", pair.flow, pair.inside)
    names = [str(tmp_path / name) for name in ("a.png", "b.png", "truth.flo")]
    ran = CliRunner().invoke(app, ["flow", *names, "--json", "-o", str(tmp_path / "out.flo")])
    assert ran.exit_code == 0, ran.output
    score = json.loads(ran.output)
    assert score["epe"] < 0.15
    assert score["pixels"] == np.count_nonzero(pair.inside)
    back, _ = files.read_flow(tmp_path / "out.flo")
    assert np.linalg.norm(back - pair.flow, axis=-1)[pair.inside].mean() == pytest.approx(
        score["epe"], abs=1e-5
    )


def test_bench_flow_without_a_truth_answers_in_json_too(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.full((32, 32, 3), 90, np.uint8))
    out = tmp_path / "out.flo"
    words = ["flow", str(tmp_path / "a.png"), str(tmp_path / "b.png"), "--flow", "dis", "--json"]
    for more, written in ((["-o", str(out)], str(out)), ([], None)):
        told = json.loads(CliRunner().invoke(app, [*words, *more]).stdout)
        assert told == {"out": written, "mean_px": 0, "p98_px": 0, "confidence": 1}


def test_stream_answers_every_frame_and_says_what_it_cost() -> None:
    (pair,) = pairs(Recipe(size=64, pull=2.0, tool=0.0), 1, 3)
    shown = [Picture(k, k / 25, pair.rest if k % 2 == 0 else pair.now) for k in range(5)]
    told: list[live.Frame] = []
    footage = Footage(shown, "test")
    account = live.watch_video(footage, backend="dis", paced=False, told=told.append)
    summary = account.summary()
    assert [frame.index for frame in told] == [1, 2, 3, 4]
    assert summary["dropped"] == 0
    assert 0 < summary["p50_ms"] <= summary["p95_ms"] <= summary["p99_ms"]
    assert told[0].largest_px > 1.0
    assert told[1].largest_px < 0.3


@pytest.mark.slow
def test_stream_drops_what_comes_too_fast() -> None:
    (pair,) = pairs(Recipe(size=64, pull=2.0, tool=0.0), 1, 3)
    # The last comes when every machine is done with the first.
    shown = [Picture(k, 3.0 if k == 29 else k * 1e-4, pair.now) for k in range(30)]
    footage = Footage(shown, "test")
    account = live.watch_video(footage, backend="dis", paced=True, told=lambda frame: None)
    assert account.dropped > 5
    assert account.dropped + len(account.frames) == 29


def test_live_runs_on_a_video_and_refuses_what_is_none(tmp_path: Path) -> None:
    (pair,) = pairs(Recipe(size=64, pull=2.0, tool=0.0), 1, 3)
    path = tmp_path / "video.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.width = stream.height = 64
        for picture in (pair.rest, pair.now, pair.rest):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode())
    ran = CliRunner().invoke(app, ["live", str(path), "--flow", "dis", "--every", "--json"])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.output)["frames"] == 2
    assert json.loads(ran.output)["untrusted"] == 0
    (tmp_path / "drawn").mkdir()
    cv2.imwrite(str(tmp_path / "drawn" / "mask.png"), np.full((64, 64), 255, np.uint8))
    covered = ["live", str(path), "--flow", "dis", "--every", "--masks", str(tmp_path / "drawn"), "--json"]
    assert json.loads(CliRunner().invoke(app, covered).output)["untrusted"] == 2
    (tmp_path / "no.mp4").write_text("no video")
    with pytest.raises(UserError):
        live.watch_video(Footage(read_video(tmp_path / "no.mp4"), "no"))
    with pytest.raises(UserError, match="scale"):
        live.watch_video(Footage(read_video(path), "video"), method=lambda *given: None)  # type: ignore[arg-type, return-value]


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return write_model(tmp_path / "model")


def test_live_answers_with_the_forces_that_scoring_finds(tmp_path: Path, model: Path) -> None:
    """One video, once as a stream and once as a recording without masks: same masks, flow and model."""
    rng = np.random.default_rng(5)
    stage = Stage.set(Recipe(size=96, pull=4.0, tool=10.0), rng)
    rest = stage.rest(rng)
    shots = [stage.against(rest, share, rng).now for share in (0.3, 0.6, 1.0)]
    folder = tmp_path / "recording"
    folder.mkdir()
    write_video(folder / "video.mp4", iter([rest[0], *shots]), np.arange(4) / 25)
    (folder / "meta.yaml").write_text("scale_mm_per_px: 0.3\nyoung_kpa: 1.0\nrest_frame: 0\n")
    arguments = ["live", str(folder / "video.mp4"), "-m", str(model), "--scale", "0.3", "--young", "1"]
    ran = CliRunner().invoke(app, [*arguments, "--every", "--json", "-o", str(tmp_path / "out")])
    assert ran.exit_code == 0, ran.output
    summary = json.loads(ran.output)
    assert json.loads((tmp_path / "out" / "live.json").read_text()).items() >= summary.items()
    assert (summary["frames"], summary["dropped"]) == (3, 0)
    assert 0 < summary["p50_ms"] <= summary["p95_ms"] <= summary["p99_ms"]
    assert summary["force_ms"] > 0
    streamed: list[live.Frame] = []
    live.watch_video(
        Footage(read_video(folder / "video.mp4"), "video"), method=Model(model), scale_mm_per_px=0.3,
        young_kpa=1.0, paced=False, told=streamed.append,
    )  # fmt: skip
    settings = Settings(shrink=1, rate_hz=None)
    followed = track_recording(open_recording(folder), {"model": Model(model)}, 0.3, settings)
    scored = [float(np.linalg.norm(force)) for force in followed.force_mn["model"][1:]]
    assert min(scored) > 0
    # The stream has looked at the rest frame twice and so starts its first flow warm; what differs is a share
    # of the motion's part alone, the network's answer to none being taken off.
    assert [frame.force_mn for frame in streamed] == pytest.approx(scored, rel=0.25)
    forces: list[list[float | None]] = []
    for scale, young in (("unknown", 5.0), (32.0 / summary["width"], None)):
        streamed.clear()
        live.watch_video(
            Footage(read_video(folder / "video.mp4"), "video"), method=Model(model), scale_mm_per_px=scale,
            young_kpa=young, paced=False, told=streamed.append,
        )  # fmt: skip
        forces.append([frame.force_mn for frame in streamed])
    assert forces[0] == forces[1]
    assert any("tool is looked for" in note for note in followed.notes)


def test_scoring_without_masks_leaves_the_instrument_out(tmp_path: Path) -> None:
    (pair,) = pairs(Recipe(size=96, pull=4.0, tool=16.0, highlights=0.0), 1, 2)
    folder = tmp_path / "recording"
    (folder / "frames").mkdir(parents=True)
    for k, picture in enumerate((pair.rest, pair.now)):
        cv2.imwrite(str(folder / "frames" / f"{k}.png"), picture[..., ::-1])
    (folder / "meta.yaml").write_text("scale_mm_per_px: 0.3\nyoung_kpa: 1.0\nrest_frame: 0\nfps: 25\n")
    trust: list[np.ndarray] = []

    def method(flow: np.ndarray, confidence: np.ndarray, scene: Scene, picture: bool) -> Answer:
        trust.append(confidence)
        return Answer(np.zeros(3))

    track_recording(open_recording(folder), {"none": method}, 0.3, Settings("dis", shrink=1, rate_hz=None))
    assert trust[1][pair.hidden].mean() < 0.3
    assert trust[1][~pair.hidden & pair.inside].mean() > 0.6
