"""The whole pipeline on a small job, by its command: its labels hold."""

from pathlib import Path

import numpy as np
from command import run

from synth.checks import verify
from synth.cli import app
from synth.dataset.store import Dataset

JOB = """
seed: 5
sequences: 2
frames: 3
anatomy: {vertices: 2500}
fem: {tets: 400, load: 0.1}
render: {size: [96, 72], spp: 1}
"""


def test_the_dataset_passes_all_checks_and_traction_sums_to_the_force(tmp_path: Path) -> None:
    (tmp_path / "job.yaml").write_text(JOB)
    run(app, "render", tmp_path / "job.yaml", "-o", tmp_path / "out", "--workers", 1)
    report = verify.verify_dataset(tmp_path / "out")
    assert report.good, [check.failures for check in report.checks]
    for sequence in Dataset(tmp_path / "out"):
        total = np.einsum("thwk,hw->tk", sequence["traction"][...], sequence["area"][...])
        force = sequence["force"][...]
        assert np.linalg.norm(force, axis=1).max() > 0
        # A pixel of 0.4 mm is a tenth of the contact: the quadrature error exceeds the 1% of larger pictures.
        assert np.abs(total - force).max() <= 0.03 * np.linalg.norm(force, axis=1).max()
