"""What commit f047e99 wrote is read, verified, scored and continued by this one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from synth.errors import UserError
from synth.job import identity, reader, retired
from synth.job.schema import Job
from synth.store import Dataset

IDENTITY = "19097d51b4d9c53d1ff0c404a27f5fdd"
"""Of the job of one/, as f047e99 hashed it."""


def command(package: str, words: Sequence[str | Path]) -> str:
    """Standard output of a command that has to succeed."""
    from importlib import import_module

    done = CliRunner().invoke(import_module(f"{package}.cli").app, [str(word) for word in words])
    assert done.exit_code == 0, f"{done.output} {done.exception!r}"
    return done.output


@pytest.mark.parametrize(("name", "count", "fields"), [("one", 6, 13), ("two", 1, 21), ("rigid", 1, 13)])
def test_a_dataset_is_read(stored: Path, name: str, count: int, fields: int) -> None:
    sequences = list(Dataset(stored / name))
    assert len(sequences) == count
    for sequence in sequences:
        assert np.isfinite(sequence["traction"][3]).all()
        assert len(sequence.attrs["field_hashes"]) == fields


@pytest.mark.parametrize("name", ["one", "rigid"])
def test_a_dataset_is_verified(stored: Path, name: str) -> None:
    command("synth", ["verify", stored / name])


def test_a_dataset_without_a_split_has_the_one_that_its_index_shows(stored: Path) -> None:
    from synth.dataset import index, split

    rows = index.read_index(stored / "one").to_pylist()
    assert not (stored / "one" / split.NAME).exists()
    assert index.read_split(stored / "one").sides == {row["content_hash"]: row["split"] for row in rows}


def test_a_dataset_is_still_the_same_job(stored: Path) -> None:
    from synth.dataset.folder import Folder

    assert identity.identify_job(Folder(stored / "one").job()) == IDENTITY


def test_a_job_file_with_every_key_is_read(stored: Path) -> None:
    job = reader.load_job(str(stored / "full.yaml"))  # its card named no licence and no maker
    then = reader.parse_job("anatomy: {sulcus_mm: [0.6, 1.4]}", "", Path())  # the default of then
    assert job.model_copy(update={"card": Job().card}) == then


@pytest.mark.slow
def test_a_dataset_of_two_eyes_is_continued(stored: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(stored / "two", tmp_path / "two")
    command("synth", ["render", folder / "job.yaml", "-o", folder, "--mix-versions"])
    assert len(list(Dataset(folder))) == 2
    command("synth", ["verify", folder])


def test_an_exported_network_says_what_its_model_says_today(stored: Path) -> None:
    import onnxruntime

    from learn import checkpoint
    from learn.inference.export import Portable, examples

    model, card = checkpoint.read_model(stored / "models" / "epoch")
    given = examples(card, batch=2)
    session = onnxruntime.InferenceSession(str(stored / "network.onnx"))
    names = [one.name for one in session.get_inputs()]
    told = session.run(None, {name: one.numpy() for name, one in zip(names, given, strict=True)})[0]
    with torch.no_grad():
        today = Portable(model, card)(*given)
    np.testing.assert_allclose(told, today.numpy(), atol=1e-5 * np.abs(told).max())


@pytest.mark.parametrize(
    ("model", "store", "force_mn"),
    [
        ("mono", "one", [[0.0008, 0.0007, -0.0009], [2.7680, -1.4197, -1.6565], [3.7548, -3.6686, -1.2682]]),
        ("stereo", "two", [[0.0, 0.0, 0.0], [0.41546, -0.02913, -0.29219], [0.20296, -0.44386, -0.13075]]),
    ],
)
def test_the_networks_that_come_along_answer_as_they_did(
    stored: Path, model: str, store: str, force_mn: list[list[float]]
) -> None:
    from learn.inference.apply import apply
    from learn.inference.motion import motions
    from learn.inference.predict import load_model

    source = "recovered" if store == "one" else "motion"
    (motion,) = motions(stored / store / "000000.zarr", source)
    found = apply(load_model(model), motion)
    np.testing.assert_allclose(found["force_mn"][:3], force_mn, atol=2e-3)


def test_predictions_are_read(stored: Path) -> None:
    with np.load(stored / "predictions" / "000000.npz", allow_pickle=False) as found:
        assert found["force_mn"].shape == (4, 3)
        np.testing.assert_allclose(found["force_mn"][1], [-0.0412, 0.0998, 0.0377], atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "network_mn", "sensor_mn"), [("recording", 3.608, 6.160), ("pair", 6.028, 6.160)]
)
def test_a_recording_is_scored_as_it_was(
    stored: Path, tmp_path: Path, name: str, network_mn: float, sensor_mn: float
) -> None:
    command("bench", ["score", stored / name, "-o", tmp_path / "score"])
    found = json.loads((tmp_path / "score" / "score.json").read_text())
    assert found["methods"]["D2FNet"]["scores"]["mae_mn"] == pytest.approx(network_mn, rel=0.01)
    read = [
        force
        for force, scored, lost in zip(
            *(found["curve"][k] for k in ("sensor_mn", "scored", "lost")), strict=True
        )
        if scored and not lost
    ]
    assert np.mean(read) == pytest.approx(sensor_mn, rel=0.001)


def test_a_retired_key_goes_unsaid_at_its_default_only() -> None:
    table = {"fem.tip": retired.Retired("flat"), "own": retired.Retired({"a": None, "b": 2})}
    assert retired.drop({"fem": {"tip": "flat", "tets": 3}, "own": {"b": 2}}, table) == (
        {"fem": {"tets": 3}},
        {},
    )
    assert retired.drop({"fem": {"tip": "sphere"}}, table) == ({"fem": {}}, {"fem.tip": "sphere"})
    assert retired.restore({"fem": {"tets": 3}}, table) == {
        "fem": {"tets": 3, "tip": "flat"},
        "own": {"a": None, "b": 2},
    }


def test_a_dataset_with_a_retired_contact_is_not_rendered_further(stored: Path, tmp_path: Path) -> None:
    from synth.dataset import folder

    copy = shutil.copytree(stored / "rigid", tmp_path / "rigid")
    with pytest.raises(UserError, match=retired.LAST):
        reader.load_job(str(copy / "job.yaml"))
    job = folder.Folder(copy).job()
    with pytest.raises(UserError, match=retired.LAST), folder.claim(copy, job):
        pass


def test_a_model_with_a_retired_prior_is_refused(stored: Path) -> None:
    from learn import checkpoint

    with pytest.raises(UserError, match=retired.LAST):
        checkpoint.read_model(stored / "models" / "prior")


def test_a_block_that_became_a_word_is_read_as_it() -> None:
    published = {"force_share": 0.02, "noisy_frames": 0.3}
    for block, word in (({}, "none"), (published, "published"), ("published", "published")):
        values, others = retired.drop({"labels": block}, retired.JOB)
        assert (values, others) == ({"labels": word}, {})
        assert retired.restore(values, retired.JOB)["labels"]["force_share"] == (0.02 * (word != "none"))
    assert retired.drop({"labels": {"outliers": 0.1}}, retired.JOB)[1] == {"labels": {"outliers": 0.1}}
    assert retired.drop({"fem": {"crew": [1]}}, retired.JOB) == ({"fem": {"instrument_list": [1]}}, {})
    assert retired.restore({"fem": {"instrument_list": [1]}}, retired.JOB)["fem"]["crew"] == [1]
    assert retired.drop({"fem": {"law": "stable"}}, retired.JOB) == (
        {"fem": {"law": "neo-hookean"}},
        {"fem.law": "stable"},
    )
