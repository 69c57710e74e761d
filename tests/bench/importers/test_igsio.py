"""PLUS/IGSIO sequences as the method's authors publish them: no pixels, and a video beside the header."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from command import run
from fake_recording import Maker, score_recording
from igs_sequence import write_igs

from bench.cli import app
from bench.importers import importer_registry
from bench.recording import recording_writer
from bench.recording.recording_folder import open_recording
from synth.errors import UserError
from synth.system import csv_table

N = 30
TIMES = 0.15 + np.cumsum(np.linspace(0.04, 0.06, N))
FORCE = np.stack([0 * TIMES - 0.02, 0 * TIMES, 0.95 + 0.3 * np.exp(-((TIMES - 1) ** 2) / 0.1)], axis=1)


def film(path: Path, count: int = N) -> Path:
    rng = np.random.default_rng(0)
    pictures = [
        np.full((48, 64, 3), 8 * k, np.uint8) + rng.integers(0, 4, (48, 64, 3), np.uint8)
        for k in range(count)
    ]
    recording_writer.write_video(path, iter(pictures), np.arange(count) / 20, crf=0)
    return path


@pytest.mark.parametrize("local", [True, False])
def test_pictures_come_from_the_video_beside_it(local: bool, tmp_path: Path) -> None:
    film(tmp_path / "trial.mp4")
    invalid = {3: "Force", 5: "TipToWorldTransform"}
    source = write_igs(tmp_path / "a.igs.mha", TIMES, FORCE, "C:\\data\\trial.mp4", invalid, local=local)
    intake = importer_registry.read_source(source)
    assert intake.times_s == pytest.approx(TIMES, abs=1e-6)
    assert [int(picture.mean()) // 8 for picture in intake.pictures()] == [*range(N)]
    np.testing.assert_allclose(intake.force, np.delete(FORCE, 3, 0), atol=1e-6)
    pose = intake.poses["TipToWorldTransform"]
    assert np.isnan(pose[5]).all()
    assert pose[6, 0, 3] == pytest.approx(6)
    # The bias is said.
    assert any("free_s" in note for note in intake.notes)
    run(app, "import", source, "-o", tmp_path / "rec", "--scale", 0.1)
    recording = open_recording(tmp_path / "rec")
    assert [frame.time_s for frame in recording.frames()] == pytest.approx(TIMES, abs=1e-6)
    assert (tmp_path / "rec/video.mp4").read_bytes() == (tmp_path / "trial.mp4").read_bytes()
    table = csv_table.read_csv(tmp_path / "rec/poses.csv", ("t_s", "tiptoworldtransform_x"))
    assert np.isnan(table["tiptoworldtransform_x"][5])
    assert table["tiptoworldtransform_x"][6] == pytest.approx(6)


@pytest.mark.parametrize("spare", [-1, 2])
def test_a_video_of_a_few_pictures_more_or_fewer_is_cut_to_the_frames(spare: int, tmp_path: Path) -> None:
    film(tmp_path / "v.mp4", N + spare)
    source = write_igs(tmp_path / "a.mha", TIMES, FORCE, "v.mp4")
    run(app, "import", source, "-o", tmp_path / "rec", "--scale", 0.1)
    frames = list(open_recording(tmp_path / "rec").frames())
    assert [int(frame.rgb.mean()) // 8 for frame in frames] == [*range(min(N, N + spare))]
    assert [frame.time_s for frame in frames] == pytest.approx(TIMES[: N + spare], abs=1e-6)


def test_a_sequence_is_a_table_of_forces_too(tmp_path: Path) -> None:
    video, source = film(tmp_path / "v.mp4"), write_igs(tmp_path / "a.mha", TIMES, FORCE, "v.mp4")
    intake = importer_registry.read_source(video, {"force": str(source)})
    np.testing.assert_allclose(intake.force, FORCE, atol=1e-6)
    np.testing.assert_allclose(intake.force_s, TIMES, atol=1e-6)


def test_what_it_lacks_is_named(tmp_path: Path) -> None:
    source = write_igs(tmp_path / "a.mha", TIMES, FORCE, "v.mp4")
    with pytest.raises(UserError, match=r"v\.mp4"):
        importer_registry.read_source(source)
    film(tmp_path / "v.mp4", N - 5)
    with pytest.raises(UserError, match="25"):
        importer_registry.read_source(source)
    (tmp_path / "in").mkdir()
    outside = write_igs(tmp_path / "in/a.mha", TIMES, FORCE, "v.mp4")
    (tmp_path / "in/v.mp4").symlink_to(film(tmp_path / "v.mp4"))
    with pytest.raises(UserError, match="same folder"):
        importer_registry.read_source(outside)
    (tmp_path / "b.mha").write_text("hello world\n")
    with pytest.raises(UserError, match="hello world"):
        importer_registry.read_source(tmp_path / "b.mha")
    (tmp_path / "c.mha").write_text(
        "NDims = 2\nDimSize = 4 4\nElementType = MET_FLOAT\nElementDataFile = LOCAL\n"
    )
    with pytest.raises(UserError, match="MET_FLOAT"):
        importer_registry.read_source(tmp_path / "c.mha")


def test_six_numbers_of_force_with_pictures_of_which_some_are_invalid(tmp_path: Path) -> None:
    pytest.importorskip("SimpleITK")
    pixels = np.repeat(8 * np.arange(N, dtype=np.uint8), 16 * 24).reshape(N, 16, 24)
    source = write_igs(tmp_path / "a.mha", TIMES, FORCE, "", {2: "Image"}, pixels=pixels)
    intake = importer_registry.read_source(source)
    assert intake.times_s == pytest.approx(np.delete(TIMES, 2), abs=1e-6)
    assert [int(picture.mean()) // 8 for picture in intake.pictures()] == [0, 1, *range(3, N)]
    np.testing.assert_allclose(intake.force, FORCE, atol=1e-6)


@pytest.mark.slow
def test_a_recording_in_that_layout_is_scored_as_its_original(make: Maker, tmp_path: Path) -> None:
    original = make("original", frames=12)
    recording = open_recording(original)
    frames = list(recording.frames())
    times = np.array([frame.time_s for frame in frames])
    force = np.stack(
        [np.interp(times, recording.force.time_s, axis) for axis in recording.force.force_mn.T / 1000], 1
    )
    recording_writer.write_video(tmp_path / "v.mp4", iter([frame.rgb for frame in frames]), times, crf=0)
    source = write_igs(tmp_path / "a.igs.mha", times, force, "v.mp4")
    run(app, "import", source, "-o", tmp_path / "rec", "--scale", 0.2)
    shutil.copy(original / "meta.yaml", tmp_path / "rec")
    ours, theirs = (
        score_recording(folder, backend="dis").methods["bump"].size_mn
        for folder in (tmp_path / "rec", original)
    )
    np.testing.assert_allclose(ours, theirs, atol=0.02 * np.nanmax(theirs))
