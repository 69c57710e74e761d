"""Default runs give what commit f047e99 gave: bit for bit where packages and processor are the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from older_split import split_as

from synth.dataset.store import open_sequence
from synth.job import reader
from synth.sequence import pipeline
from synth.system import packages

_RECOVERED = "flow_recovered", "flow_confidence", "motion_recovered", "motion_deviation"
CAPABILITY = "AVX512"
"""Of the processor that made the golden ones: another adds in another order."""


@pytest.mark.slow
def test_a_default_sequence_keeps_its_bytes(stored: Path, tmp_path: Path) -> None:
    before = open_sequence(stored / "default" / "000000.zarr")
    job = reader.load_job(str(stored / "default" / "job.yaml"))
    pipeline.render_sequence(job, 0, tmp_path, lambda stage, done, of: None)
    now = open_sequence(tmp_path / "000000.zarr")
    assert now.attrs["field_hashes"].keys() == before.attrs["field_hashes"].keys()
    assert now.attrs["job"] == before.attrs["job"]
    exact = torch.backends.cpu.get_cpu_capability() == CAPABILITY
    theirs = {name: v for name, v in before.attrs["versions"].items() if name in packages.versions()}
    same = theirs == {name: packages.versions()[name] for name in theirs}
    if exact and same and now.attrs["variant"] == before.attrs["variant"]:
        changed = [
            name
            for name, value in before.attrs["field_hashes"].items()
            # What is recovered has been corrected and its confidence been a deviation since.
            if now.attrs["field_hashes"][name] != value and not name.startswith(_RECOVERED)
        ]
        assert not changed
    for name in ("flow", "traction", "force", "depth"):
        largest = float(np.abs(before[name]).max())
        np.testing.assert_allclose(now[name], before[name], rtol=0, atol=1e-3 * largest)
    for name in ("rgb", "rgb_right"):
        off = np.abs(np.asarray(now[name], np.int16) - np.asarray(before[name], np.int16))
        assert off.max() <= 1, name
        assert off.mean() < 2e-3, name


@pytest.mark.slow
def test_an_epoch_keeps_its_weights(stored: Path, tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from learn import checkpoint
    from learn.cli import app

    small = ["--preset", "tiny", "--epochs", "1", "size=16", "arch.width=4", "arch.levels=2"]
    data = split_as(stored / "one", stored / "models" / "epoch", tmp_path / "one")
    done = CliRunner().invoke(app, ["train", str(data), "-o", str(tmp_path / "model"), *small])
    assert done.exit_code == 0, done.output
    now = checkpoint.load_tensors(tmp_path / "model" / "weights.pt")
    then = checkpoint.load_tensors(stored / "models" / "epoch" / "weights.pt")
    assert now.keys() == then.keys()
    exact = torch.backends.cpu.get_cpu_capability() == CAPABILITY
    for name, value in then.items():
        assert not exact or torch.equal(now[name], value), name
        np.testing.assert_allclose(now[name].numpy(), value.numpy(), rtol=1e-3, atol=1e-5)
