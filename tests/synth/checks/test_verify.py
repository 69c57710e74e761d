"""`synth verify`: a good dataset passes, each check finds its fault; what others edited is refused."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fake_work
import foreign_video
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import zarr
from fake_run import in_process

from synth.checks import verify
from synth.dataset import index, sequence_split
from synth.dataset.dataset_folder import claim
from synth.dataset.store import open_sequence
from synth.errors import UserError
from synth.job.schema import Job
from synth.publish.export.exporter_registry import export_dataset

PAIR = {"size": (96, 72), "stereo_mm": 24.0}
JOB = Job(seed=1, sequences=2, frames=5, render=PAIR, flow={"backend": "ideal"})


@pytest.fixture(scope="module")
def good_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pristine") / "out"
    in_process(JOB, root, fake_work.consistent)
    return root


@pytest.fixture
def dataset(good_dataset: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good_dataset, tmp_path / "out"))


def list_faults(root: Path, fast: bool = False) -> set[str]:
    return {check.name for check in verify.verify_dataset(root, fast=fast).checks if check.bad}


def test_a_good_dataset_passes_and_every_invariant_was_measured(dataset: Path) -> None:
    report = verify.verify_dataset(dataset)
    assert report.good, [check.failures for check in report.checks]
    assert {check.name: check.count > 0 for check in report.checks} == dict.fromkeys(verify.MEANINGS, True)
    assert verify.verify_dataset(dataset, fast=True).good


FAULTS = {"force": ("force", "no_force"), "picture": ("black", "no_tissue"), "warp": ("flow",)}
FAULTS |= {
    "rest": ("rest", "load_rest", "recovered_rest"),
    "visibility": ("visibility",),
    "range": ("depth",),
}
FAULTS |= {"camera": ("camera", "scale"), "contact": ("contact",), "compliance": ("compliance",)}
FAULTS |= {"stereo": ("motion", "disparity", "right_flow", "right_depth"), "forward_backward": ("fold",)}
"""Faults of the stand-in by the check that finds them."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("check", "fault"), [(check, fault) for check, faults in FAULTS.items() for fault in faults]
)
def test_a_faulty_pipeline_is_found_by_the_check_made_for_it(tmp_path: Path, fault: str, check: str) -> None:
    # A monocular job has recovered flow without recovered motion in space, which `fake_work` doesn't make.
    monocular = Job(seed=1, sequences=1, frames=5, render={"size": (96, 72)})
    job = monocular if fault == "recovered_rest" else JOB.model_copy(update={"sequences": 1})
    in_process(job, tmp_path / "out", fake_work.wrong(fault))
    result = next(result for result in verify.verify_dataset(tmp_path / "out").checks if result.name == check)
    assert result.bad
    assert result.offender.startswith("000000.zarr: ")
    assert result.cpu_s > 0
    # Checks of integrity pass, as the files are as they were written.
    assert not list_faults(tmp_path / "out") & {"checksum", "seal", "schema", "readable", "dataset", "finite"}


def test_what_had_nothing_to_check_is_not_counted_as_good(tmp_path: Path) -> None:
    job = Job(seed=1, sequences=1, frames=5, render={"size": (96, 72)}, flow={"backend": "ideal"})
    in_process(job, tmp_path / "out", fake_work.wrong("still"))
    report = verify.verify_dataset(tmp_path / "out", fast=True)
    empty_checks = {check.name: sum(check.why.values()) for check in report.checks if not check.count}
    assert empty_checks == {"checksum": 1, "force": 1, "compliance": 1, "contact": 1, "stereo": 1}
    assert report.good
    assert f" {len(report.checks) - len(empty_checks)} checks" in report.lines()[-1]
    assert all(name in report.as_dict()["verdict"] for name in empty_checks)


def test_a_dataset_without_a_finished_sequence_is_not_good(tmp_path: Path) -> None:
    with claim(tmp_path / "out", JOB.model_copy(update={"sequences": 1})) as folder:
        folder.mark_failed({"index": 0, "reason": "refused"})
        index.write_index(folder)
    assert list_faults(tmp_path / "out") == {"dataset"}


def put_nan(root: Path) -> None:
    zarr.open_group(str(root / "000001.zarr"), mode="r+")["force"][2, 1] = np.nan


def leak_split(root: Path) -> None:
    rows = index.read_index(root).to_pylist()
    for row, side in zip(rows, ("train", "test"), strict=True):
        row.update(anatomy="mesh-1", split=side)
    index.save_rows(root, rows)


def edit_axes(root: Path) -> None:
    path = root / "000000.zarr/flow/zarr.json"
    path.write_text(path.read_text().replace('"row"', '"column "'))


def edit_generator(root: Path) -> None:
    manifest = json.loads((root / "dataset.json").read_text())
    manifest["generators"][0]["content"] = "another"
    (root / "dataset.json").write_text(json.dumps(manifest))


def swap_sequences(root: Path) -> None:
    (root / "000000.zarr").rename(root / "x")
    (root / "000001.zarr").rename(root / "000000.zarr")
    (root / "x").rename(root / "000001.zarr")


def replace_value(root: Path) -> None:
    """Changes a value through Zarr, which updates the chunk's checksum."""
    array = zarr.open_group(str(root / "000001.zarr"), mode="r+")["depth"]
    array[3, 5, 5] = np.float32(array[3, 5, 5]) + np.float32(1e-3)


def truncate_chunk(root: Path) -> None:
    shard = next(path for path in (root / "000001.zarr/rgb/c").rglob("*") if path.is_file())
    shard.write_bytes(shard.read_bytes()[:-10])


@pytest.mark.parametrize(
    ("damage", "failures"),
    [
        (put_nan, {"finite", "checksum", "rest"}),
        (leak_split, {"splits", "dataset"}),
        (edit_axes, {"schema"}),
        (edit_generator, {"dataset"}),
        (
            lambda root: foreign_video.edit_attributes(root / "000000.zarr", False, young_kpa=2),
            {"seal", "dataset"},
        ),
        (swap_sequences, {"seal", "dataset"}),
        (replace_value, {"checksum"}),
        (truncate_chunk, {"readable"}),
        (lambda root: shutil.rmtree(root / "000001.zarr"), {"dataset"}),
        (lambda root: (root / "index.parquet").write_bytes(b"PAR1"), {"dataset"}),
    ],
)
def test_damage_is_found(dataset: Path, damage: Callable[[Path], object], failures: set[str]) -> None:
    damage(dataset)
    assert list_faults(dataset) == failures


@pytest.mark.parametrize(
    "changes",
    [{"young_kpa": np.nan}, {"frames": 10**9}, {"scenario": {"gestures": "pull"}}, {"format_version": 1}],
)
def test_invalid_attributes_are_refused_though_sealed(dataset: Path, changes: dict[str, Any]) -> None:
    foreign_video.edit_attributes(dataset / "000000.zarr", **changes)
    with pytest.raises(UserError):
        open_sequence(dataset / "000000.zarr")
    assert "readable" in list_faults(dataset)


def test_an_edited_sequence_is_not_exported(dataset: Path) -> None:
    foreign_video.edit_attributes(dataset / "000000.zarr", reseal=False, young_kpa=2.0)
    with pytest.raises(UserError):
        export_dataset(dataset, dataset / "to", "folder")


@pytest.mark.parametrize("text", ['{"by": 7}', "\x00"])
def test_an_index_of_another_program_and_a_damaged_split_are_refused(dataset: Path, text: str) -> None:
    pq.write_table(pa.table({"a": [1]}), dataset / "index.parquet")
    with pytest.raises(UserError):
        index.read_index(dataset)
    assert "dataset" in list_faults(dataset)
    (dataset / "split.json").write_text(text)
    with pytest.raises(UserError, match="split"):
        sequence_split.read_stored(dataset)


def test_no_run_follows_a_link(dataset: Path, tmp_path: Path) -> None:
    link_target = tmp_path / "elsewhere"
    (link_target / "precious").mkdir(parents=True)
    shutil.rmtree(dataset / ".run/scratch")
    (dataset / ".run/scratch").symlink_to(link_target)
    with pytest.raises(UserError), claim(dataset, JOB):
        pass
    assert (link_target / "precious").is_dir()
