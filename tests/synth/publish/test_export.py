"""Exports and the frame reader give back the store's own values."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import numpy as np
import pytest
from fake_work import consistent
from PIL import Image
from typer.testing import CliRunner

from synth.cli import app
from synth.dataset.store import Dataset
from synth.dataset.torch_dataset import Frames
from synth.errors import UserError
from synth.job.schema import Job
from synth.publish.export import webdataset
from synth.publish.export.formats import export_dataset


def quiet(stage: str, done: int, of: int) -> None:
    """Progress that nobody looks at."""


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export")
    job = Job(sequences=2, frames=3, render={"size": (48, 36), "stereo_mm": 24.0}, flow={"backend": "ideal"})
    for index in range(2):
        consistent(job, index, out, quiet)
    return out


def test_folder(root: Path, tmp_path: Path) -> None:
    assert CliRunner().invoke(app, ["export", str(root), str(tmp_path / "to")]).exit_code == 0
    sequence = Dataset(root)[1]
    here = tmp_path / "to" / "000001"
    assert np.array_equal(np.asarray(Image.open(here / "rgb/0002.png")), sequence["rgb"][2])
    assert np.array_equal(np.asarray(Image.open(here / "rgb_right/0001.png")), sequence["rgb_right"][1])
    for name in sequence.fields:
        assert name.startswith("rgb") or np.array_equal(np.load(here / f"{name}.npy"), sequence[name][:])
    assert json.loads((here / "attributes.json").read_text()) == sequence.attrs


def test_webdataset(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webdataset, "_SHARD_BYTES", 50_000)
    export_dataset(root, tmp_path / "to", "webdataset")
    found = {}
    shards = sorted((tmp_path / "to").glob("*.tar"))
    for shard in shards:
        with tarfile.open(shard) as archive:
            members = archive.getmembers()
            found.update({one.name: archive.extractfile(one).read() for one in members})  # type: ignore[union-attr]
        keys = [one.name.split(".")[0] for one in members]
        assert keys == sorted(keys), "a sample's files lie together"
    assert len(shards) > 1
    sequence = Dataset(root)[0]
    assert len([name for name in found if name.endswith(".json")]) == 6
    assert np.array_equal(np.load(io.BytesIO(found["000000_0001.flow.npy"])), sequence["flow"][1])
    assert np.array_equal(
        np.asarray(Image.open(io.BytesIO(found["000000_0001.rgb.png"]))), sequence["rgb"][1]
    )


def test_hdf5(root: Path, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    export_dataset(root, tmp_path / "to", "hdf5")
    with h5py.File(tmp_path / "to/000001.h5") as file:
        sequence = Dataset(root)[1]
        for name in sequence.fields:
            assert np.array_equal(file[name][...], sequence[name][:])
        assert file["flow"].attrs["unit"] == "px"
        assert json.loads(file.attrs["attributes"])["content_hash"] == sequence.attrs["content_hash"]


def test_npz_of_the_published_code(root: Path, tmp_path: Path) -> None:
    export_dataset(root, tmp_path / "to", "d2fnet-npz")
    files = sorted((tmp_path / "to").glob("*/brain_surface_*_auto_projected_*_2d.npz"))
    assert len(files) == 2
    sequence = Dataset(root)[0]
    with np.load(files[0]) as first, np.load(files[1]) as second:
        frames, nodes, _ = first["disp2d"].shape
        assert (frames, first["force_mag"].shape) == (3, (3, nodes))
        assert second["disp2d"].shape[1] == nodes, "that code takes all files to have the nodes of the first"
        total_n = np.linalg.norm(sequence["force"][:], axis=1) / 1000
        assert first["force_mag"].max(axis=1) == pytest.approx(total_n, rel=0.02)
        column, row = first["projected_pixels"][0, 100].astype(int)
        expected = sequence["flow"][2][row, column] * sequence.attrs["scale_mm_per_px"]
        assert first["disp2d"][2, 100] == pytest.approx(expected, rel=1e-5)


def test_refusals_leave_nothing(root: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="is not one of folder"):
        export_dataset(root, tmp_path / "to", "excel")
    with pytest.raises(UserError, match="exists already"):
        export_dataset(root, tmp_path, "folder")
    with pytest.raises(UserError, match="no such folder"):
        export_dataset(tmp_path / "nothing", tmp_path / "to", "folder")
    assert list(tmp_path.iterdir()) == []


def test_frames_are_those_of_the_store(root: Path) -> None:
    frames = Frames(root, ["rgb", "flow", "area", "force"])
    assert len(frames) == 6
    item, sequence = frames[4], Dataset(root)[1]
    assert (item["index"], item["frame"]) == (1, 1)
    assert np.array_equal(item["flow"], sequence["flow"][1])
    assert np.array_equal(item["area"], sequence["area"][:])
    assert np.array_equal(item["force"], sequence["force"][1])
    assert Frames(root, ["rgb"], sequences=[1])[0]["index"] == 1
    with pytest.raises(IndexError):
        frames[6]
    with pytest.raises(UserError, match="no such field"):
        Frames(root, ["colour"])
    with pytest.raises(UserError, match="has no flow_recovered"):
        Frames(root, ["flow_recovered"])


@pytest.mark.slow
@pytest.mark.parametrize("method", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_frames_in_workers_of_a_loader(root: Path, method: str) -> None:
    from torch.utils.data import DataLoader

    frames = Frames(root, ["rgb", "tissue"])
    before = frames[5]["rgb"]  # the parent has open stores and a running event loop when it forks
    loader = DataLoader(frames, batch_size=2, num_workers=1, multiprocessing_context=method)
    batches = list(loader)
    assert [batch["frame"].tolist() for batch in batches] == [[0, 1], [2, 0], [1, 2]]
    assert np.array_equal(batches[2]["rgb"][1].numpy(), before)
