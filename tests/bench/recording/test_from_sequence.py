"""A sequence exported as a recording has the same data, without ground truth that a lab lacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_model import write_model
from typer.testing import CliRunner

from bench.cli import app
from bench.recording.folder import open_recording
from bench.recording.from_sequence import export_recording
from learn.checkpoint import read_card, write_card
from synth.dataset.store import Sequence, Writer, open_sequence
from synth.job.schema import Job

SIZE = (33, 48)


def sealed(folder: Path, index: int = 0, frames: int = 4) -> Sequence:
    rng = np.random.default_rng(index)
    job = Job(frames=frames, flow={"backend": "ideal"})
    writer = Writer(folder, index, frames=frames, size=SIZE, job=job)
    writer.put("time", np.arange(frames) / 25.0)
    writer.put("force", rng.normal(size=(frames, 3)))
    tissue = np.zeros(SIZE, bool)
    tissue[4:-4, 4:-4] = True
    writer.put("tissue", tissue)
    writer.put("area", np.ones(SIZE, np.float32))
    for t in range(frames):
        tool = np.zeros(SIZE, bool)
        tool[: 2 * t] = True
        writer.put_frame("rgb", t, rng.integers(0, 255, (*SIZE, 3)).astype(np.uint8))
        for name, value in (("tool", tool), ("glare", ~tissue), ("visible", tissue)):
            writer.put_frame(name, t, value)
        writer.put_frame("flow", t, np.zeros((*SIZE, 2), np.float32))
        writer.put_frame("depth", t, np.full(SIZE, 300, np.float32))
        writer.put_frame("traction", t, np.zeros((*SIZE, 3), np.float32))
    about = {"anatomy_id": "seed-7", "scale_mm_per_px": 0.07, "young_kpa": 1.4, "poisson": 0.4}
    return open_sequence(writer.seal(**about))


def test_pictures_forces_and_masks_come_back_without_ground_truth(tmp_path: Path) -> None:
    sequence = sealed(tmp_path)
    folder = export_recording(sequence, tmp_path / "rec")
    names = {path.name for path in folder.iterdir()}
    assert names == {"frames", "masks", "force.csv", "frames.csv", "meta.yaml", "tissue.png"}
    recording = open_recording(folder)
    frames = list(recording.frames())
    assert np.array_equal(np.stack([f.rgb for f in frames]), sequence["rgb"][:])
    assert [f.time_s for f in frames] == pytest.approx(sequence["time"][:])
    assert recording.force is not None
    assert recording.force.force_mn == pytest.approx(sequence["force"][:], abs=1e-5)
    assert recording.meta.scale_mm_per_px == pytest.approx(0.07)
    assert recording.meta.young_kpa == pytest.approx(1.4)
    assert recording.meta.specimen == "anatomy seed-7"
    assert np.array_equal(recording.tissue_mask(SIZE), sequence["tissue"][:])
    assert recording.masks.read(0, SIZE) is None
    mask = recording.masks.read(2, SIZE)
    assert mask is not None
    assert np.array_equal(mask, sequence["tool"][2])


def test_the_first_sequence_that_no_model_was_trained_on(tmp_path: Path) -> None:
    hashes = [sealed(tmp_path / "data", index).attrs["content_hash"] for index in range(3)]
    model = write_model(tmp_path / "model")
    words = ["from-dataset", str(tmp_path / "data"), "--unseen-by", "mono", "--unseen-by", str(model)]
    for parts, exported in ((["fit", "select"], ["000002"]), (["test", "intervals"], ["000000"])):
        split = {part: [content] for part, content in zip(parts, hashes, strict=False)}
        write_card(model, replace(read_card(model), split=split))
        out = tmp_path / parts[0]
        assert CliRunner().invoke(app, [*words, "-o", str(out)]).exit_code == 0
        assert [folder.name for folder in out.iterdir()] == exported
    write_card(model, replace(read_card(model), split={"fit": hashes}))
    assert CliRunner().invoke(app, [*words, "-o", str(tmp_path / "none")]).exit_code == 2
