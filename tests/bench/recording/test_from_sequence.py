"""A sequence exported as a recording has the same data, without ground truth that a lab lacks."""

from dataclasses import replace
from pathlib import Path

import fake_work
import numpy as np
import phantom
import pytest
from command import run
from fake_model import write_model

from bench.cli import app
from bench.recording.from_sequence import export_recording
from bench.recording.recording_folder import open_recording
from learn.checkpoint import read_card, write_card
from synth.dataset.store import Dataset, open_sequence
from synth.job.schema import Job

SIZE = (33, 48)
JOB = Job(frames=4, render={"size": SIZE[::-1]}, flow={"backend": "ideal"})


def test_pictures_forces_and_masks_come_back_without_ground_truth(tmp_path: Path) -> None:
    fake_work.sequence(JOB, 0, tmp_path, lambda *_: None)
    sequence = open_sequence(tmp_path / "000000.zarr")
    folder = export_recording(sequence, tmp_path / "rec")
    names = {path.name for path in folder.iterdir()}
    assert names == {"frames", "masks", "force.csv", "frames.csv", "meta.yaml", "tissue.png"}
    recording = open_recording(folder)
    frames = list(recording.frames())
    assert np.array_equal([f.rgb for f in frames], sequence["rgb"][:])
    assert [f.time_s for f in frames] == pytest.approx(sequence["time"][:])
    assert recording.force.force_mn == pytest.approx(sequence["force"][:], abs=1e-5)
    assert recording.meta.scale_mm_per_px == pytest.approx(0.1)
    assert recording.meta.young_kpa == pytest.approx(sequence.attrs["young_kpa"])
    assert np.array_equal(recording.tissue_mask(SIZE), sequence["tissue"][:])
    mask = recording.masks.read(2, SIZE)
    assert np.array_equal(mask, sequence["tool"][2])


def test_the_force_of_one_instrument(tmp_path: Path) -> None:
    fake_work.consistent(JOB, 0, tmp_path, lambda *_: None)
    sequence = open_sequence(tmp_path / "000000.zarr")
    recording = open_recording(export_recording(sequence, tmp_path / "one", instrument=1))
    assert recording.force.force_mn == pytest.approx(sequence["force"][:], abs=1e-5)
    result = run(app, "from-dataset", tmp_path, "-o", tmp_path / "two", "--instrument", "2", code=2)
    assert "instrument 2" in result.output
    assert not (tmp_path / "two").exists()


def test_the_first_sequence_that_no_model_was_trained_on(tmp_path: Path) -> None:
    for index in range(3):
        phantom.write(tmp_path / "data", index, anatomy_seed=7, frames=3)
    hashes = [sequence.attrs["content_hash"] for sequence in Dataset(tmp_path / "data")]
    model = write_model(tmp_path / "model")
    words = ["from-dataset", tmp_path / "data", "--unseen-by", "stereo", "--unseen-by", model, "-o"]
    for parts, exported in ((["fit", "select"], ["000002"]), (["test", "intervals"], ["000000"])):
        split = {part: [content] for part, content in zip(parts, hashes, strict=False)}
        write_card(model, replace(read_card(model), split=split))
        out = tmp_path / parts[0]
        run(app, *words, out)
        assert [folder.name for folder in out.iterdir()] == exported
        assert open_recording(out / exported[0]).meta.specimen == "anatomy seed-7"
        assert not any((out / exported[0] / "masks").iterdir()), "there is no instrument in its pictures"
    write_card(model, replace(read_card(model), split={"fit": hashes}))
    run(app, *words, tmp_path / "none", code=2)
