"""The engine's trials at a small size: kills, a lost Dask worker, bad scenes, odd surroundings, damage."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_run import in_process

from evidence.engine import damage, dask, faults, kills, large_index, speed, trouble, work
from synth.job.schema import Job


def test_a_run_that_is_killed_again_and_again_makes_the_same_dataset() -> None:
    found = kills.kills(count=6, sequences=6, frame_s=0.1, pause_s=0.6, seed=1)
    assert sum(found["sigkills"].values()) == 6
    assert found["starts"] > 1, "no engine was killed"
    assert found["equal"]
    assert found["hash_undisturbed"]
    assert found["checksums_good"]
    assert found["leftovers"] == []


def test_a_lost_dask_worker_costs_nothing_but_time() -> None:
    pytest.importorskip("distributed", reason="the extra `cluster` is not installed")
    found = dask.dask(sequences=6, workers=2, frame_s=0.1)
    assert found["one_killed"]
    assert (found["done"], found["failed"]) == (6, {})
    assert found["hash_on_cluster"] == found["hash_on_one_machine"]
    assert found["leftovers"] == []


def test_two_bad_scenes_cost_two_scenes() -> None:
    found = trouble.trouble(sequences=11, memory_gb=0.5, cpu_s=0.2)
    assert (found["done_without_trouble"], found["done"]) == (11, 9)
    assert set(found["failed"]) == {4, 9}
    assert "SIGABRT" in found["failed"][4]
    assert "0.5 GB" in found["failed"][9]


def test_an_odd_name_a_jumping_clock_and_a_second_run_change_nothing() -> None:
    found = faults.meet_oddities()
    assert found["odd name"]["equal"]
    assert found["clock change"]["equal"]
    two = found["two runs"]
    assert two["codes"] == [0, 1] or two["codes"] == [0, 2]
    assert "another run" in two["says"]
    assert two["equal"]
    assert (two["left"], two["corrupt"]) == (12, 0)


def test_damage_of_every_kind_that_changes_a_value_is_found(tmp_path: Path) -> None:
    job = Job(seed=1, sequences=2, frames=5, render={"size": (64, 48)}, flow={"backend": "ideal"})
    in_process(job, tmp_path / "out", work.sequence)
    found = damage.damage(tmp_path / "out", count=5 * len(damage.KINDS))
    assert found["missed"] == []
    assert found["changed"] > found["stores"] / 2
    assert all(row["changed"] == row["found"] for row in found["kinds"].values())
    assert all(row["changed"] for row in found["kinds"].values()), "a kind that never changes a value"


def test_what_measures_the_engine_in_processes_of_its_own_still_finds_it() -> None:
    found = large_index.scale(sequences=200)
    assert min(found[name]["cpu_s"] for name in ("status", "report")) > 0
    cost = speed.overhead("tiny", 1)
    # How they compare is a benchmark's to say: on a busy machine one sequence's processor time says little.
    assert min(cost[name] for name in ("whole_cpu_s", "stages_alone_cpu_s", "store_cpu_s")) > 0
