"""The engine: order, faults and interruption change no byte; status and forecasts agree with what is."""

import json
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path

import fake_work
import numpy as np
import pytest
from command import run as command
from fake_run import Silent, options, start, wait_for
from forked_workers import Forkserver

from synth.cli import app
from synth.dataset import index, provenance, size_forecast
from synth.dataset.dataset_folder import Folder, Part, claim, parse_part
from synth.engine import child, status
from synth.engine import run as engine
from synth.engine.child import Child, Setup
from synth.engine.dask import describe_risk, read_slurm
from synth.engine.journal import Journal
from synth.engine.run import Summary
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


def run(root: Path, work: str = "sequence", job: Job = JOB, **settings: object) -> Summary:
    return engine.run_job(job, root, options(work, **settings), Silent())


@pytest.fixture(scope="module")
def forkserver() -> Iterator[Forkserver]:
    with closing(Forkserver()) as server:
        yield server


@pytest.fixture
def forked_workers(forkserver: Forkserver, monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that start at once; without it, and in what `start` starts, they are as in use."""
    monkeypatch.setattr(child, "subprocess", forkserver.subprocess)


@pytest.fixture(scope="module")
def clean_hash(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the dataset of an undisturbed run."""
    return run(tmp_path_factory.mktemp("undisturbed") / "out").content_hash


@pytest.mark.slow
@pytest.mark.usefixtures("forked_workers")
def test_a_dataset_is_extended_by_any_number_of_workers(tmp_path: Path, clean_hash: str) -> None:
    root = tmp_path / "out"
    small_job = JOB.model_copy(update={"sequences": 2})
    run(root, job=small_job)
    summary = run(root, workers=3)
    assert (summary.already, summary.done, summary.failed, summary.content_hash) == (2, 4, {}, clean_hash)
    assert [row["index"] for row in index.read_index(root).to_pylist()] == list(range(6))
    assert all((root / name).is_file() for name in ("README.md", "job.yaml", "dataset.json"))
    times_ns = {path: path.stat().st_mtime_ns for path in root.rglob("*/c/*")}
    assert run(root).already == 6
    assert times_ns == {path: path.stat().st_mtime_ns for path in root.rglob("*/c/*")}
    with pytest.raises(UserError):
        run(root, job=small_job)


class InProcessSlot:
    """A slot that computes stand-ins in the engine's own process."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def run(self, index: int, report: object, stop: threading.Event) -> child.Attempt:
        fake_work.sequence(PARTED_JOB, index, self._folder, lambda *_: None)
        return child.Attempt(index, "done")

    def close(self) -> None:
        pass


PARTED_JOB = JOB.model_copy(update={"sequences": 14})


def test_a_dataset_that_another_part_begins_meanwhile_is_not_foreign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between the look for its first file and the look for others."""
    (tmp_path / "out").mkdir()
    list_folder, begun_folders = Path.iterdir, list[Path]()

    def begin_before(folder: Path) -> Iterator[Path]:
        if folder == tmp_path / "out" and not begun_folders:
            begun_folders.append(folder)
            with claim(folder, PARTED_JOB, part=Part(2, 12)):
                pass
        return list_folder(folder)

    monkeypatch.setattr(Path, "iterdir", begin_before)
    with claim(tmp_path / "out", PARTED_JOB, part=Part(1, 12)) as dataset:
        assert dataset.is_begun
    assert begun_folders
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").touch()
    with pytest.raises(UserError), claim(tmp_path / "other", PARTED_JOB):
        pass


def test_twelve_parts_give_the_dataset_of_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four at a time, in an order of their own: stores, split and index are those of a single run."""

    @contextmanager
    def slots(kind: str, setup: Setup, *_: object) -> Iterator[list[InProcessSlot]]:
        yield [InProcessSlot(setup.folder)]

    monkeypatch.setattr(engine, "_slots", slots)
    reference = run(tmp_path / "one", job=PARTED_JOB)
    order = np.random.default_rng(1).permutation(12) + 1

    def run_part(number: int) -> Summary:
        return run(tmp_path / "out", job=PARTED_JOB, part=Part(number, 12))

    with ThreadPoolExecutor(4) as pool:
        summaries = list(pool.map(run_part, order.tolist()))
    assert sum(summary.done for summary in summaries) == 14
    assert {summary.total for summary in summaries} == {1, 2}
    assert reference.content_hash in {summary.content_hash for summary in summaries}
    roots = tmp_path / "one", tmp_path / "out"
    tables = [index.read_index(root).drop_columns(["cpu_s"]) for root in roots]
    assert tables[0].equals(tables[1])
    for name in ("split.json", "dataset.json", "job.yaml"):
        assert len({(root / name).read_bytes() for root in roots}) == 1
    assert (tmp_path / "out/README.md").is_file()
    assert run(tmp_path / "out", job=PARTED_JOB).content_hash == reference.content_hash


@pytest.mark.trial
def test_a_killed_part_is_run_again_beside_another(tmp_path: Path, clean_hash: str) -> None:
    """Neither touches what the other computes; a run of the whole waits for none of them."""
    victim = start(tmp_path / "out", JOB, "stuck", "1/2")
    wait_for(lambda: len(list((tmp_path / "out").glob("*.zarr"))) >= 1)
    with pytest.raises(UserError, match="another run"):
        run(tmp_path / "out")
    other_summary = run(tmp_path / "out", part=Part(2, 2))
    assert (other_summary.total, other_summary.done, other_summary.content_hash) == (3, 3, "")
    assert status.read_status(tmp_path / "out").running
    victim.send_signal(signal.SIGKILL)
    victim.wait(timeout=60)
    wait_for(lambda: not status.read_status(tmp_path / "out").running)
    assert not (tmp_path / "out/index.parquet").exists()
    last_summary = run(tmp_path / "out", part=Part(1, 2))
    assert last_summary.content_hash == clean_hash
    assert not list((tmp_path / "out").glob("*.part"))


@pytest.mark.parametrize("text", ["0/4", "5/4", "1", "a/b", "1/0", "-1/4", "1/100000000"])
def test_a_wrong_part_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="--part"):
        parse_part(text)


@pytest.mark.usefixtures("forked_workers")
def test_another_versions_dataset_is_continued_only_on_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "out"
    run(root, job=JOB.model_copy(update={"sequences": 2}))
    newer_generator = {**provenance.generator(), "numpy": "99.0"}
    monkeypatch.setattr(provenance, "generator", lambda: newer_generator)
    with pytest.raises(UserError, match="numpy"):
        run(root, mix_versions=False)
    assert run(root).done == 4
    assert len(Folder(root).read_description()["generators"]) == 2
    monkeypatch.undo()
    with pytest.raises(UserError):
        run(root, job=JOB.model_copy(update={"sequences": 7}), mix_versions=False)


@pytest.mark.usefixtures("forked_workers")
def test_a_sequence_sealed_by_a_lost_attempt_is_not_computed_again(tmp_path: Path) -> None:
    run(tmp_path / "made", job=JOB.model_copy(update={"sequences": 1}))
    with closing(Child(Setup(JOB.model_dump(mode="json"), tmp_path / "made", "no:such"))) as process:
        assert process.run(0, lambda *_: None, threading.Event()).kind == "done"


@pytest.mark.usefixtures("forked_workers")
def test_workers_take_gpus_in_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,7")
    run(tmp_path, "record_gpus", JOB.model_copy(update={"sequences": 2}), workers=2, gpus="4,7")
    assert {path.read_text() for path in (tmp_path / ".run").glob("saw-*")} == {"4", "7"}


def test_gpus_are_those_left_visible(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    assert child.choose_gpus("auto", True) == ("0", "1")
    assert child.choose_gpus("auto", False) is None
    with pytest.raises(UserError, match="2"):
        child.choose_gpus("0,2", True)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("PATH", "")
    assert child.choose_gpus("auto", True) is None, "no driver"


@pytest.mark.usefixtures("forked_workers")
def test_a_fault_costs_only_its_own_sequence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_TRIES", 2)
    job = JOB.model_copy(update={"sequences": 9})
    watcher = Silent()
    summary = engine.run_job(
        job, tmp_path / "out", options("fail_by_index", memory_gb=0.5, workers=2), watcher
    )
    assert summary.done == 3
    reasons = summary.failed
    assert "SIGABRT" in reasons[1]
    assert "0.5 GB" in reasons[2]
    assert "force: not finite" in reasons[3]
    assert reasons[4] == "ZeroDivisionError: by nought"
    assert reasons[6] == reasons[8] == "the load is past the material's range"
    assert status.read_status(tmp_path / "out").failed[reasons[6]] == 2
    assert json.loads(command(app, "status", tmp_path / "out", "--json").stdout)["done"] == 3
    tries = {key: sum(attempt.index == key for attempt, _ in watcher.attempts) for key in range(9)}
    assert tries == {0: 1, 1: 2, 2: 2, 3: 1, 4: 2, 5: 1, 6: 1, 7: 2, 8: 1}
    rows = {row["index"]: row for row in index.read_index(tmp_path / "out").to_pylist()}
    assert rows[4]["status"] == "failed"
    assert rows[4]["reason"] == reasons[4]
    assert "by nought" in Folder(tmp_path / "out").failures()[4]["log"]
    assert not list((tmp_path / "out").glob("*.part"))
    # A failed sequence is not computed again before its failure is cleared.
    assert run(tmp_path / "out", job=job).done == 0
    assert sorted(Folder(tmp_path / "out").failures()) == [1, 2, 3, 4, 6, 8]
    Folder(tmp_path / "out").clear_failures()
    rerun = run(tmp_path / "out", job=job)
    assert (rerun.done, rerun.failed) == (6, {})


@pytest.mark.usefixtures("forked_workers")
def test_a_hanging_sequence_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "_STALL_S", 1.0)
    job = JOB.model_copy(update={"sequences": 1})
    assert "reported nothing for 1 s" in run(tmp_path / "out", "hang", job).failed[0]


@pytest.mark.usefixtures("forked_workers")
def test_a_full_disk_stops_the_run_and_sealed_sequences_stay(tmp_path: Path, clean_hash: str) -> None:
    with pytest.raises(UserError, match="No space left"):
        run(tmp_path / "out", "full")
    assert Folder(tmp_path / "out").list_sealed() == [0, 1]
    assert Folder(tmp_path / "out").failures() == {}
    assert run(tmp_path / "out").content_hash == clean_hash


@pytest.mark.usefixtures("forked_workers")
def test_another_jobs_dataset_and_other_files_are_never_touched(tmp_path: Path) -> None:
    run(tmp_path / "out")
    files = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(UserError, match="seed"):
        run(tmp_path / "out", job=JOB.model_copy(update={"seed": 8}))
    foreign_folder = tmp_path / "foreign"
    foreign_folder.mkdir()
    (foreign_folder / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match="thesis"):
        run(foreign_folder)
    with pytest.raises(UserError):
        run(foreign_folder / "thesis.txt")
    assert sorted(tmp_path.rglob("*")) == sorted([*files, foreign_folder, foreign_folder / "thesis.txt"])


@pytest.mark.trial
def test_two_runs_on_one_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("synth.system.file_lock._WAIT_S", 0.3)
    process = start(tmp_path / "out", JOB, "slow")
    try:
        wait_for(lambda: (tmp_path / "out/.run/lock").exists())
        with pytest.raises(UserError, match="another run"):
            run(tmp_path / "out")
    finally:
        process.wait(timeout=60)
    assert process.returncode == 0


@pytest.mark.trial
@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("signal_number", [signal.SIGKILL, signal.SIGINT])
def test_killed_and_resumed_equals_undisturbed(tmp_path: Path, signal_number: int, clean_hash: str) -> None:
    victim = start(tmp_path / "out", JOB, "stuck")
    wait_for(lambda: len(list((tmp_path / "out").glob("*.zarr"))) >= 1)
    victim.send_signal(signal_number)
    victim.wait(timeout=60)
    assert victim.returncode != 0
    sealed_count = len(list((tmp_path / "out").glob("*.zarr")))
    assert 1 <= sealed_count < 6
    rerun = run(tmp_path / "out")
    assert (rerun.already, rerun.done) == (sealed_count, 6 - sealed_count)
    assert rerun.content_hash == clean_hash
    assert not list((tmp_path / "out").glob("*.part"))


@pytest.mark.trial
def test_status_during_and_after_a_run(tmp_path: Path) -> None:
    root = tmp_path / "out"
    process = start(root, JOB, "slow")
    wait_for(lambda: bool(root.exists() and (root / ".run/progress.json").exists()))
    wait_for(lambda: bool(status.read_status(root).in_flight) or status.read_status(root).done == 6)
    interim_report = status.read_status(root)
    assert interim_report.total == 6
    assert interim_report.running or interim_report.done == 6
    assert process.wait(timeout=60) == 0
    report = status.read_status(root)
    assert (report.done, report.failed, report.running, report.in_flight) == (6, {}, False, {})
    assert report.ahead.sequences == 0
    assert report.stages_cpu_s["render"] > 0


def test_the_time_left_is_estimated_from_the_latest_sequences(tmp_path: Path) -> None:
    (tmp_path / ".run").mkdir()

    def estimate_left_s(workers: int, todo: int, *ends: float) -> float | None:
        journal = Journal(Folder(tmp_path), workers, Silent().account)
        journal.begin(todo, 0, 0)
        for end_s in ends:
            journal.pace(end_s)
        return journal.estimate_left_s()

    assert estimate_left_s(2, 10, 20.0, 21.0) is None, (
        "the first sequence of each worker includes compilation"
    )
    assert estimate_left_s(2, 10, 20.0, 21.0, 25.0, 26.0) == pytest.approx(10 * 2.5)
    slow_ends, fast_ends = [10.0 * k for k in range(1, 101)], [1000.0 + 2.0 * k for k in range(1, 101)]
    assert estimate_left_s(1, 50, *slow_ends, *fast_ends) == pytest.approx(100)


@pytest.mark.usefixtures("forked_workers")
def test_an_unusual_name_changes_nothing(tmp_path: Path, clean_hash: str) -> None:
    assert run(tmp_path / "größe μm 脳 'out'").content_hash == clean_hash


@pytest.mark.parametrize(
    ("keys", "measured_mb"),
    [
        (["frames=10", "anatomy.vertices=12000", "render.size=[64, 48]", "flow.backend=ideal"], 603),
        (["frames=300", "anatomy.vertices=12000", "render.size=[64, 48]", "flow.backend=ideal"], 803),
        (["frames=200", "anatomy.vertices=2500", "render.size=[320, 240]", "flow.backend=ideal"], 919),
        (["frames=100", "anatomy.vertices=2500", "render.size=[320, 240]"], 949),
    ],
)
def test_memory_is_what_was_measured(keys: list[str], measured_mb: float) -> None:
    estimate_mb = size_forecast.estimate_memory(reader.load_job("demo", keys)) / 1e6
    assert measured_mb < estimate_mb < 1.5 * measured_mb


def test_a_sequence_too_large_for_a_worker_is_refused_before_it_begins(tmp_path: Path) -> None:
    job = reader.load_job("demo", ["sequences=1", "frames=10000"])
    with pytest.raises(UserError, match=r"10000 frames needs about .* GB of memory .* --workers 1"):
        engine.run_job(job, tmp_path / "out", engine.Options(workers=2, memory_gb=4), Silent())
    assert not (tmp_path / "out").exists()


def test_a_missing_scheduler_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("synth.engine.dask._CONNECT", "1s")
    with pytest.raises(UserError, match="no Dask scheduler answers"):
        run(tmp_path / "out", engine="dask://127.0.0.1:9")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "pattern"), [("", "jobs"), ("cores: 4\nmemory: 8GB\n", "jobs"), ("jobs: [", "YAML")]
)
def test_wrong_slurm_files_are_refused(tmp_path: Path, text: str, pattern: str) -> None:
    (tmp_path / "slurm.yaml").write_text(text)
    with pytest.raises(UserError, match=pattern):
        read_slurm(tmp_path / "slurm.yaml")


@pytest.mark.parametrize(
    ("cluster", "warning"),
    [
        ("dask://localhost:8786", False),
        ("dask://node7:8786", True),
        ("tls://node7:8786", False),
        ({"cores": 1, "security": True}, True),  # the scheduler listens on every interface
        ({"interface": "ib0"}, True),
        ({"scheduler_options": {"host": "10.0.0.1"}}, True),
        ({"interface": "ib0", "security": True}, False),
    ],
)
def test_an_open_cluster_causes_a_warning(cluster: str | dict[str, object], warning: bool) -> None:
    assert bool(describe_risk(cluster)) is warning
