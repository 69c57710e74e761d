"""Streams: the same forces as scoring, with flow in this or another process, each as soon as it is ready."""

import json
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from command import run
from fake_model import write_model
from fake_recording import texture
from warped_cortex import Recipe, Stage

from bench.cli import app
from bench.methods.network import Model
from bench.recording.recording_folder import open_recording
from bench.recording.recording_writer import write_video
from bench.tracking import live
from bench.tracking.tracking import track_recording
from synth.arrays import Mask, Pixels
from synth.flow.recording.decode import LIVE_COLUMNS, Footage, RecordingFlowSettings
from synth.flow.recording.flow import FlowProcess, LocalFlow
from synth.flow.recording.frame_motion import FrameMotion
from synth.flow.recording.video_pass import VideoPass
from synth.video.read_video import Picture, read_video


def pictures(frames: int) -> list[Picture]:
    return [Picture(k, k / 25, np.roll(texture(64, 80), k, axis=1)) for k in range(frames)]


@pytest.mark.slow
def test_flow_in_another_process_gives_the_same_results_in_order() -> None:
    def stream_frames(flow: LocalFlow | None) -> list[live.LiveFrame]:
        results: list[live.LiveFrame] = []
        footage = Footage(lambda: pictures(5), "test")
        settings = RecordingFlowSettings("dis", 1, None, False, "none")
        live.stream_video(footage, settings, paced=False, report=results.append, flow=flow)
        return results

    local_frames = stream_frames(None)
    with closing(FlowProcess()) as process:
        process_frames = stream_frames(process)
    assert (
        [frame.index for frame in process_frames] == [frame.index for frame in local_frames] == [1, 2, 3, 4]
    )
    assert [frame.largest_px for frame in process_frames] == [frame.largest_px for frame in local_frames]


@pytest.mark.parametrize(
    ("needs_s", "expected"),
    [
        # Ready before the next frame arrives: yielded at once.
        (0.01, ["due 1", "in 1", "out 1", "due 2", "in 2", "out 2", "due 3", "in 3", "out 3"]),
        # Not ready: the next frame is submitted meanwhile, and no more than that one.
        (9.0, ["due 1", "in 1", "due 2", "in 2", "out 1", "due 3", "in 3", "out 2", "out 3"]),
    ],
)
def test_a_result_is_yielded_as_soon_as_it_is_ready(needs_s: float, expected: list[str]) -> None:
    log: list[str] = []

    class Slow(Future[FrameMotion]):
        def result(self, timeout: float | None = None) -> FrameMotion:
            if timeout is not None and timeout < needs_s:
                raise TimeoutError
            return super().result()

    class Later(LocalFlow):
        ahead = 1
        submitted = -1  # one submission precedes the start of the stream

        def submit(self, rgb: Pixels, masked: Mask) -> Future[FrameMotion]:
            self.submitted += 1
            if self.submitted:
                log.append(f"in {self.submitted}")
            slow = Slow()
            slow.set_result(super().submit(rgb, masked).result())
            return slow

    clock = Mock(spare_s=lambda time_s: 0.04, wait_s=lambda: 0.0)
    clock.is_due = lambda index, time_s: log.append(f"due {index}") is None
    settings = RecordingFlowSettings("dis", 1, rate_hz=None, pulse=False, masks="none")
    footage = Footage(lambda: pictures(4), "test")
    for frame in VideoPass(footage, settings, flow=Later(), pace=clock).frames():
        if not frame.is_rest:
            log.append(f"out {frame.index}")
    assert log == expected


class FakeCamera:
    """Gives some of its pictures, as if the others had arrived meanwhile; its period is long past."""

    period_s = 1e-6

    def __init__(self, numbers: tuple[int, ...]) -> None:
        self.numbers = numbers

    def pictures(self) -> Iterator[Picture]:
        for k in self.numbers:
            yield Picture(k, time.perf_counter(), np.roll(texture(64, 80), k, axis=1))


def test_a_camera_is_followed_and_what_it_left_out_is_counted() -> None:
    settings = RecordingFlowSettings("dis", 1, None, False, "none")

    def watch(camera: FakeCamera, seconds: float = np.inf) -> live.Stream:
        footage = Footage(camera.pictures, "0")
        return live.stream_video(footage, settings, camera=camera, seconds=seconds)  # type: ignore[arg-type]

    stream = watch(FakeCamera((0, 7, 8, 11)))  # 1 to 6 arrive while the stream is prepared
    assert ([frame.index for frame in stream.frames], stream.dropped) == ([7, 8, 11], 2)
    assert min(frame.latency_s for frame in stream.frames) > 0
    assert len(watch(FakeCamera((0, 1, 2, 3)), seconds=0.0).frames) == 1


def test_ctrl_c_ends_a_camera_with_what_was_measured() -> None:
    class Stopped(FakeCamera):
        def pictures(self) -> Iterator[Picture]:
            yield from super().pictures()
            raise KeyboardInterrupt

    settings, camera = RecordingFlowSettings("dis", 1, None, False, "none"), Stopped((0, 1, 2))
    stream = live.stream_video(Footage(camera.pictures, "0"), settings, camera=camera)  # type: ignore[arg-type]
    assert stream.summary()["frames"] == 2


@pytest.mark.parametrize("words", [["0", "--every"], ["a.mp4", "--seconds", "5"]])
def test_options_that_do_not_fit_the_source_are_refused(words: list[str]) -> None:
    assert words[0] in run(app, "live", *words, code=2).stderr


def test_pictures_of_a_stream_are_shrunk_to_what_a_network_needs() -> None:
    wide_pictures = [Picture(k, k / 25, np.roll(texture(240, 330), k, axis=1)) for k in range(2)]
    settings = RecordingFlowSettings("dis", 0, None, False, "none", LIVE_COLUMNS)
    stream = live.stream_video(Footage(lambda: wide_pictures, "video"), settings, paced=False)
    assert stream.size == (120, 165)


@pytest.mark.slow
def test_live_estimates_the_same_forces_as_score(tmp_path: Path) -> None:
    rng, model = np.random.default_rng(5), write_model(tmp_path / "model")
    stage = Stage.set(Recipe(size=96, pull=4.0, tool=10.0), rng)
    rest = stage.rest(rng)
    shots = [stage.against(rest, share, rng).now for share in (0.3, 0.6, 1.0)]
    folder = tmp_path / "recording"
    folder.mkdir()
    write_video(folder / "video.mp4", iter([rest[0], *shots]), np.arange(4) / 25)
    (folder / "meta.yaml").write_text("scale_mm_per_px: 0.3\nyoung_kpa: 1.0\nrest_frame: 0\n")
    words = ["live", folder / "video.mp4", "-m", model, "--scale", 0.3, "--young", 1]
    summary = json.loads(run(app, *words, "--every", "--json").stdout)
    assert (summary["frames"], summary["dropped"]) == (3, 0)

    settings = RecordingFlowSettings(shrink=1, rate_hz=None)

    def stream_forces(scale: float | str, young: float | None) -> list[float | None]:
        frames: list[live.LiveFrame] = []
        live.stream_video(
            Footage(lambda: read_video(folder / "video.mp4"), "video"),
            replace(settings, pulse=False),
            method=Model(model),
            scale_mm_per_px=scale,  # type: ignore[arg-type]
            young_kpa=young,
            paced=False,
            report=frames.append,
        )
        return [frame.force_mn for frame in frames]

    tracked = track_recording(open_recording(folder), {"model": Model(model)}, 0.3, settings)
    expected_mn = [float(np.linalg.norm(force)) for force in tracked.force_mn["model"][1:]]
    assert min(expected_mn) > 0
    # The stream solves the rest frame once before its start and so begins warm, which changes flow a little.
    assert stream_forces(0.3, 1.0) == pytest.approx(expected_mn, rel=0.25)
    assert stream_forces("unknown", 5.0) == stream_forces(32.0 / summary["width"], None)
