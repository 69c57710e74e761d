"""Whole pipelines: errors of known estimates, orientations of clips, ridge, the cache."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_clip import made_clip
from numpy.typing import NDArray

from evidence import cache
from evidence.end_to_end import models
from learn.data.clips import Clip
from synth.dataset import provenance

N, T = 16, 6


def clip(rng: np.random.Generator, name: int = 0) -> Clip:
    """Clip with a force across the line of sight, E times the sum of displacement, and an incomplete mask."""
    mask = np.ones((N, N), np.float32)
    mask[:3, :5] = 0
    moved = rng.standard_normal((T, 2, N, N)).astype(np.float32) * mask
    force = np.zeros((T, 3))
    force[:, :2] = 2.0 * moved.sum(axis=(2, 3))
    return made_clip(name, moved, force, mask)


def test_errors_of_known_estimates() -> None:
    force = np.tile([3.0, 0.0, 4.0], (2, 1))
    nothing = models.errors([np.zeros((2, 3))], [force])
    assert [nothing[part][0] for part in ("errors", "across", "along")] == pytest.approx([1, 0.6, 0.8])
    # Sequences have equal weights, whatever their force.
    both = models.errors([force * 0, force * 0.5], [force, 100 * force])
    assert both["errors"] == pytest.approx([1, 0.995])


def arrow(clip: Clip) -> NDArray[np.float64]:
    """Position of the only moved cell from the centre, and its displacement, (4,)."""
    moved = np.asarray(clip.displacement["recovered"][0])
    row, col = np.argwhere(np.abs(moved).sum(axis=0) > 0)[0]
    return np.array([col - (N - 1) / 2, row - (N - 1) / 2, *moved[:, row, col]])


def test_orientations_transform_places_and_vectors_alike() -> None:
    one = clip(np.random.default_rng(0))
    moved = np.zeros((T, 2, N, N), np.float32)
    moved[:, :, 2, 11] = (3.5, -5.5)  # outwards: x right, y down
    force = np.tile([3.5, -5.5, 9.0], (T, 1))
    turns = models.turned(replace(one, displacement={"recovered": moved}, force=force))
    for turn in turns:
        x, y, dx, dy = arrow(turn)
        assert (dx, dy) == (x, y)
        assert turn.force[0] == pytest.approx([x, y, 9.0])
    assert len({tuple(arrow(turn)) for turn in turns}) == 8


@pytest.mark.slow
def test_ridge_recovers_a_linear_relation_and_zero_force_without_motion() -> None:
    rng = np.random.default_rng(2)
    fit, fresh = [clip(rng, k) for k in range(12)], clip(rng, 12)
    ridge = models.build(models.RIDGE, fit)
    assert models.errors([ridge(fresh)], [fresh.force])["errors"][0] < 0.05
    still = replace(fresh, displacement={"recovered": np.zeros((T, 2, N, N), np.float32)})
    assert ridge(still) == pytest.approx(0)


def test_cached_results_depend_on_inputs_and_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    computed: list[int] = []

    def count(*parts: object) -> int:
        cache.result(tmp_path, "x", cache.key(*parts), lambda: computed.append(1) or len(computed))
        return len(computed)

    assert [count("a", ["b"]), count("a", ["b"]), count("a", ["c"]), count("a", ["b"])] == [1, 1, 2, 2]
    (home := tmp_path / "learn").mkdir()
    hashes = []
    for text in ("RATE = 1", "RATE = 2"):
        (home / "train.py").write_text(text)
        hashes.append(provenance.code("learn", home=tmp_path))
    assert hashes[0] != hashes[1]
    monkeypatch.setattr(cache, "code", lambda: hashes[1])
    assert count("a", ["b"]) == 3
