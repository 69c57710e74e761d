"""Baselines are fitted once and cached; other data or code are fitted again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_clip import made_clip

from bench.methods import baseline_cache, baselines
from bench.methods.baselines import Rule
from synth.dataset import provenance
from synth.system import cache

N = baselines.GRID.size


def test_rules_are_fitted_once_for_a_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "folder", lambda name: tmp_path)
    rng = np.random.default_rng(0)
    clips = [made_clip(k, rng.normal(size=(4, 2, N, N)), rng.normal(size=(4, 3))) for k in range(6)]
    times: list[int] = []

    def cached(hashes: str, source: str = "recovered") -> dict[str, Rule]:
        def fit() -> dict[str, Rule]:
            times.append(1)
            return baselines.fitted_rules(clips, "recovered")

        return baseline_cache.cached_rules(list(hashes), source, fit)

    first, again = cached("ab"), cached("ab")
    assert len(times) == 1
    given = clips[0].displacement["recovered"][1], clips[0].mask, clips[0].confidence[1]
    assert list(again) == list(first)
    for name, rule in first.items():
        np.testing.assert_array_equal(again[name](*given), rule(*given))
    cached("ac")
    cached("ab", "ideal")
    assert len(times) == 3
    for file in tmp_path.iterdir():
        file.write_bytes(file.read_bytes()[:100])  # as on a full disk
    cached("ab")
    assert len(times) == 4
    monkeypatch.setattr(provenance, "source", lambda *paths: "other code")
    cached("ab")
    assert len(times) == 5
