"""A scene from a script is the one in a dataset, frame by frame, and needs no folder; a stereo sequence."""

from pathlib import Path

import numpy as np
import pytest

import synth
from synth.checks import stereo_checks
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
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["frames=4", "fem.instrument_list=[{timing: [0.4, 0.41, 0.42, 0.43]}]"], "0.048"),
        (["fem.footprint_mm=[13,14]"], "13"),
        (["fem.footprint_mm=[11.9,11.9]", "fem.gestures=[grasp]"], "12"),
        (
            ["render.field_mm=[8,8]", "fem.instrument_list=[{gesture: push, place: [7,0], footprint_mm: 2}]"],
            "mN",
        ),
        (["sensor.exposure=[1e-4,1e-4]"], "frame 0"),
        (["render.tilt_deg=86"], "85"),
    ],
)
def test_labels_without_a_meaning_are_refused(tmp_path: Path, changes: list[str], message: str) -> None:
    sizes = ["anatomy.vertices=1500", "fem.tets=300", "render.size=[48,36]", "flow.backend=ideal", "frames=3"]
    with pytest.raises(synth.UserError, match=message):
        synth.write_scene(synth.simulate(synth.load_job("tiny", [*sizes, *changes])), tmp_path)


@pytest.mark.slow
def test_it_is_the_scene_in_a_dataset(
    scene: synth.Scene, job: synth.Job, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    frames = list(scene.frames())
    recovered = scene.recover_flow(frames)
    assert not list(tmp_path.iterdir()), "no folder"
    stored = synth.open_sequence(render_sequence(job, 1, tmp_path, lambda *_: None))
    for name in ("rgb", "flow", "visible", "depth", "tool", "glare", "traction"):
        np.testing.assert_array_equal(
            np.stack([getattr(frame, name) for frame in frames]), stored[name][:], name
        )
    linear = np.stack([frame.radiance for frame in frames]).astype(np.float16)
    np.testing.assert_array_equal(linear, stored["radiance"][:])
    for name in ("area", "tissue", "force"):
        np.testing.assert_array_equal(np.asarray(getattr(scene, name), stored[name].dtype), stored[name][:])
    assert [frame.time_s for frame in frames] == pytest.approx(stored["time"][:].tolist())
    np.testing.assert_array_equal(recovered.flow, stored["flow_recovered"][:])
    np.testing.assert_array_equal(recovered.confidence, stored["flow_confidence"][:])
    assert scene.young_kpa == stored.attrs["young_kpa"]
    assert scene.scale_mm_per_px == stored.attrs["scale_mm_per_px"]


@pytest.mark.slow
def test_a_frame_does_not_depend_on_those_before_it(scene: synth.Scene, job: synth.Job) -> None:
    assert scene.strongest == int(np.linalg.norm(scene.force, axis=1).argmax()) > 0
    lone_frame = synth.simulate(job, 1).frame(2)
    scene_frame = scene.frame(2)
    np.testing.assert_array_equal(lone_frame.rgb, scene_frame.rgb)


def test_missing_sequences_and_frames_are_refused(scene: synth.Scene, job: synth.Job) -> None:
    with pytest.raises(synth.UserError):
        synth.simulate(job, 2)
    with pytest.raises(synth.UserError):
        scene.frame(3)


@pytest.mark.slow
def test_a_stereo_sequence_agrees_with_its_truth_and_recovers_motion(tmp_path: Path) -> None:
    changes = ["frames=4", "render.size=[160,120]", "render.stereo_mm=24"]
    job = synth.load_job("tiny", [*changes, "sequences=1", "render.spp=4"])
    sequence = synth.open_sequence(render_sequence(job, 0, tmp_path, lambda *_: None))
    measures = list(stereo_checks.stereo(sequence, [0, 2]))
    assert len(measures) > 8
    assert all(measure.good for measure in measures), [measure for measure in measures if not measure.good]
    tissue, motion = sequence["tissue"][:], sequence["motion_recovered"][:]
    assert not motion[0].any()
    assert not motion[:, ~tissue].any()
    assert (sequence["motion_deviation"][2][tissue] > 0).all()
    t = int(np.abs(sequence["motion"][..., 2]).max(axis=(1, 2)).argmax())
    visible = tissue & sequence["visible"][t] & ~sequence["tool"][0]
    error = (motion - sequence["motion"][:])[t][visible]
    # At 160 px a pixel of disparity is 2.7 mm of depth.
    assert np.sqrt(np.square(error[:, 2]).mean()) < 0.2
    assert sequence.attrs["right"]["baseline_mm"] == 24
