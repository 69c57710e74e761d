"""The gap on known errors, the noise model on known noise, and the split."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_clip import made_clip

from evidence import gap
from synth.errors import UserError


def test_share_closed_of_known_errors() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.9, 1.1, 30)
    got = gap.closed(8 * base, 4 * base)
    assert got["share"] == pytest.approx(4 / 8, rel=1e-9)
    assert got["interval"] == pytest.approx([0.5, 0.5], abs=1e-6)  # proportional pairs: no uncertainty
    none = gap.closed(-0.3 * rng.normal(size=20), np.ones(20))
    assert none["share"] is None
    assert none["undefined"]


def test_fitted_noise_is_that_added() -> None:
    rng = np.random.default_rng(1)
    mask = np.zeros((48, 48), np.float32)
    mask[6:-6, 6:-6] = 1
    ideal = [np.cumsum(rng.normal(size=(6, 2, 1, 1)), axis=0).astype(np.float32) * mask for _ in range(8)]
    true = gap.Noise(0.9, 0.12, 2.0)
    both = [{"ideal": i, "recovered": true.add(i, mask, rng)} for i in ideal]
    clips = [
        replace(made_clip(k, one["ideal"], np.zeros((6, 3)), mask), displacement=one)
        for k, one in enumerate(both)
    ]
    found = gap.fit_noise(clips)
    assert found.gain == pytest.approx(0.9, abs=0.02)
    assert found.sigma_mm == pytest.approx(0.12, rel=0.1)
    assert found.reach_cells == pytest.approx(2.0, rel=0.1)
    assert not true.add(ideal[0], mask, rng)[:, :, 0, 0].any()


def test_the_parts_share_no_anatomy() -> None:
    def made(name: str, count: int) -> list[Any]:
        return [SimpleNamespace(group=f"{name}{k // 2}", content_hash=f"{name}{k}") for k in range(count)]

    ours, theirs = made("a", 60), made("b", 8)
    split, tested = gap.parts(ours, theirs)
    assert split.test == tuple(range(60, 68))
    parts = [set(split.fit), set(split.select), set(tested)]
    assert set.union(*parts) == set(range(60))
    anatomies = [{i // 2 for i in part} for part in parts]
    assert sum(map(len, anatomies)) == len(set.union(*anatomies))
    with pytest.raises(UserError):
        gap.parts(ours, made("a", 4))
