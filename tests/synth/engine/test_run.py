"""The engine: order and interruption change nothing, trouble costs the sequence that makes it."""

from __future__ import annotations

import dataclasses
import re
import signal
import threading
from pathlib import Path

import pytest
from fake_run import Silent, options, start, wait_for

from synth.dataset import index, provenance
from synth.dataset.folder import Folder
from synth.engine import run as engine
from synth.engine import slots
from synth.engine.progress import rates
from synth.engine.run import Summary
from synth.engine.worker_process import Child, Setup
from synth.errors import UserError
from synth.job.schema import Job

JOB = Job(seed=2, sequences=6, frames=3, render={"size": (32, 24)}, flow={"backend": "ideal"})


def run(root: Path, work: str = "sequence", job: Job = JOB, **more: object) -> Summary:
    return engine.run_job(job, root, options(work, **more), Silent())


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of the dataset that a run left in peace makes."""
    return run(tmp_path_factory.mktemp("undisturbed") / "out").content_hash


@pytest.mark.slow
def test_number_of_workers_and_order_do_not_matter(tmp_path: Path, undisturbed: str) -> None:
    many = run(tmp_path / "many", workers=3)
    assert (many.content_hash, many.done, many.failed) == (undisturbed, 6, {})
    other = JOB.model_copy(update={"seed": 3, "sequences": 1})
    assert run(tmp_path / "other", job=other).content_hash != undisturbed


@pytest.mark.slow
def test_a_finished_dataset_has_its_index_film_and_job_and_is_left_alone(tmp_path: Path) -> None:
    first = run(tmp_path / "out")
    for name in ("index.parquet", "preview.mp4", "job.yaml", "dataset.json"):
        assert (tmp_path / "out" / name).is_file()
    rows = index.read_index(tmp_path / "out").to_pylist()
    assert [row["index"] for row in rows] == list(range(6))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*/c/*")}
    again = run(tmp_path / "out")
    assert (again.already, again.done, again.content_hash) == (6, 0, first.content_hash)
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "out").rglob("*/c/*")}


@pytest.mark.slow
def test_more_sequences_extend_and_fewer_are_refused(tmp_path: Path, undisturbed: str) -> None:
    run(tmp_path / "out", job=JOB.model_copy(update={"sequences": 3}))
    whole = run(tmp_path / "out")
    assert (whole.already, whole.done) == (3, 3)
    assert whole.content_hash == undisturbed
    with pytest.raises(UserError, match="holds 6 sequences"):
        run(tmp_path / "out", job=JOB.model_copy(update={"sequences": 3}))


@pytest.mark.slow
def test_another_versions_dataset_is_continued_only_when_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "out"
    run(root, job=JOB.model_copy(update={"sequences": 2}))
    newer = {**provenance.generator(), "numpy": "99.0"}
    monkeypatch.setattr(provenance, "generator", lambda: newer)
    with pytest.raises(UserError, match=r"2 sequences were made by another version .*numpy .*, now 99\.0"):
        run(root, mix_versions=False)
    assert run(root).done == 4
    assert len(Folder(root).described()["generators"]) == 2
    assert "Several versions" in (root / "README.md").read_text("utf-8")
    monkeypatch.undo()
    with pytest.raises(UserError, match="made by another version"):
        run(root, job=JOB.model_copy(update={"sequences": 7}), mix_versions=False)


def _counted_files(home: Path) -> set[Path]:
    return provenance._imports(home, provenance._makers(home), {"synth"})


def test_what_makes_a_sequence_counts_and_what_keeps_it_does_not() -> None:
    home = Path(provenance.__file__).parents[2]
    counted = {str(path.relative_to(home)) for path in _counted_files(home)}
    assert {
        "synth/sequence/scenario.py",
        "synth/job/schema.py",
        "synth/job/__init__.py",
        "synth/fem/solver.py",
        "synth/render/truth.py",
        "synth/flow/tvl1.py",
    } <= counted
    rest = {"synth/cli.py"} | {f"synth/dataset/{name}.py" for name in ("store", "index")}
    rest |= {"synth/engine/run.py", "synth/engine/worker_process.py", "synth/checks/verify.py"}
    assert all((home / name).is_file() for name in rest), "a name that is no file guards nothing"
    assert not counted & rest


def _tree(home: Path, **files: str) -> Path:
    """A program whose maker imports the job's schema, with further files (`a__b` is a/b.py)."""
    outside = {name.replace(".", "/"): "" for name in provenance._NO_PART}
    outside |= {f"synth/{room}init": "" for room in ("", "flow/", "sequence/")}
    inside = {"synth/sequence/pipeline": "from synth.job import Job\n", "synth/flow/own": ""}
    given = {name.replace("__", "/"): text for name, text in files.items()}
    for name, text in {**outside, **inside, **given}.items():
        path = home / re.sub("init$", "__init__", name)
        path = path.with_name(f"{path.name}.py")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return home


def test_what_moves_into_a_package_still_counts(tmp_path: Path) -> None:
    home = _tree(
        tmp_path,
        synth__job__init="from synth.job.schema import Job\n",
        synth__job__schema="class Job:\n    spp = 4\n",
    )
    counted = {str(path.relative_to(home)) for path in _counted_files(home)}
    assert {"synth/__init__.py", "synth/job/__init__.py", "synth/job/schema.py"} <= counted


def test_the_kept_hash_is_that_of_the_files_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(provenance, "folder", lambda name: tmp_path)
    job = "synth/job.py"
    found = []
    for text in ("class Job:\n    spp = 4\n", "class Job:\n    spp = 8\n", "class Job:\n    spp = 4\n"):
        home = _tree(tmp_path / "home", synth__job=text)
        assert (home / job).read_text() == text
        asked = home, provenance._makers(home), {"synth"}
        found.append(provenance._kept(*asked))
        assert found[-1] == provenance._kept(*asked)
        assert found[-1] == provenance._code(home, _counted_files(home))
    assert found[0] != found[1]
    assert found[0] == found[2]
    assert len([file for file in tmp_path.iterdir() if file.is_file()]) == 2


def test_an_import_that_leads_nowhere_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LookupError, match=r"synth\.job: there is no such module"):
        _counted_files(_tree(tmp_path / "a"))
    with pytest.raises(LookupError, match="doesn't say what 'Job' is"):
        _counted_files(_tree(tmp_path / "b", synth__job__init="def __getattr__(name): ...\n"))
    home = _tree(tmp_path / "c", synth__job="class Job: ...\n")
    (home / "synth/dataset/store.py").unlink()
    with pytest.raises(LookupError, match=r"synth\.dataset\.store: there is no such module"):
        _counted_files(home)


@pytest.mark.slow
def test_a_sequence_sealed_by_an_attempt_that_was_lost_is_not_made_again(tmp_path: Path) -> None:
    run(tmp_path / "made", job=JOB.model_copy(update={"sequences": 1}))
    setup = Setup(
        job=JOB.model_dump(mode="json"),
        folder=tmp_path / "made",
        logs=tmp_path,
        scratch=tmp_path,
        work="no:such",
    )
    child = Child(setup)
    try:
        assert child.run(0, lambda *_: None, threading.Event()).kind == "done"
    finally:
        child.close()


def test_comments_are_no_other_version_and_statements_are(tmp_path: Path) -> None:
    file = tmp_path / "a.py"
    texts = ['"""One."""\nx = 1\n', '"""Two."""\n\n# said\nx = 1\n"""Of x."""\n', '"""One."""\nx = 2\n']
    first, remarked, changed = (provenance._statements(file) for text in texts if file.write_text(text))
    assert first == remarked != changed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("visible", "asked", "seen"),
    [("0,1", "0,1", {"0", "1"}), ("4,7", "7", {"7"}), ("0", "none", {""}), ("5", "auto", {"5"})],
)
def test_workers_take_gpus_in_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, visible: str, asked: str, seen: set[str]
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    job = JOB.model_copy(update={"sequences": 2})
    run(tmp_path, "seeing", job, workers=2, gpus=asked)
    assert {path.read_text() for path in (tmp_path / ".run").glob("saw-*")} == seen


def test_which_gpus_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    assert slots.gpus("auto", True) == ("0", "1")
    assert slots.gpus("auto", False) is None
    with pytest.raises(UserError, match="--gpus 2: this machine has 0, 1"):
        slots.gpus("0,2", True)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    monkeypatch.setenv("PATH", "")
    assert slots.gpus("auto", True) is None, "no driver"


@pytest.mark.slow
def test_an_account_says_rates_time_and_disk(tmp_path: Path) -> None:
    watcher = Silent()
    engine.run_job(JOB, tmp_path, options("slow"), watcher)
    last = watcher.last
    assert (last.finished, last.left_s, last.in_flight) == (6, 0.0, {})
    assert last.step_s["fem"] >= 0.05
    assert last.frames_per_s is not None
    assert last.frames_per_s < JOB.frames / 0.25, "the stand-in sleeps a quarter of a second a sequence"
    assert last.disk_left == 0
    said = rates(dataclasses.replace(last, disk_left=2.5e9, disk_free=int(1e12)))
    assert f"fem {last.step_s['fem']:.2g} s" in said
    assert said.endswith("frames/s in all; 2.5 GB to come, 1 TB free")


@pytest.mark.slow
def test_trouble_costs_the_sequence_that_makes_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert engine._TRIES == 3
    monkeypatch.setattr(engine, "_TRIES", 2)
    job = JOB.model_copy(update={"sequences": 9})
    watcher = Silent()
    summary = engine.run_job(job, tmp_path / "out", options("troubled", memory_gb=0.5, workers=2), watcher)
    assert summary.done == 4
    reasons = summary.failed
    assert "SIGABRT" in reasons[1]
    assert "0.5 GB" in reasons[2]
    assert "force: not finite" in reasons[3]
    assert reasons[4] == "ZeroDivisionError: by nought"
    assert reasons[6] == "the load is past the material's range"
    tries = {key: sum(attempt.index == key for attempt, _ in watcher.attempts) for key in range(9)}
    assert tries == {0: 1, 1: 2, 2: 2, 3: 1, 4: 2, 5: 1, 6: 1, 7: 2, 8: 1}
    rows = {row["index"]: row for row in index.read_index(tmp_path / "out").to_pylist()}
    assert rows[4]["status"] == "failed"
    assert rows[4]["reason"] == reasons[4]
    assert "by nought" in Folder(tmp_path / "out").failures()[4]["log"]
    assert not list((tmp_path / "out").glob("*.part"))
    # Given up is given up until it is asked for; then it is done, and nothing tells it from the others.
    assert run(tmp_path / "out", job=job).done == 0
    assert Folder(tmp_path / "out").forgive() == [1, 2, 3, 4, 6]
    healed = run(tmp_path / "out", job=job)
    assert (healed.done, healed.failed) == (5, {})


@pytest.mark.slow
def test_a_sequence_that_hangs_is_ended(tmp_path: Path) -> None:
    job = JOB.model_copy(update={"sequences": 1})
    assert "reported nothing for 1 s" in run(tmp_path / "out", "hanging", job, stall_s=1.0).failed[0]


@pytest.mark.slow
def test_a_job_that_cannot_be_carried_out_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"^no surface at the craniotomy$"):
        run(tmp_path / "out", "refused")
    assert not (tmp_path / "out").exists()
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match="no surface"):
        run(tmp_path / "empty", "refused")
    assert list((tmp_path / "empty").iterdir()) == []


@pytest.mark.slow
def test_a_full_disk_stops_the_run_and_keeps_what_is_sealed(tmp_path: Path, undisturbed: str) -> None:
    with pytest.raises(UserError, match="No space left"):
        run(tmp_path / "out", "full")
    assert Folder(tmp_path / "out").sealed() == [0, 1]
    assert Folder(tmp_path / "out").failures() == {}
    assert run(tmp_path / "out").content_hash == undisturbed


@pytest.mark.slow
def test_another_jobs_dataset_and_other_files_are_never_touched(tmp_path: Path) -> None:
    run(tmp_path / "out")
    before = sorted(path for path in tmp_path.rglob("*"))
    with pytest.raises(UserError, match="seed is 2 there and 8 here"):
        run(tmp_path / "out", job=JOB.model_copy(update={"seed": 8}))
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match="holds other files"):
        run(foreign)
    with pytest.raises(UserError, match="is a file"):
        run(foreign / "thesis.txt")
    assert sorted(tmp_path.rglob("*")) == sorted([*before, foreign, foreign / "thesis.txt"])


@pytest.mark.slow
def test_two_runs_on_one_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("synth.dataset.folder._LOCK_WAIT_S", 0.3)
    first = start(tmp_path / "out", JOB, "slow")
    try:
        wait_for(lambda: (tmp_path / "out/.run/lock").exists())
        with pytest.raises(UserError, match="another run is writing"):
            run(tmp_path / "out")
    finally:
        first.wait(timeout=60)
    assert first.returncode == 0


@pytest.mark.slow
@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGINT])
def test_killed_and_resumed_equals_undisturbed(
    tmp_path: Path, kill: signal.Signals, undisturbed: str
) -> None:
    victim = start(tmp_path / "out", JOB, "stuck")
    wait_for(lambda: len(list((tmp_path / "out").glob("*.zarr"))) >= 1)
    victim.send_signal(kill)
    victim.wait(timeout=60)
    assert victim.returncode != 0
    left = len(list((tmp_path / "out").glob("*.zarr")))
    assert 1 <= left < 6
    resumed = run(tmp_path / "out")
    assert (resumed.already, resumed.done) == (left, 6 - left)
    assert resumed.content_hash == undisturbed
    assert not list((tmp_path / "out").glob("*.part"))
