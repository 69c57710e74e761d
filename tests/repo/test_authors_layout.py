"""A rendered sequence in the layout of the method's authors scores as the same one from the dataset."""

import shutil
from pathlib import Path

import av
import numpy as np
import pytest
from command import run
from fake_recording import score_recording
from igs_sequence import write_igs

from bench.cli import app
from bench.recording.from_sequence import export_recording
from synth.dataset.store import Dataset

pytestmark = pytest.mark.slow


def test_scores_equal_those_from_the_dataset(out: Path, tmp_path: Path) -> None:
    """Pictures without loss in a video beside a sequence without pixels; force in newtons, of six numbers."""
    sequence = Dataset(out)[0]
    original = export_recording(sequence, tmp_path / "direct")
    source = tmp_path / "authors"
    source.mkdir()
    with av.open(str(source / "a.mkv"), "w") as film:
        stream = film.add_stream("ffv1", rate=round(sequence.attrs["fps"]))
        stream.height, stream.width = sequence["rgb"].shape[1:3]
        stream.pix_fmt = "bgr0"
        for rgb in sequence["rgb"][:]:
            film.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(rgb), format="rgb24")))
        film.mux(stream.encode(None))
    times, force_n = np.asarray(sequence["time"][:], float), np.asarray(sequence["force"][:], float) / 1000
    write_igs(source / "a.igs.mha", times, force_n, "a.mkv")
    recording = tmp_path / "imported"
    run(app, "import", source / "a.igs.mha", "-o", recording, "--scale", sequence.attrs["scale_mm_per_px"])
    for name in ("meta.yaml", "tissue.png"):  # what a sequence can't state
        shutil.copy(original / name, recording / name)
    shutil.copytree(original / "masks", recording / "masks", dirs_exist_ok=True)
    first, second = (score_recording(folder) for folder in (original, recording))
    np.testing.assert_allclose(second.time_s, first.time_s, atol=1e-5)
    np.testing.assert_allclose(second.sensor_mn, first.sensor_mn, atol=2e-3)  # written to 1e-6 N
    np.testing.assert_allclose(second.methods["bump"].size_mn, first.methods["bump"].size_mn, rtol=1e-6)
    scores = first.methods["bump"].scores
    assert np.isfinite(scores["mae_mn"])
    assert second.methods["bump"].scores == pytest.approx(scores, rel=2e-3, abs=1e-6, nan_ok=True)
