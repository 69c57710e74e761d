"""Labels of the published method: both stages of noise, and their fields in a dataset."""

from pathlib import Path

import numpy as np
import pytest

from synth.dataset.store import open_sequence
from synth.job import reader
from synth.sequence import published_labels
from synth.sequence.pipeline import render_sequence

SIZE = (40, 50)
TISSUE = np.ones(SIZE, bool)
TISSUE[:, :5] = False


def make_scene() -> tuple[np.ndarray, np.ndarray]:
    """A smooth flow and a round load on it."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    distance = np.hypot(rows - 20, columns - 30) / 6
    load = np.clip(1 - distance**2, 0, None)[..., None] ** 2 * (0.0, 3.0, 4.0)
    flow = np.exp(-(distance[..., None] ** 2) / 8) * (4.0, -2.0) * TISSUE[..., None]
    return flow.astype(np.float32), load


def test_intensity_peaks_at_the_total_force_and_keeps_direction() -> None:
    _, load = make_scene()
    label = published_labels.intensity(load, 70.0)
    assert np.linalg.norm(label, axis=-1).max() == pytest.approx(70.0)
    np.testing.assert_allclose(label * 5.0, load * 70.0, atol=1e-9)
    assert not published_labels.intensity(0 * load, 0.0).any()


def test_first_stage_has_the_given_deviation() -> None:
    label = np.zeros((*SIZE, 3))
    label[..., 2] = 50.0
    noisy = published_labels.add_noise(label, TISSUE, 0.02, np.random.default_rng(0))
    assert not noisy[~TISSUE].any()
    assert (noisy - label)[TISSUE].std() == pytest.approx(1.0, rel=0.05)
    noiseless = published_labels.add_noise(label, TISSUE, 0.0, np.random.default_rng(0))
    np.testing.assert_array_equal(noiseless[TISSUE], label[TISSUE])


def test_second_stage_disturbs_the_given_share_away_from_the_contact() -> None:
    flow, load = make_scene()
    label = np.linalg.norm(published_labels.intensity(load, 70.0), axis=-1)
    noisy, kept_label = published_labels.disturb(flow, label, TISSUE, np.random.default_rng(0))
    disturbed = (noisy != flow).any(axis=-1)
    assert disturbed.sum() == pytest.approx(0.05 * TISSUE.sum(), abs=1)
    assert not disturbed[~TISSUE].any()
    assert not kept_label[disturbed].any()
    np.testing.assert_array_equal(kept_label[~disturbed], label[~disturbed])
    span = np.ptp(flow[TISSUE], axis=0)
    assert (np.abs(noisy - flow).reshape(-1, 2).max(axis=0) <= 0.05 * span).all()
    assert (np.abs(noisy - flow).reshape(-1, 2).max(axis=0) >= 0.03 * span).all()
    pressed_pixels = np.argwhere(label > np.percentile(label[TISSUE], 90))
    reach = 1.5 * np.linalg.norm(pressed_pixels - pressed_pixels.mean(axis=0), axis=1).max()
    assert np.linalg.norm(np.argwhere(disturbed) - pressed_pixels.mean(axis=0), axis=1).min() > reach


@pytest.mark.slow
def test_the_papers_dataset_holds_noisy_labels_next_to_the_truth(tmp_path: Path) -> None:
    settings = ["frames=12", "anatomy.vertices=2500", "fem.tets=600", "render.size=[96,72]", "render.spp=1"]
    job = reader.load_job("paper", [*settings, "flow.backend=dis"])
    sequence = open_sequence(render_sequence(job, 0, tmp_path, lambda *_: None))
    flow, noisy, label = sequence["flow"][:], sequence["flow_noisy"][:], sequence["intensity"][:]
    force = np.linalg.norm(sequence["force"][:], axis=1)
    disturbed = (flow != noisy).any(axis=-1)
    assert np.count_nonzero(disturbed.any(axis=(1, 2))) == 3  # 30% of 12
    assert not disturbed[0].any()
    assert not label[disturbed].any()
    assert (disturbed.sum(axis=(1, 2)) <= 0.05 * sequence["tissue"][:].sum()).all()
    loaded_frames = force > 0.05 * force.max()
    peaks = label.max(axis=(1, 2))
    np.testing.assert_allclose(peaks[loaded_frames], force[loaded_frames], rtol=0.15)
    # The first stage is there as well.
    assert not np.allclose(peaks[loaded_frames], force[loaded_frames], rtol=1e-4)
