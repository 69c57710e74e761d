"""Default runs give what they gave: bit for bit where packages and processor are the same.

A sequence: since relief, cameras and edges of the third look (default.json); an epoch: since commit f047e99.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from older_split import split_as

from synth.dataset.store import open_sequence
from synth.job import reader
from synth.sequence import pipeline
from synth.system import packages

CAPABILITY = "AVX512"
"""Of the processor that made the golden ones: another adds in another order."""


@pytest.mark.slow
def test_a_default_sequence_keeps_its_bytes(stored: Path, tmp_path: Path) -> None:
    before = json.loads(Path(__file__).with_name("default.json").read_text())
    job = reader.load_job(str(stored / "default" / "job.yaml"))
    pipeline.render_sequence(job, 0, tmp_path, lambda stage, done, of: None)
    now = open_sequence(tmp_path / "000000.zarr")
    hashes = before["field_hashes"]
    assert now.attrs["field_hashes"].keys() == hashes.keys()
    exact = torch.backends.cpu.get_cpu_capability() == CAPABILITY
    same = before["versions"].items() <= packages.versions().items()
    if exact and same and now.attrs["variant"] == before["variant"]:
        assert [name for name in hashes if now.attrs["field_hashes"][name] != hashes[name]] == []
    for name, (mean, largest) in before["mean_and_largest"].items():
        size = np.abs(np.asarray(now[name], np.float64))
        assert size.mean() == pytest.approx(mean, rel=1e-3), name
        assert size.max() == pytest.approx(largest, rel=1e-2), name


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
