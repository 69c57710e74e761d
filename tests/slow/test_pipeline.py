"""The real pipeline, small: its labels hold."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from synth.checks import verify
from synth.dataset.store import Dataset

JOB = """
seed: 5
sequences: 2
frames: 3
anatomy: {vertices: 2500}
fem: {tets: 400, load: 0.1}
render: {size: [96, 72], spp: 1}
"""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pipeline")
    job, out = folder / "job.yaml", folder / "out"
    job.write_text(JOB)
    command = [sys.executable, "-m", "synth", "render", str(job), "-o", str(out), "--workers", "1"]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 0, done.stderr
    return out


def test_the_dataset_passes_its_own_checks(undisturbed: Path) -> None:
    report = verify.verify_dataset(undisturbed)
    assert report.good, [check.failures for check in report.checks]


def test_pixels_carry_the_applied_force(undisturbed: Path) -> None:
    for sequence in Dataset(undisturbed):
        total = np.einsum("thwk,hw->tk", sequence["traction"][...], sequence["area"][...])
        force = sequence["force"][...]
        assert np.linalg.norm(force, axis=1).max() > 0
        # One pixel is 0.4 mm here, a tenth of the contact: quadrature costs more than the 1% of real sizes.
        assert np.abs(total - force).max() <= 0.03 * np.linalg.norm(force, axis=1).max()
