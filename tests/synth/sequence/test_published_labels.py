"""The published method's labels: both stages of noise do what they say, and a dataset holds them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from learn.data import clips
from learn.data.grid import Grid
from synth.checks import verify
from synth.dataset.store import Dataset
from synth.job import reader
from synth.job.schema import Labels
from synth.sequence import published_labels

SIZE = (40, 50)
TISSUE = np.ones(SIZE, bool)
TISSUE[:, :5] = False


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A smooth flow and a round load on it."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    away = np.hypot(rows - 20, columns - 30) / 6
    load = np.clip(1 - away**2, 0, None)[..., None] ** 2 * (0.0, 3.0, 4.0)
    flow = np.exp(-(away[..., None] ** 2) / 8) * (4.0, -2.0) * TISSUE[..., None]
    return flow.astype(np.float32), load


def test_intensity_peaks_at_the_total_force_and_keeps_direction() -> None:
    _, load = scene()
    label = published_labels.intensity(load, 70.0)
    assert np.linalg.norm(label, axis=-1).max() == pytest.approx(70.0)
    np.testing.assert_allclose(label * 5.0, load * 70.0, atol=1e-9)
    assert not published_labels.intensity(0 * load, 0.0).any()


def test_first_stage_has_the_deviation_asked_for() -> None:
    label = np.zeros((*SIZE, 3))
    label[..., 2] = 50.0
    rng = np.random.default_rng(0)
    noisy = published_labels.with_noise(label, TISSUE, Labels(force_std_mn=1.0, force_share=0.02), rng)
    assert not noisy[~TISSUE].any()
    assert (noisy - label)[TISSUE].std() == pytest.approx(2.0, rel=0.05)
    biased = published_labels.with_noise(label, TISSUE, Labels(force_bias_mn=3.0), rng)
    np.testing.assert_allclose((biased - label)[TISSUE], 3.0)
    some = Labels(force_std_mn=1.0, outliers=0.1, outlier_scale=100.0)
    far = np.abs(published_labels.with_noise(label, TISSUE, some, rng) - label)[TISSUE].max(axis=1) > 10
    assert far.mean() == pytest.approx(0.1, abs=0.02)


def test_second_stage_disturbs_the_share_asked_for_away_from_the_contact() -> None:
    flow, load = scene()
    label = np.linalg.norm(published_labels.intensity(load, 70.0), axis=-1)
    noise = Labels()
    noisy, left = published_labels.disturbed(flow, label, TISSUE, noise, np.random.default_rng(0))
    moved = (noisy != flow).any(axis=-1)
    assert moved.sum() == pytest.approx(0.05 * TISSUE.sum(), abs=1)
    assert not moved[~TISSUE].any()
    assert not left[moved].any()
    np.testing.assert_array_equal(left[~moved], label[~moved])
    span = np.ptp(flow[TISSUE], axis=0)
    assert (np.abs(noisy - flow).reshape(-1, 2).max(axis=0) <= 0.05 * span).all()
    assert (np.abs(noisy - flow).reshape(-1, 2).max(axis=0) >= 0.03 * span).all()
    pressed = np.argwhere(label > np.percentile(label[TISSUE], 90))
    reach = 1.5 * np.linalg.norm(pressed - pressed.mean(axis=0), axis=1).max()
    assert np.linalg.norm(np.argwhere(moved) - pressed.mean(axis=0), axis=1).min() > reach


def test_frames_are_chosen_clear_of_the_ends() -> None:
    chosen = published_labels.noisy_frames(60, Labels(), np.random.default_rng(0))
    assert chosen.sum() == 18
    assert not chosen[:6].any()
    assert not chosen[-6:].any()
    assert not published_labels.noisy_frames(60, Labels(noisy_frames=0.0), np.random.default_rng(0)).any()


@pytest.fixture(scope="module")
def regime(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The paper's job, small."""
    out = tmp_path_factory.mktemp("paper") / "out"
    small = ["sequences=1", "frames=12", "anatomy.vertices=2500", "fem.tets=600", "render.size=[96,72]"]
    command = [sys.executable, "-m", "synth", "render", "paper", "-o", str(out), *small, "render.spp=1"]
    subprocess.run([*command, "flow.backend=dis", "--workers", "1"], check=True, capture_output=True)
    return out


def test_the_paper_job_is_the_published_regime() -> None:
    job = reader.load_job("paper")
    assert (job.fem.law, job.fem.order, job.fem.tets) == ("corotational", 1, 4096)
    assert (job.fem.young_kpa, job.fem.poisson) == ((0.5, 0.5), (0.4, 0.4))
    assert (job.fem.time, job.fem.dt_s, job.fem.mass_kg, job.fem.damping) == ("dynamic", 0.03, 1.0, 2.0)
    assert 1 / job.fps == pytest.approx(job.fem.dt_s)
    assert job.anatomy.vertices == 40_000
    assert {"intensity", "flow_noisy"} <= set(job.kept_fields)


@pytest.mark.slow
def test_its_dataset_holds_noisy_labels_beside_the_truth_and_is_read_as_any_other(regime: Path) -> None:
    report = verify.verify_dataset(regime)
    assert report.good, [check.failures for check in report.checks]
    sequence = Dataset(regime)[0]
    flow, noisy = sequence["flow"][...], sequence["flow_noisy"][...]
    force = np.linalg.norm(sequence["force"][...], axis=1)
    label = sequence["intensity"][...]
    tissue = sequence["tissue"][...]
    disturbed = [(f != n).any(axis=-1) for f, n in zip(flow, noisy, strict=True)]
    assert [bool(d.any()) for d in disturbed].count(True) == 3  # 30% of 12
    assert not disturbed[0].any()
    for mask, there in zip(disturbed, label, strict=True):
        assert mask.sum() <= 0.05 * tissue.sum()
        assert not there[mask].any()
    loaded = force > 0.05 * force.max()
    peaks = label.max(axis=(1, 2))
    np.testing.assert_allclose(peaks[loaded], force[loaded], rtol=0.15)
    assert not np.allclose(peaks[loaded], force[loaded], rtol=1e-4)  # the first stage is there as well
    clip = clips.read_clip(sequence, Grid(32), ("ideal", "recovered"))
    assert np.isfinite(clip.density).all()
    assert clip.density.any()
