"""The dataset that comes with the package."""

from pathlib import Path

import numpy as np
import pytest

import synth
from synth.checks.verify import verify_dataset
from synth.dataset import sample


def test_the_sample_is_small_sound_and_unpacked_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert sample._ARCHIVE.stat().st_size < 2e6
    monkeypatch.setenv("SULCUS_CACHE", str(tmp_path))
    sample.cache.folder.cache_clear()
    dataset, second_dataset = synth.sample(), synth.sample()
    sample.cache.folder.cache_clear()
    assert dataset.root == second_dataset.root
    assert dataset.root.is_relative_to(tmp_path)
    assert len(dataset) == 2
    motion_px = np.linalg.norm(dataset[0]["flow"][:], axis=-1)
    assert motion_px[0].max() == 0 < 1 < motion_px.max()
    report = verify_dataset(dataset.root)
    assert report.good, [check.failures for check in report.checks]


def test_items_are_counted_by_whole_numbers_of_any_kind() -> None:
    torch = pytest.importorskip("torch")
    frames = synth.TorchDataset(synth.sample().root, ["rgb"])
    last = len(frames) - 1
    for index in (3, np.int64(3), torch.tensor(3), 3 - len(frames)):
        assert frames[index]["frame"] == 3
    assert frames[-1]["frame"] == frames[last]["frame"]
    for index in (last + 1, -len(frames) - 1):
        with pytest.raises(IndexError):
            frames[index]
