"""Fitted once: the second recording asks the kept rules, which say the same; other data are fitted anew."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.methods import baselines, kept_rules
from bench.methods.baselines import Rule
from learn.data.clips import Clip
from synth.dataset import provenance
from synth.system import cache

N = baselines.GRID.size


def clip(seed: int) -> Clip:
    rng = np.random.default_rng(seed)
    moved = rng.normal(size=(4, 2, N, N)).astype(np.float32)
    return Clip(
        name=str(seed), content_hash=str(seed), group=str(seed), family="healthy", gesture="pull",
        young_kpa=1.0, mask=np.ones((N, N), np.float32), displacement={"recovered": moved},
        confidence=np.ones((4, N, N), np.float32), density=np.abs(moved[:, :1]),
        force=rng.normal(size=(4, 3)),
    )  # fmt: skip


@pytest.mark.slow
def test_rules_are_fitted_once_for_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    times: list[int] = []

    def fit() -> dict[str, Rule]:
        times.append(1)
        return baselines.fitted_rules([clip(k) for k in range(6)], "recovered")

    first = kept_rules.keep_rules(["a", "b"], "recovered", fit)
    again = kept_rules.keep_rules(["a", "b"], "recovered", fit)
    assert len(times) == 1
    asked = clip(9)
    given = asked.displacement["recovered"][1], asked.mask, asked.confidence[1]
    assert list(again) == list(first)
    for name, rule in first.items():
        np.testing.assert_array_equal(again[name](*given), rule(*given))
    kept_rules.keep_rules(["a", "c"], "recovered", fit)
    kept_rules.keep_rules(["a", "b"], "ideal", fit)
    assert len(times) == 3
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:100])  # a disk that was full
    kept_rules.keep_rules(["a", "b"], "recovered", fit)
    assert len(times) == 4
    monkeypatch.setattr(provenance, "source", lambda *asked: "other code")
    kept_rules.keep_rules(["a", "b"], "recovered", fit)
    assert len(times) == 5
