"""`bench live` and `bench score` on the same film: same masks, flow and forces; what a stream drops."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_model import write_model
from typer.testing import CliRunner

from bench.cli import app
from bench.methods.network import Model
from bench.recording.folder import open_recording
from bench.recording.writer import write_video
from bench.tracking import live
from bench.tracking.tracking import track_recording
from evidence.flow.scenes import Recipe, Stage
from synth.recording_flow.video_flow import Footage, RecordingFlowSettings
from synth.video.read import read_video


@pytest.mark.slow
def test_live_answers_with_the_forces_that_scoring_finds(tmp_path: Path) -> None:
    """One video, once as a stream and once as a recording without masks: same masks, flow and model."""
    rng, model = np.random.default_rng(5), write_model(tmp_path / "model")
    stage = Stage.set(Recipe(size=96, pull=4.0, tool=10.0), rng)
    rest = stage.rest(rng)
    shots = [stage.against(rest, share, rng).now for share in (0.3, 0.6, 1.0)]
    folder = tmp_path / "recording"
    folder.mkdir()
    write_video(folder / "video.mp4", iter([rest[0], *shots]), np.arange(4) / 25)
    (folder / "meta.yaml").write_text("scale_mm_per_px: 0.3\nyoung_kpa: 1.0\nrest_frame: 0\n")
    words = ["live", str(folder / "video.mp4"), "-m", str(model), "--scale", "0.3", "--young", "1"]
    summary = json.loads(CliRunner().invoke(app, [*words, "--every", "--json"]).output)
    assert (summary["frames"], summary["dropped"]) == (3, 0)

    settings = RecordingFlowSettings(shrink=1, rate_hz=None)

    def streamed(scale: float | str, young: float | None) -> list[float | None]:
        frames: list[live.LiveFrame] = []
        live.stream_video(
            Footage(read_video(folder / "video.mp4"), "video"),
            replace(settings, pulse=False),
            method=Model(model),
            scale_mm_per_px=scale,  # type: ignore[arg-type]
            young_kpa=young,
            paced=False,
            report=frames.append,
        )
        return [frame.force_mn for frame in frames]

    followed = track_recording(open_recording(folder), {"model": Model(model)}, 0.3, settings)
    scored = [float(np.linalg.norm(force)) for force in followed.force_mn["model"][1:]]
    assert min(scored) > 0
    # The stream has looked at the rest frame twice and so starts its first flow warm; what differs is a share
    # of the motion's part alone, the network's answer to none being taken off.
    assert streamed(0.3, 1.0) == pytest.approx(scored, rel=0.25)
    assert streamed("unknown", 5.0) == streamed(32.0 / summary["width"], None)
