"""Whole pipelines: errors of known answers, turns that keep the physics, rules that find what is linear."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from evidence import defaults_on_front, kept
from evidence.end_to_end import costs, models, pareto, pipelines
from evidence.end_to_end.pipelines import Sequences
from learn.data.clips import Clip

N, T = 16, 6
RESULTS = Path(__file__).parents[2] / "docs" / "results"


def clip(rng: np.random.Generator, name: int = 0) -> Clip:
    """A force across the line of sight that is E times the sum of displacement over the left half; a mask
    with a corner missing."""
    moved = rng.standard_normal((T, 2, N, N)).astype(np.float32)
    mask = np.ones((N, N), np.float32)
    mask[:3, :5] = 0
    moved *= mask
    force = np.zeros((T, 3))
    force[:, :2] = 2.0 * moved.sum(axis=(2, 3))
    return Clip(
        name=str(name),
        content_hash=str(name),
        group=str(name),
        family="",
        gesture="pull",
        young_kpa=2.0,
        mask=mask,
        displacement={"recovered": moved},
        confidence=np.ones((T, N, N), np.float32),
        density=np.zeros((T, 3, N, N), np.float32),
        force=force,
    )


def test_errors_of_known_answers() -> None:
    force = np.tile([3.0, 0.0, 4.0], (2, 1))
    zero = pipelines.errors([np.zeros((2, 3))], [force])
    assert zero == {
        "errors": [pytest.approx(1)],
        "across": [pytest.approx(0.6)],
        "along": [pytest.approx(0.8)],
    }
    half = pipelines.errors([force / 2, force], [force, force])
    assert half["errors"] == [pytest.approx(0.5), 0]


def test_a_small_press_weighs_as_much_as_a_large_one() -> None:
    force = np.tile([3.0, 0.0, 4.0], (2, 1))
    found = pipelines.errors([force * 0, force * 0.5], [force, 100 * force])
    assert found["errors"] == [pytest.approx(1), pytest.approx(0.995)]


def arrow(clip: Clip) -> NDArray[np.float64]:
    """Where the one moved cell is from the middle, and how it moves, (4,)."""
    moved = np.asarray(clip.displacement["recovered"][0])
    row, col = np.argwhere(np.abs(moved).sum(axis=0) > 0)[0]
    return np.array([col - (N - 1) / 2, row - (N - 1) / 2, *moved[:, row, col]])


def test_turns_turn_places_and_vectors_alike() -> None:
    """Displacement that points away from the middle does so in every turn; and so does the force."""
    one = clip(np.random.default_rng(0))
    moved = np.zeros((T, 2, N, N), np.float32)
    moved[:, :, 2, 11] = (11 - 7.5, 2 - 7.5)  # outwards: x right, y down
    force = np.tile([3.5, -5.5, 9.0], (T, 1))
    turns = models.turned(replace(one, displacement={"recovered": moved}, force=force))
    for turn in turns:
        x, y, dx, dy = arrow(turn)
        assert (dx, dy) == (x, y)
        assert turn.force[0] == pytest.approx([x, y, 9.0])
    assert len({tuple(arrow(turn)) for turn in turns}) == 8
    mask = turns[1].mask
    assert all(turn.mask.sum() == mask.sum() for turn in turns)


def test_turns_keep_the_sense_of_rotation_unless_mirrored() -> None:
    one = clip(np.random.default_rng(0))
    moved = np.zeros((T, 2, N, N), np.float32)
    moved[:, :, 2, 11] = (5.5, 3.5)  # a quarter turn from outwards
    senses = [
        x * dy - y * dx > 0
        for x, y, dx, dy in map(arrow, models.turned(replace(one, displacement={"recovered": moved})))
    ]
    assert senses == [senses[0]] * 4 + [not senses[0]] * 4


@pytest.mark.slow
def test_ridge_says_nothing_of_no_motion(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    fit = [clip(rng, k) for k in range(4)]
    still = replace(fit[0], displacement={"recovered": np.zeros((T, 2, N, N), np.float32)})
    said = models.build(models.RIDGE, fit, tmp_path, 1, 0)(still)
    assert said.shape == (T, 3)
    assert said == pytest.approx(0)


@pytest.mark.slow
def test_ridge_finds_what_is_linear_and_nearest_finds_what_it_knows(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    fit, fresh = [clip(rng, k) for k in range(12)], clip(rng, 12)
    ridge = models.build(models.RIDGE, fit, tmp_path, 1, 0)
    found = pipelines.errors([ridge(fresh)], [fresh.force])
    assert found["errors"][0] < 0.05
    twice = [replace(one, force=one.force * 0 + [0, 0, 4.0]) for one in fit]
    near = models.build(models.NEAREST, twice, tmp_path, 1, 0)
    assert near(fresh) == pytest.approx(np.tile([0, 0, 4.0], (T, 1)))


def test_the_least_of_the_rounds_counts() -> None:
    found = costs.least({"data stable-4": [3.0, 1.0], "flow tvl1": [0.2, 0.3], "answer a b": [1.0]})
    assert found.data == {"stable-4": 1.0}
    assert found.flow == {"ideal": 0.0, "tvl1": 0.2}
    assert found.answer == {"a b": 1.0}


def row(cpu_s: float, errors: list[float], *, default: bool = False, tets: int = 1600) -> dict[str, object]:
    world = pipelines.default_world()
    return {
        "law": world.law, "tets": tets, "spp": world.spp, "flow": "tvl1", "model": "m", "default": default,
        "cpu_s": cpu_s, "errors": errors, "across": errors, "along": errors,
    }  # fmt: skip


@pytest.mark.slow
def test_kept_sequences_are_found_only_by_what_made_them(monkeypatch: pytest.MonkeyPatch) -> None:
    world = pipelines.FINE
    job = world.job(1, 4)
    here = pipelines.folder_name(world, job)
    assert pipelines.folder_name(world, world.job(1, 9)) == here  # more of the same
    longer = pipelines.folder_name(world, job.model_copy(update={"frames": job.frames + 1}))
    monkeypatch.setattr("synth.dataset.provenance.fingerprint", lambda: "another")
    assert len({here, longer, pipelines.folder_name(world, job)}) == 3


class Given:
    """Stands for sequences of a world: clips that are there."""

    def __init__(self, clips: list[Clip]) -> None:
        self._clips = clips

    def clips(self, flow: str) -> list[Clip]:
        return self._clips


@pytest.mark.slow
def test_kept_errors_are_found_only_by_all_that_made_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(3)
    fit, fresh = [clip(rng, k) for k in range(3)], [clip(rng, 9)]
    built: list[Path] = []

    def build(model: str, fit: list[Clip], folder: Path, epochs: int, seed: int) -> models.Answer:
        built.append(folder)
        return lambda clip: 0 * clip.force

    monkeypatch.setattr(models, "build", build)
    one = pipelines.Pipeline(pipelines.default_world(), "tvl1", models.NETWORK)

    def ask(epochs: int = 2, fit: list[Clip] = fit, asked: list[Clip] = fresh) -> int:
        trial = pipelines.Trial(epochs, 0, tmp_path)
        found = trial.errors(one, cast(Sequences, Given(fit)), cast(Sequences, Given(asked)))
        assert found["errors"] == [pytest.approx(1)] * len(asked)
        return len(built)

    assert [ask(), ask()] == [1, 1]
    assert ask(epochs=3) == 2  # another setting of the training
    assert ask(fit=[replace(fit[0], content_hash="other"), *fit[1:]]) == 3
    assert ask(asked=[*fresh, fit[0]]) == 4
    monkeypatch.setattr(kept, "code", lambda module: "other")
    assert ask() == 5
    assert len(set(built)) == 4  # what is asked changes nothing of the model


def test_differences_are_paired() -> None:
    """Sequences that differ widely among themselves, and all by a tenth from one pipeline to the other."""
    usual = list(np.linspace(0.2, 1.2, 12))
    better = [e - 0.1 - 0.01 * (k % 2) for k, e in enumerate(usual)]
    rows = pareto.summarised([row(1.0, usual, default=True), row(0.9, better, tets=400)], 0)
    assert rows[0]["difference"] is None
    mean, low, high = rows[1]["difference"]
    assert mean == pytest.approx(-0.105)
    assert -0.11 <= low < mean < high <= -0.1
    assert rows[1]["high"] > rows[0]["low"]  # intervals apart would not tell


@pytest.mark.parametrize(
    ("cost", "off", "holds"),
    [
        (0.9, -0.10, False),
        (1.1, -0.10, True),  # dearer
        (0.9, -0.02, True),  # beyond doubt, but within what is allowed
        (0.9, +0.10, True),
    ],
)
def test_a_front_is_left_beyond_the_paired_interval(cost: float, off: float, holds: bool) -> None:
    usual = list(np.linspace(0.2, 1.2, 12))
    other = [e + off * (1 + 0.1 * (k % 2)) for k, e in enumerate(usual)]
    rows = pareto.summarised([row(1.0, usual, default=True), row(cost, other, tets=400)], 0)
    found = defaults_on_front._end_to_end({"rows": rows})
    assert [front.holds() for front in found] == [holds] * len(found)
