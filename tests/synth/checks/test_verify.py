"""Verify: a good dataset passes, and each invariant has a damage that it alone must find."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import fake_work
import numpy as np
import pytest
from fake_run import in_process
from typer.testing import CliRunner

from synth.checks import verify
from synth.checks.physics import INVARIANTS
from synth.cli import app
from synth.dataset import index
from synth.errors import UserError
from synth.job.schema import Flow, Job

PAIR = {"size": (96, 72), "stereo_mm": 24.0}
JOB = Job(seed=1, sequences=2, frames=5, render=PAIR, flow={"backend": "ideal"})


@pytest.fixture(scope="module")
def pristine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pristine") / "out"
    in_process(JOB, root, fake_work.consistent)
    return root


@pytest.fixture
def dataset(pristine: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(pristine, tmp_path / "out"))


def failing(root: Path, fast: bool = False) -> set[str]:
    return {check.name for check in verify.verify_dataset(root, fast=fast).checks if not check.good}


def test_a_good_dataset_passes_and_every_invariant_was_measured(dataset: Path) -> None:
    report = verify.verify_dataset(dataset)
    assert report.good, [check.failures for check in report.checks]
    assert {check.name: check.count > 0 for check in report.checks} == {
        name: True for name in ("dataset", "splits", "readable", "checksum", "finite", "range", *INVARIANTS)
    }
    assert verify.verify_dataset(dataset, fast=True).good


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "check"),
    [
        ("force", "force"),
        ("flow", "warp"),
        ("flow", "contact"),
        ("visibility", "visibility"),
        ("rest", "rest"),
        ("load_rest", "rest"),
        ("recovered_rest", "rest"),
        ("fold", "forward_backward"),
        ("camera", "camera"),
        ("scale", "camera"),
        ("contact", "contact"),
        ("depth", "range"),
        ("compliance", "compliance"),
        ("motion", "stereo"),
        ("disparity", "stereo"),
        ("right_flow", "stereo"),
        ("right_depth", "stereo"),
    ],
)
def test_a_faulty_pipeline_is_found_by_the_check_made_for_it(tmp_path: Path, fault: str, check: str) -> None:
    job = JOB.model_copy(update={"sequences": 1, "flow": Flow(stereo="none")})
    in_process(job, tmp_path / "out", fake_work.wrong(fault))
    found = next(one for one in verify.verify_dataset(tmp_path / "out").checks if one.name == check)
    assert not found.good
    assert found.offender.startswith("000000.zarr: ")
    assert found.cpu_s > 0
    # What says only whether bytes are those that were written sees nothing here.
    assert not failing(tmp_path / "out") & {"checksum", "seal", "schema", "readable", "dataset", "finite"}


def test_a_number_that_is_none_is_found(dataset: Path) -> None:
    import zarr

    zarr.open_group(str(dataset / "000001.zarr"), mode="r+")["force"][2, 1] = np.nan
    assert {"finite", "checksum"} <= failing(dataset)
    assert "finite" in failing(dataset, fast=True)


def test_a_split_that_leaks_is_found(dataset: Path) -> None:
    rows = index.read_index(dataset).to_pylist()
    for row, side in zip(rows, ("train", "test"), strict=True):
        row.update(anatomy="mesh-1", split=side)
    index.save_rows(dataset, rows)
    leaking = next(check for check in verify.verify_dataset(dataset).checks if check.name == "splits")
    assert leaking.offender == "index.parquet: anatomy mesh-1 is in test, train"


def test_edited_axes_are_found(dataset: Path) -> None:
    path = dataset / "000000.zarr/flow/zarr.json"
    path.write_text(path.read_text().replace('"row"', '"column "'))
    assert failing(dataset) == {"schema"}


def test_a_sequence_of_an_unnamed_version_is_found(dataset: Path) -> None:
    path = dataset / "dataset.json"
    described = json.loads(path.read_text())
    described["generators"][0]["code"] = "another"
    path.write_text(json.dumps(described))
    assert failing(dataset) == {"dataset"}


def edit(store: Path, **changes: object) -> None:
    path = store / "zarr.json"
    metadata = json.loads(path.read_text())
    metadata["attributes"].update(changes)
    path.write_text(json.dumps(metadata))


def test_edited_attributes_are_found(dataset: Path) -> None:
    edit(dataset / "000000.zarr", young_kpa=2.0)
    assert failing(dataset) == {"seal", "dataset"}


def test_edited_timings_are_found(dataset: Path) -> None:
    edit(dataset / "000000.zarr", timings={"render": {"cpu_s": 0.0, "wall_s": 0.0}})
    assert failing(dataset) >= {"seal"}


def test_swapped_sequences_are_found(dataset: Path) -> None:
    (dataset / "000000.zarr").rename(dataset / "x")
    (dataset / "000001.zarr").rename(dataset / "000000.zarr")
    (dataset / "x").rename(dataset / "000001.zarr")
    assert {"seal", "dataset"} <= failing(dataset)


def test_a_value_replaced_with_its_checksums_made_good_is_found(dataset: Path) -> None:
    import zarr

    array = zarr.open_group(str(dataset / "000001.zarr"), mode="r+")["depth"]
    array[3, 5, 5] = np.float32(array[3, 5, 5]) + np.float32(1e-3)
    assert failing(dataset) == {"checksum"}


def test_missing_sequences_and_index_are_found(dataset: Path) -> None:
    shutil.rmtree(dataset / "000001.zarr")
    assert failing(dataset) == {"dataset"}
    (dataset / "index.parquet").write_bytes(b"PAR1")
    assert failing(dataset) == {"dataset"}


def test_a_broken_chunk_names_its_store(dataset: Path) -> None:
    shard = next((dataset / "000001.zarr/rgb/c").rglob("0"))
    shard = shard if shard.is_file() else next(path for path in shard.rglob("*") if path.is_file())
    shard.write_bytes(shard.read_bytes()[:-10])
    report = verify.verify_dataset(dataset)
    readable = next(check for check in report.checks if check.name == "readable")
    assert readable.bad == 1
    assert readable.offender.startswith("000001.zarr: rgb: cannot be read")


def test_command_line_prints_json_and_exits_with_1_or_2(dataset: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    good = runner.invoke(app, ["verify", str(dataset), "--json"])
    assert good.exit_code == 0
    assert json.loads(good.stdout)["good"] is True
    told = runner.invoke(app, ["verify", str(dataset)], env={"COLUMNS": "40"}).stdout.splitlines()
    wide = next(line for line in told if line.startswith("contact"))
    checks = {check["name"]: check for check in json.loads(good.stdout)["checks"]}
    after = told[told.index(wide) :]
    where = "".join(after).replace(" ", "")
    assert checks["contact"]["offender"].replace(" ", "") in where, "wrapped, and nothing is cut off"
    assert f" {checks['contact']['limit']:.3g} " in wide
    assert " mm " in wide
    edit(dataset / "000000.zarr", young_kpa=2.0)
    bad = runner.invoke(app, ["verify", str(dataset)])
    assert bad.exit_code == 1
    assert "seal: 000000.zarr: attributes were edited" in bad.stdout
    nothing = runner.invoke(app, ["verify", str(tmp_path / "nothing")])
    assert nothing.exit_code == 2
    with pytest.raises(UserError, match="holds no dataset"):
        verify.verify_dataset(tmp_path)
