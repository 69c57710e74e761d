"""Which mechanics a force reader must have seen: pairs of scenes, controls, costs, the page."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from bench.output import result_page
from evidence.end_to_end import models
from evidence.mechanics import answers, costs, experiment, page
from evidence.mechanics.answers import NOTHING, UNFITTED, Reader, Trial
from evidence.mechanics.worlds import (
    FINE,
    MIXTURE,
    PLAIN,
    STEEP,
    WORLDS,
    Scenes,
    coarse,
    job,
    rendered,
    taken_off,
)
from learn.data.clips import Clip
from synth.job.schema import Fem
from synth.sequence import scenario

N, T = FINE.size, 3


def clip(name: str, rng: np.random.Generator, force: float = 1.0) -> Clip:
    """Tissue in a disc, moving at random."""
    y, x = np.mgrid[:N, :N] - (N - 1) / 2
    mask = (np.hypot(x, y) < 0.4 * N).astype(np.float32)
    moved = rng.standard_normal((T, 2, N, N)).astype(np.float32) * mask
    return Clip(
        name=name,
        content_hash=name,
        group=name,
        family="",
        gesture="pull",
        young_kpa=2.0,
        mask=mask,
        displacement={"ideal": moved, "recovered": moved + 1},
        confidence=np.ones((T, N, N), np.float32),
        density=rng.standard_normal((T, 3, N, N)).astype(np.float32),
        force=np.full((T, 3), force),
    )


@pytest.mark.slow
def test_scenes_of_all_worlds_differ_by_their_mechanics_alone() -> None:
    """What is compared has the same anatomy, contact, load, direction, look and view."""
    jobs = {name: job(name, 5, 20) for name in WORLDS}
    for index in range(5):
        drawn = {name: scenario.draw(asked, index) for name, asked in jobs.items()}
        for name, world in WORLDS.items():
            one, usual = drawn[name], drawn[world.against]
            for part in ("anatomy", "relief", "look", "view", "sway"):
                assert getattr(one, part) == getattr(usual, part), (name, part)
            assert one.gesture.force_mn == pytest.approx(usual.gesture.force_mn)
            if name != STEEP:
                assert one.gesture.direction == pytest.approx(usual.gesture.direction)
            assert replace(one.gesture, contacts=(), direction=(0, 0, 0), force_mn=0) == replace(
                usual.gesture, contacts=(), direction=(0, 0, 0), force_mn=0
            )
            assert one.tissue.young_kpa == usual.tissue.young_kpa
            if name not in (PLAIN, STEEP):
                assert (one.tissue, one.pulse, jobs[name].fem.contact) != (
                    usual.tissue, usual.pulse, "traction",
                )  # fmt: skip
    assert jobs[PLAIN].fem.chosen_law[0] == Fem().chosen_law[0]


@pytest.mark.slow
def test_no_anatomy_is_fitted_and_asked() -> None:
    seeds = [{scenario.draw(job(PLAIN, seed, 40), k).relief.seed for k in range(40)} for seed in (41, 42)]
    assert len(seeds[0] | seeds[1]) == 80


def test_what_is_taken_off_is_the_motion_without_the_tool() -> None:
    assert rendered("pulse, taken off") == ("pulse", "pulse alone")
    assert rendered("pulse") == ("pulse",)
    whole, own = job("pulse", 5, 20), job("pulse alone", 5, 20)
    assert own.fem.load[1] < 1e-5 < whole.fem.load[0]
    for index in range(6):
        assert scenario.draw(whole, index).pulse == scenario.draw(own, index).pulse
    rng = np.random.default_rng(0)
    one, beat = clip("a", rng), clip("b", rng)
    still = taken_off(one, beat)
    np.testing.assert_array_equal(
        still.displacement["recovered"], one.displacement["recovered"] - beat.displacement["ideal"]
    )


def test_four_cells_become_one_by_their_mean_over_the_tissue() -> None:
    one = clip("a", np.random.default_rng(1))
    even = replace(one, displacement={"ideal": np.full((T, 2, N, N), 3, np.float32) * one.mask})
    small = coarse(even)
    assert small.mask.shape == (N // 2, N // 2)
    np.testing.assert_allclose(
        small.displacement["ideal"], 3 * np.broadcast_to(small.mask, (T, 2, N // 2, N // 2))
    )
    np.testing.assert_allclose(
        4 * small.density.sum(axis=(2, 3)), one.density.sum(axis=(2, 3)), rtol=1e-3, atol=1e-3
    )


def test_the_mixture_holds_every_world_alike_and_labels_are_dealt_out_to_others() -> None:
    assert sorted({answers.mixed(k) for k in range(len(MIXTURE))}) == sorted(MIXTURE)
    rng = np.random.default_rng(2)
    clips = [clip(str(k), rng, force=float(k)) for k in range(7)]
    dealt = answers.dealt_out(clips, 3)
    given = [float(one.force[0, 0]) for one in dealt]
    assert sorted(given) == list(range(7))
    assert all(value != k for k, value in enumerate(given))


def test_costs_are_compared_scene_by_scene_and_refusals_are_no_cost() -> None:
    seconds: dict[str, list[float | None]] = {name: [1.0, 2.0, 4.0, None] for name in costs.worlds()}
    seconds["rigid tip"] = [3.0, 6.0, None, 1.0]
    seconds[STEEP] = [1.5, 2.0, 1.0, 1.0]
    found = costs.ratios(seconds, 0)
    assert found[PLAIN].ratio == pytest.approx(1)
    assert found["rigid tip"].scenes == 3
    assert found["rigid tip"].ratio == pytest.approx(6 ** (1 / 3))
    assert found["rigid tip"].worst == pytest.approx(3)
    assert found["rigid tip"].against == STEEP


def test_errors_of_known_answers() -> None:
    force = np.tile([3.0, 0.0, 4.0], (2, 1))
    assert answers.errors_of(0 * force, force) == pytest.approx({"whole": 1, "across": 0.6, "scaled": 0.6})
    assert answers.errors_of(force / 4, force) == pytest.approx({"whole": 0.75, "across": 0.45, "scaled": 0})
    # A factor below zero is no stiffness.
    assert answers.errors_of(-force, force)["scaled"] == pytest.approx(0.6)


def results(off: float) -> dict[str, Any]:
    """Data as the experiment gives them: every reader errs by half, in the membranes by `off` more."""
    rows = []
    for one in answers.readers():
        for name in WORLDS:
            level = 1.0 if one.model == NOTHING else 0.5
            more = off if "membrane" in name and one.fit == "plain" else 0.0
            some = 0.0 if one.model == NOTHING else 1.0
            own = list(WORLDS).index(name) % 3
            values = [
                level + some * (more * (1 + 0.1 * (k % 3 - 1)) + 0.01 * ((k + own) % 3)) for k in range(6)
            ]
            values = [round(100 * value, 1) for value in values]
            rows.append({**vars(one), "world": name} | dict.fromkeys(answers.PARTS, values))
    seconds = {name: [1.0, 1.1, 1.2] for name in costs.worlds()}
    return {"seed": 0, "rows": rows, "seconds": seconds, "refused": []}


@pytest.mark.slow
def test_the_page_says_which_worlds_hurt_and_which_the_mixture_mends() -> None:
    lines = page.verdicts(page.Found(results(0.2)))
    for line in lines[:2]:
        more, rest = line.split("not told apart")
        assert "membrane, 5 mN/mm (+20)" in more
        assert "pulse (+0)" in rest.split("The mixture")[0]
        assert "membrane, 200 mN/mm (-20)" in rest.split("The mixture")[1]
    assert "100 to 100%" in lines[2]
    files = page.drawn(results(0.2)).files()
    assert set(files) == {"README.md", "chart.svg"}
    assert "+20" in files["README.md"]


@pytest.fixture
def few_worlds() -> Iterator[None]:
    """Not by deleting them: what a patch puts back comes last, and pages follow the order."""
    few = {name: WORLDS[name] for name in (PLAIN, "pulse", "pulse, taken off", "rigid tip", STEEP)}
    with patch.dict(WORLDS, few, clear=True):
        yield


@pytest.mark.slow
@pytest.mark.usefixtures("few_worlds")
def test_a_few_small_scenes_from_job_to_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything in one process on tiny scenes; no force at all errs by all of it in every world."""
    monkeypatch.setattr("evidence.mechanics.worlds.SIZE", (64, 48))
    monkeypatch.setattr("evidence.mechanics.worlds.FRAMES", 4)
    monkeypatch.setattr("evidence.mechanics.worlds.VERTICES", 1600)
    monkeypatch.setattr(answers, "MIXTURE", [PLAIN, "pulse", "rigid tip"])
    trial = Trial(Scenes(1, 4, tmp_path), Scenes(2, 1, tmp_path), 1)
    for scenes, name, index in trial.wanted():
        assert scenes.make(name, index) == ""
    made = sorted(tmp_path.rglob("clip.json"))
    assert len(made) == len(trial.wanted()) == len(dict.fromkeys(trial.wanted()))
    found = {one: trial.errors(one) for one in answers.readers()}
    for world in WORLDS:
        assert found[Reader(NOTHING, UNFITTED, "recovered")][world]["whole"] == [100.0]
    assert all(
        np.isfinite(answers.as_array(v["whole"])).all() for one in found.values() for v in one.values()
    )
    # Kept: nothing is rendered, fitted or asked again.
    monkeypatch.setattr("synth.sequence.pipeline.render_sequence", None)
    monkeypatch.setattr(models, "build", None)
    monkeypatch.setattr(models, "train_network", None)
    assert all(scenes.make(name, index) == "" for scenes, name, index in trial.wanted())
    assert {one: trial.errors(one) for one in answers.readers()} == found
    data = {"seed": 1, "rows": experiment.rows_of(found), "refused": []}
    timed = costs.timed(0, 1, {"frames": 2, "anatomy": {"vertices": 1600}})
    assert set(timed) == set(costs.worlds())
    page_of = page.drawn(data | {"seconds": {name: [s] * 3 for name, s in timed.items()}})
    assert result_page.write(page_of, tmp_path / "out")
