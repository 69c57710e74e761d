"""The sequence store: values are read as written, nothing unfinished is visible, damage is reported."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import zarr
from fake_work import attributes, sequence

from synth.checks import contents
from synth.dataset import fast_read, store
from synth.dataset.store import Dataset, Sequence, Writer, open_sequence
from synth.errors import NotFinite, UserError
from synth.fields import FIELDS
from synth.job.schema import Job
from synth.system.stopwatch import Stopwatch

JOB = Job(seed=5, sequences=2, frames=7, render={"size": (40, 30)}, flow={"backend": "ideal"})


def make(job: Job, index: int, folder: Path) -> Sequence:
    sequence(job, index, folder, lambda *_: None)
    return open_sequence(folder / f"{index:06d}.zarr")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for index in range(JOB.sequences):
        make(JOB, index, tmp_path)
    return tmp_path


def test_values_come_back_as_they_were_put(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_SHARD_BYTES", 3 * 40 * 30 * 8)  # several shards, the last one not full
    stored_sequence = make(JOB, 2, root)
    rng = np.random.default_rng((5, 2))
    assert np.array_equal(stored_sequence["force"][:], rng.normal(size=(7, 3)))
    assert np.array_equal(stored_sequence["tissue"][:], rng.random((30, 40)) > 0.2)
    assert np.array_equal(stored_sequence["area"][:], rng.random((30, 40)).astype(np.float32))
    for t in range(7):
        assert np.array_equal(stored_sequence["rgb"][t], rng.integers(0, 256, (30, 40, 3)).astype(np.uint8))
        for name in ("visible", "tool", "glare"):
            assert np.array_equal(stored_sequence[name][t], rng.random((30, 40)) > 0.5)
        assert np.array_equal(stored_sequence["flow"][t], rng.normal(size=(30, 40, 2)).astype(np.float32))
        rng.random((30, 40))
        rng.normal(size=(30, 40, 3))
    assert stored_sequence["flow"].shape == (7, 30, 40, 2)
    assert (stored_sequence.index, stored_sequence.frames, stored_sequence.size) == (2, 7, (30, 40))
    for name in stored_sequence.fields:
        assert stored_sequence[name].dtype == np.dtype(FIELDS[name].dtype)
        assert stored_sequence[name].shape == FIELDS[name].shape(7, (30, 40))


def test_the_content_hash_depends_on_all_attributes_but_timings_and_versions(root: Path) -> None:
    attrs = open_sequence(root / "000000.zarr").attrs
    assert store.content_hash({**attrs, "timings": {}, "versions": {}}) == attrs["content_hash"]
    for key in attrs.keys() - {"timings", "versions", "content_hash", "seal_hash"}:
        assert store.content_hash({**attrs, key: "edited"}) != attrs["content_hash"], key


def test_single_frames_equal_those_read_by_zarr(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store, "_SHARD_BYTES", 3 * 40 * 30 * 8)
    stored_sequence, group = make(JOB, 2, root), zarr.open_group(str(root / "000002.zarr"), mode="r")
    for name in stored_sequence.fields:
        column, array = stored_sequence[name], group[name]
        fast_frames = fast_read.open_frames(array, root / "000002.zarr" / name)
        assert (fast_frames is not None) == FIELDS[name].framed
        for t in (0, 6, 2, -1, -7):
            assert np.array_equal(column[t], array[t])
            assert fast_frames is None or np.array_equal(fast_frames[t], array[t])
    for t in (7, -8):
        with pytest.raises(IndexError):
            stored_sequence["flow"][t]
    column = stored_sequence["flow"]
    column[0]
    (root / "000002.zarr/flow/c/0/0/0/0").write_bytes(b"short")
    with pytest.raises(UserError, match="flow"):
        column[1]


def make_writer(folder: Path) -> Writer:
    return Writer(folder, 9, frames=2, size=(4, 5), job=JOB)


def test_nan_and_wrong_shape_type_order_and_name_are_refused(tmp_path: Path) -> None:
    sink = make_writer(tmp_path)
    sink.put_frame("depth", 0, np.ones((4, 5)))
    with pytest.raises(NotFinite, match="depth, frame 1"):
        sink.put_frame("depth", 1, np.where(np.arange(20).reshape(4, 5) == 13, np.nan, 1.0))
    sink = make_writer(tmp_path)
    wrong_calls = (
        ("depth", 0, (5, 4), "shape"),
        ("rgb", 0, (4, 5, 3), "float64"),
        ("depth", 1, (4, 5), "1 after 0"),
    )
    for name, frame, shape, message in wrong_calls:
        with pytest.raises(ValueError, match=message):
            sink.put_frame(name, frame, np.ones(shape))
    with pytest.raises(ValueError, match="colour"):
        sink.put("colour", np.ones(3))


def test_float16_is_read_as_float32_within_the_stated_error(root: Path, tmp_path: Path) -> None:
    job = JOB.model_copy(update={"store": JOB.store.model_copy(update={"flow": "float16"})})
    (tmp_path / "half").mkdir()
    float32_sequence, float16_sequence = open_sequence(root / "000000.zarr"), make(job, 0, tmp_path / "half")
    assert (float16_sequence["flow"].dtype, float16_sequence["flow"].stored) == ("float32", "float16")
    assert float16_sequence["depth"].stored == "float32"
    assert float16_sequence["flow"][2].dtype == np.float32
    worst_px = float(np.abs(float16_sequence["flow"][:] - float32_sequence["flow"][:]).max())
    stated_px = float16_sequence.attrs["summary"]["rounding_px"]["flow"]
    assert 0 < worst_px <= stated_px * (1 + 1e-3)
    assert stated_px < 0.004, "motion here is below 16 px"
    assert "rounding_px" not in float32_sequence.attrs["summary"]
    assert all(
        measure.good for _, measure in contents.check_values(float16_sequence, [0], False, Stopwatch())
    )


def test_a_job_sets_which_fields_are_stored(tmp_path: Path) -> None:
    job = Job.model_validate({**JOB.model_dump(), "store": {"without": ["depth"]}})
    assert "depth" not in make(job, 0, tmp_path)
    assert not (tmp_path / "000000.zarr/depth").exists()
    for key, name in (("without", "rgb"), ("extra", "wings")):
        with pytest.raises(ValueError, match=name):
            Job.model_validate({"store": {key: [name]}})


def test_nothing_is_visible_before_the_seal(tmp_path: Path) -> None:
    sink = make_writer(tmp_path)
    sink.put("time", np.arange(2.0))
    assert [path.name for path in tmp_path.iterdir()] == ["000009.zarr.part"]
    with pytest.raises(UserError):
        open_sequence(tmp_path / "000009.zarr.part")
    with pytest.raises(ValueError, match="written"):
        sink.seal(**attributes(9, np.random.default_rng(0)))
    with pytest.raises(UserError):
        Dataset(tmp_path)


def test_foreign_and_truncated_stores_are_refused(root: Path) -> None:
    zarr.create_group(str(root / "foreign.zarr"), zarr_format=3)
    (root / "000000.zarr/zarr.json").write_text('{"zarr_form')
    for name in ("foreign", "000007", "000000"):
        with pytest.raises(UserError):
            open_sequence(root / f"{name}.zarr")
    shutil.rmtree(root / "000001.zarr/flow/c/0")
    with pytest.raises(UserError, match="flow"):
        open_sequence(root / "000001.zarr")["flow"]


@pytest.mark.parametrize("cut", [0, 1, 100, -1])
def test_a_truncated_or_flipped_shard_is_an_error_and_never_zeros(root: Path, cut: int) -> None:
    shard = root / "000000.zarr/flow/c/0/0/0/0"
    data = bytearray(shard.read_bytes())
    data[50] ^= cut < 0  # one bit, where nothing is cut off
    shard.write_bytes(data[:cut] if cut >= 0 else data)
    with pytest.raises(UserError, match="flow"):
        open_sequence(root / "000000.zarr")["flow"][:]
    with pytest.raises(UserError, match="flow"):
        [open_sequence(root / "000000.zarr")["flow"][t] for t in range(7)]
