"""Learning curves: estimators find a force that is put in and ask what is held out."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_clip import made_clip

from evidence.curves import estimators
from evidence.curves.estimators import GRID, Reader, World
from learn.data.clips import Clip


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    """Displacement is the force itself, spread over the grid; what is recovered is half of it."""
    rng, made = np.random.default_rng(1), []
    for k in range(12):
        force = rng.normal(size=(6, 3))
        moved = np.broadcast_to(force[:, :, None, None], (6, 3, GRID.size, GRID.size)).astype(np.float32)
        one = made_clip(k, moved[:, :2], 2.0 * force)
        given = {
            "ideal": 2 * moved[:, :2],
            "recovered": moved[:, :2],
            "motion-ideal": 2 * moved,
            "motion": moved,
        }
        sure = np.ones((6, 2, GRID.size, GRID.size), np.float32)
        made.append(
            replace(one, displacement=given, motion_confidence=sure, density=moved / GRID.extent_mm**2)
        )
    return made


@pytest.fixture
def world(clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    monkeypatch.setattr(estimators, "_load", lambda root, work: clips)
    monkeypatch.setattr(estimators, "_bare", lambda root: [k % 2 == 0 for k in range(12)])
    monkeypatch.setattr(World, "generation_cpu_s", lambda self: 3600.0)
    return World(tmp_path / "data", (), 4, 2, 10, tmp_path / "work")


def test_ridge_of_two_eyes_finds_the_force_and_of_one_its_part(world: World) -> None:
    two = world.rows(Reader("ridge", "recovered", 2, 6))[0]
    one = world.rows(Reader("ridge", "recovered", 1, 6))[0]
    assert two["whole"][0] < 0.02
    assert two["gain"] == pytest.approx(1, abs=0.02)
    assert one["across"][0] < 0.02
    assert one["along"][0] > 0.3
    assert two["cpu_h"] == pytest.approx(6, abs=0.1)


def test_exact_is_fitted_on_true_motion_and_asked_with_it(world: World) -> None:
    assert world.rows(Reader("ridge", "exact", 2, 6))[0]["whole"][0] < 0.02


def test_no_sequence_that_is_asked_was_fitted(
    world: World, clips: list[Clip], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, list[str]] = {}

    def fitted(self: World, one: Reader, fit: list[Clip], choose: list[Clip], key: str) -> object:
        seen.update(fit=[c.content_hash for c in fit], choose=[c.content_hash for c in choose])
        return lambda clip: seen.setdefault("asked", []).append(clip.content_hash) or clip.force

    monkeypatch.setattr(World, "_fitted", fitted)
    row = world.rows(Reader("ridge", "recovered", 2, 6))[0]
    assert row["whole"][0] == 0
    assert seen == {
        "fit": ["6", "7", "8", "9", "10", "11"],
        "choose": ["4", "5"],
        "asked": ["0", "1", "2", "3"],
    }
