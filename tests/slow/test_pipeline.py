"""The whole pipeline on a small job: its labels hold; a killed run gives the bytes of an undisturbed one."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from synth.checks import verify
from synth.dataset.store import Dataset
from synth.engine.run import render_job
from synth.job.reader import load_job

JOB = """
seed: 5
sequences: 2
frames: 3
anatomy: {vertices: 2500}
fem: {tets: 400, load: 0.1}
render: {size: [96, 72], spp: 1}
"""


def start(job: Path, out: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "synth", "render", str(job), "-o", str(out), "--workers", "1"]
    quiet, errors = subprocess.DEVNULL, subprocess.PIPE
    return subprocess.Popen(command, start_new_session=True, stdout=quiet, stderr=errors)


def finish(process: subprocess.Popen[bytes]) -> None:
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors.decode()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pipeline")
    job, out = folder / "job.yaml", folder / "out"
    job.write_text(JOB)
    assert not render_job(load_job(job), out, workers=1).failed
    return out


def test_the_dataset_passes_all_checks_and_traction_sums_to_the_force(undisturbed: Path) -> None:
    report = verify.verify_dataset(undisturbed)
    assert report.good, [check.failures for check in report.checks]
    for sequence in Dataset(undisturbed):
        total = np.einsum("thwk,hw->tk", sequence["traction"][...], sequence["area"][...])
        force = sequence["force"][...]
        assert np.linalg.norm(force, axis=1).max() > 0
        # A pixel of 0.4 mm is a tenth of the contact: the quadrature error exceeds the 1% of larger pictures.
        assert np.abs(total - force).max() <= 0.03 * np.linalg.norm(force, axis=1).max()


@pytest.mark.trial
def test_killed_and_resumed_equals_undisturbed(undisturbed: Path, tmp_path: Path) -> None:
    job, out = undisturbed.parent / "job.yaml", tmp_path / "out"
    process = start(job, out)
    limit = time.monotonic() + 120
    # Killed with everything it started, in the middle of the second sequence.
    while not list(out.glob("000001.zarr.part")):
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < limit
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate()
    assert [path.name for path in Dataset(out).paths] == ["000000.zarr"]

    finish(start(job, out))
    hashes = [[s.attrs["content_hash"] for s in Dataset(folder)] for folder in (undisturbed, out)]
    assert hashes[0] == hashes[1]
    assert not list(out.glob("*.part"))
