"""The gap's arithmetic on errors that are known, the noise model on noise that is, and what is kept."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from evidence import kept
from evidence.gap import experiment, gap, runs
from evidence.measuring import shortened
from learn.data.clips import Clip
from learn.data.split import nested
from learn.loss import Objective
from learn.settings import preset, replace
from synth.errors import UserError

RESULTS = Path(__file__).parents[2] / "docs" / "results" / "gap"


def test_share_closed_by_hand() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.9, 1.1, 30)
    got = gap.closed(10 * base, 6 * base, 2 * base, rng)
    assert got.share == pytest.approx(4 / 8, rel=1e-9)
    assert got.interval == pytest.approx((0.5, 0.5), abs=1e-6)  # all in proportion: pairs leave no doubt
    assert got.undefined == ""


def test_no_gap_is_undefined_and_says_so() -> None:
    rng = np.random.default_rng(0)
    errors = rng.normal(5, 2, 20)
    got = gap.closed(errors, errors - 1, errors + 0.3 * rng.normal(size=20), rng)
    assert np.isnan(got.share)
    assert "touches zero" in got.undefined


def test_noise_is_fitted_and_made_alike() -> None:
    rng = np.random.default_rng(1)
    mask = np.zeros((48, 48), np.float32)
    mask[6:-6, 6:-6] = 1
    ideal = [np.cumsum(rng.normal(size=(6, 2, 1, 1)), axis=0).astype(np.float32) * mask for _ in range(8)]
    true = gap.Noise(0.9, 0.12, 2.0)
    found = gap.fit_noise(ideal, [true.add(i, mask, rng) for i in ideal], [mask] * 8)
    assert found.gain == pytest.approx(0.9, abs=0.02)
    assert found.sigma_mm == pytest.approx(0.12, rel=0.1)
    assert found.reach_cells == pytest.approx(2.0, rel=0.1)
    assert not true.add(ideal[0], mask, rng)[:, :, 0, 0].any()


def test_verdict_names_the_cheaper_way_when_it_is_as_good() -> None:
    def closing(share: float) -> gap.Gap:
        return gap.Gap(share, (share - 0.1, share + 0.1), 1.0, (0.8, 1.2), "")

    shares = {"R": closing(0.5), "N": closing(0.45)}
    assert "not needed" in gap.verdict(shares, (-0.2, -0.1))
    assert "not shown" in gap.verdict(shares, (-0.1, 0.2))
    assert "closes more than" in gap.verdict({"R": closing(0.5), "N": closing(0.2)}, (0.1, 0.2))


def test_results_are_those_of_the_runs_beside_them() -> None:
    found: dict[runs.Training, dict[str, Any]] = {}
    tree = json.loads((RESULTS / "results.json").read_text("utf-8"))
    for row in pq.read_table(RESULTS / "runs.parquet").to_pylist():
        training = runs.Training(row["kind"], row["flow"], row["seed"])
        run = found.setdefault(training, {"noise": tree["flows"][row["flow"]]["noise"], "errors": {}})
        for key in runs.KEYS:
            run["errors"].setdefault(row["test"], {}).setdefault(key, []).append(row[key])
    again = shortened(json.loads(json.dumps(experiment._plain(experiment.compared(found)))))
    assert {name: tree[name] for name in again} == again


@pytest.mark.slow
def test_a_training_is_answered_from_what_was_kept_only_if_nothing_that_made_it_changed(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = preset("tiny", size=32, epochs=1, objective=Objective(kind="mse"))
    settings = replace(settings, arch=replace(settings.arch, levels=2, width=8, output="magnitude"))
    trained: list[Path] = []
    train = runs.train
    monkeypatch.setattr(runs, "train", lambda *args: trained.append(args[3]) or train(*args))

    def ask(clips: list[Clip] = clips, settings: Any = settings, kind: str = "I", flow: str = "tvl1") -> int:
        split = nested(clips, 3, 0, 0)
        tests = {"I": ([clips[i] for i in split.test], "ideal")}
        training = runs.Training(kind, flow, 0)
        runs.carry_out(training, clips, split, settings, tests, tmp_path, lambda line: None)
        return len(trained)

    assert [ask(), ask()] == [1, 1]
    assert ask(settings=replace(settings, weight_decay=0.1)) == 2
    assert ask([dataclasses.replace(clips[0], content_hash="other"), *clips[1:]]) == 3
    assert ask(flow="dis") == 4
    assert trained[3] == trained[0]  # asked otherwise, but the same network
    monkeypatch.setattr(kept, "code", lambda module: "other")
    assert ask() == 5
    assert len(set(trained)) == 4


def test_another_dataset_is_the_unseen_world() -> None:
    def made(name: str, count: int) -> list[Any]:
        return [SimpleNamespace(group=f"{name}{k // 2}", content_hash=f"{name}{k}") for k in range(count)]

    ours, theirs = made("a", 60), made("b", 8)
    split, seen = experiment.beside(ours, theirs, preset("tiny"))
    assert split.test == tuple(range(60, 68))
    parts = [set(split.fit), set(split.select), set(seen)]
    assert set.union(*parts) == set(range(60))
    assert sum(map(len, parts)) == 60
    anatomies = [{i // 2 for i in part} for part in parts]
    assert sum(map(len, anatomies)) == len(set.union(*anatomies))
    with pytest.raises(UserError, match="shares an anatomy"):
        experiment.beside(ours, made("a", 4), preset("tiny"))
