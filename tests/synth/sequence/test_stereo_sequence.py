"""A second lens alone makes a stereo sequence; without one nothing of it is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.methods.protocol import Answer, Scene
from bench.recording.folder import open_recording
from bench.recording.from_sequence import export_recording
from bench.tracking.tracking import track_recording
from learn.inference.video_flow import Settings
from synth.checks import stereo
from synth.dataset.store import open_sequence
from synth.flow.stereo.track import Moved
from synth.job import identity, reader
from synth.job.schema import Job
from synth.sequence.pipeline import render_sequence

EYE = {"rgb_right", "flow_right", "visible_right", "depth_right", "motion", "disparity"}
RECOVERED = {"motion_recovered", "motion_deviation"}


def test_what_is_kept_follows_from_the_second_lens() -> None:
    one, two = Job(), Job(render={"stereo_mm": 24})
    assert not (EYE | RECOVERED) & set(one.kept_fields)
    assert set(two.kept_fields) - set(one.kept_fields) == EYE | RECOVERED
    still = Job(render={"stereo_mm": 24}, flow={"stereo": "none"})
    assert set(two.kept_fields) - set(still.kept_fields) == RECOVERED
    fewer = Job(render={"stereo_mm": 24}, store={"without": ["flow_right"]})
    assert "flow_right" not in fewer.kept_fields
    with pytest.raises(ValueError, match="needs a second lens"):
        Job(store={"extra": ["rgb_right"]})


def test_how_motion_is_recovered_tells_only_stereo_jobs_apart() -> None:
    def named(stereo_mm: float, way: str) -> str:
        return identity.identify_job(Job(render={"stereo_mm": stereo_mm}, flow={"stereo": way}))

    assert named(0, "joint") == named(0, "none")
    assert named(24, "joint") != named(24, "none")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["joint", "fused"])
def test_a_rendered_pair_agrees_and_gives_motion_back(tmp_path: Path, way: str) -> None:
    changes = ["frames=4", "render.size=[160,120]", "render.stereo_mm=24", f"flow.stereo={way}"]
    job = reader.load_job("tiny", [*changes, "sequences=1", "render.spp=4"])
    sequence = open_sequence(render_sequence(job, 0, tmp_path, lambda *_: None))
    measures = list(stereo.stereo(sequence, [0, 2]))
    assert len(measures) > 8
    assert all(one.good for one in measures), [one for one in measures if not one.good]
    tissue, found = sequence["tissue"][:], sequence["motion_recovered"][:]
    assert not found[0].any()
    assert not found[:, ~tissue].any()
    assert (sequence["motion_deviation"][2][tissue] > 0).all()
    t = int(np.abs(sequence["motion"][..., 2]).max(axis=(1, 2)).argmax())
    seen = tissue & sequence["visible"][t] & ~sequence["tool"][0]
    error = (found - sequence["motion"][:])[t][seen]
    # At 160 px a pixel of disparity is 2.7 mm of depth.
    assert np.sqrt(np.square(error[:, 2]).mean()) < 0.2
    assert sequence.attrs["right"]["baseline_mm"] == 24
    # As a recording of its own, from its files alone.
    made = open_recording(export_recording(sequence, tmp_path / "recording"))
    told: list[Moved] = []

    class Looking:
        def __call__(self, flow: np.ndarray, confidence: np.ndarray, scene: Scene, picture: bool) -> Answer:
            raise AssertionError("there is a second eye")

        def in_space(
            self, flow: np.ndarray, confidence: np.ndarray, moved: Moved, scene: Scene, picture: bool
        ) -> Answer:
            told.append(moved)
            return Answer(np.zeros(3))

    settings = Settings(rate_hz=None, pulse=False)
    done = track_recording(made, {"it": Looking()}, sequence.attrs["scale_mm_per_px"], settings)
    assert done.sight is not None
    assert done.sight.baseline_mm == pytest.approx(24, rel=1e-4)
    assert done.sight.mm_per_px == pytest.approx(sequence.attrs["scale_mm_per_px"], rel=0.05)
    again = (told[t].motion - sequence["motion"][t])[seen]
    assert np.sqrt(np.square(again[:, 2]).mean()) < 0.2
