"""A scene from a script is the one that a dataset holds, frame by frame, and needs no folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import synth
from synth.sequence.pipeline import render_sequence

SMALL = ["seed=3", "frames=3", "anatomy.vertices=2500", "fem.tets=400", "render.spp=1", "render.size=[96,72]"]
LINEAR = ["store.extra=[radiance]"]


@pytest.fixture(scope="module")
def job() -> synth.Job:
    return synth.load_job("tiny", [*SMALL, *LINEAR])


@pytest.fixture(scope="module")
def scene(job: synth.Job) -> synth.Scene:
    return synth.simulate(job, 1)


@pytest.mark.slow
def test_it_is_what_a_dataset_holds(
    scene: synth.Scene, job: synth.Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    frames = list(scene.frames())
    recovered = scene.recover_flow(frames)
    assert not list(tmp_path.iterdir()), "no folder"
    stored = synth.open_sequence(render_sequence(job, 1, tmp_path, lambda *_: None))
    for name in ("rgb", "flow", "visible", "depth", "tool", "glare", "traction"):
        np.testing.assert_array_equal(np.stack([getattr(one, name) for one in frames]), stored[name][:], name)
    linear = np.stack([one.radiance for one in frames]).astype(np.float16)
    np.testing.assert_array_equal(linear, stored["radiance"][:])
    for name in ("area", "tissue", "force"):
        np.testing.assert_array_equal(np.asarray(getattr(scene, name), stored[name].dtype), stored[name][:])
    assert [one.time_s for one in frames] == pytest.approx(stored["time"][:].tolist())
    np.testing.assert_array_equal(recovered.flow, stored["flow_recovered"][:])
    np.testing.assert_array_equal(recovered.confidence, stored["flow_confidence"][:])
    assert scene.young_kpa == stored.attrs["young_kpa"]
    assert scene.scale_mm_per_px == stored.attrs["scale_mm_per_px"]


@pytest.mark.slow
def test_a_frame_does_not_depend_on_those_before_it(scene: synth.Scene, job: synth.Job) -> None:
    assert scene.strongest == int(np.linalg.norm(scene.force, axis=1).argmax()) > 0
    alone = synth.simulate(job, 1).frame(2)
    again = scene.frame(2)
    np.testing.assert_array_equal(alone.rgb, again.rgb)


def test_what_cannot_be_is_refused(scene: synth.Scene, job: synth.Job) -> None:
    with pytest.raises(synth.UserError):
        synth.simulate(job, 2)
    with pytest.raises(synth.UserError):
        scene.frame(3)
