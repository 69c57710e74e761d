"""What `bench ... learn` is made of: disturbances that do what they say, controls, tables, bad input."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from bench.output.result_page import markdown
from evidence import kept
from evidence.learn import corruptions as disturb
from evidence.learn import run_table, runs
from evidence.learn.bad_input import bad_inputs
from evidence.learn.coarse_rmse import wide_rmse
from evidence.learn.controls import beyond_mean_map, controls, mean_map
from evidence.learn.experiment import experiment, pictured, preset_runs
from evidence.learn.labels import coarser
from evidence.learn.pareto import pareto
from evidence.learn.preset_errors import errors, shape
from evidence.learn.runs import Run
from learn.data.clips import Clip
from learn.data.grid import Grid
from learn.data.split import nested
from learn.inference.predict import Predictor, load_predictor
from learn.loss import Objective
from learn.settings import PRESETS, preset, replace
from learn.training.train import train
from synth.errors import UserError
from synth.job import reader
from synth.job.schema import Render

GRID = Grid(32)


@pytest.fixture(scope="module")
def model(clips: list[Clip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("bench") / "model"
    settings = preset("tiny", size=32, epochs=1, objective=Objective(kind="mse"))
    arch = replace(settings.arch, levels=2, width=8, output="magnitude")
    train(clips, nested(clips, 3, 0, 0), replace(settings, arch=arch), out)
    return out


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.slow
@pytest.mark.parametrize("patch", [0.0, 3.0])
def test_noise_has_its_size_and_leaves_the_rest_frame(clips: list[Clip], patch: float) -> None:
    added = disturb.noisy(clips[0], 0.02, patch, GRID, rng()).displacement["ideal"]
    added = added - clips[0].displacement["ideal"]
    assert not added[0].any()
    inside = added[1:, :, clips[0].mask > 0]
    assert inside.std() == pytest.approx(0.02, rel=0.1 if patch == 0 else 0.4)


def test_a_wrong_scale_makes_lengths_longer_and_keeps_the_centre(clips: list[Clip]) -> None:
    seen = disturb.scaled(clips[2], 1.25)
    assert seen.mask.sum() == pytest.approx(clips[2].mask.sum() * 1.25**2, rel=0.1)
    largest = [np.abs(c.displacement["ideal"]).max() for c in (clips[2], seen)]
    assert largest[1] == pytest.approx(1.25 * largest[0], rel=0.1)
    same = disturb.scaled(clips[2], 1.0)
    np.testing.assert_allclose(same.displacement["ideal"], clips[2].displacement["ideal"], atol=1e-6)


def test_two_sequences_at_once_add_up(clips: list[Clip]) -> None:
    pair = disturb.both(clips[0], clips[2])
    total = pair.density.sum((2, 3)) * GRID.pitch_mm**2 * pair.young_kpa
    np.testing.assert_allclose(total, pair.force, atol=0.02 * np.abs(pair.force).max())


def test_stillness_and_mislabelling(clips: list[Clip]) -> None:
    still = disturb.still(clips[0])
    assert not still.displacement["ideal"].any()
    assert not still.force.any()
    off = disturb.mislabelled(clips[0], 0.3, rng())
    gain = off.force[3] / clips[0].force[3]
    assert np.allclose(gain, gain[0])
    assert gain[0] != 1
    np.testing.assert_allclose(off.density[3], clips[0].density[3] * gain[0], rtol=1e-5)


def test_failing_flow_says_where(clips: list[Clip]) -> None:
    torn = disturb.hidden(clips[0], 0.5, 0.2, GRID, rng())
    gap = np.abs(torn.displacement["recovered"][3] - clips[0].displacement["ideal"][3]).max(0)
    assert (torn.confidence[3][gap > 0] < 0.2).all()
    assert (disturb.unsure(torn).confidence[3][clips[0].mask > 0] == 1).all()


def test_a_coarser_grid_keeps_force_and_motion(clips: list[Clip]) -> None:
    wide = coarser(clips[2], GRID, 2)
    fine = clips[2].density.sum((2, 3)) * GRID.pitch_mm**2
    np.testing.assert_allclose(wide.density.sum((2, 3)) * Grid(16).pitch_mm ** 2, fine, rtol=1e-4, atol=1e-6)
    largest = [np.abs(c.displacement["ideal"]).max() for c in (clips[2], wide)]
    assert largest[1] == pytest.approx(largest[0], rel=0.1)


def test_an_error_over_wider_cells_is_without_what_averages_out(clips: list[Clip], model: Path) -> None:
    rough = np.where(np.indices((32, 32)).sum(0) % 2, 0.1, -0.1).astype(np.float32)
    clip = dataclasses.replace(clips[2], mask=np.ones((32, 32), np.float32))

    class Rough:
        card = load_predictor(model).card

        @staticmethod
        def density(moved: object, mask: object, young_kpa: float) -> NDArray[np.float32]:
            said: NDArray[np.float32] = clip.density * np.float32(young_kpa) + rough
            return said

    predictor = cast(Predictor, Rough())
    assert wide_rmse(predictor, [clip], "ideal", 16) == pytest.approx([0.0], abs=1e-6)
    assert wide_rmse(predictor, [clip], "ideal", 32) > [0.05]


def test_a_fine_grid_gets_pictures_of_a_pixel_a_cell() -> None:
    job = reader.load_job("tiny").model_copy(update={"render": Render(size=(192, 144))})
    assert pictured(job, Grid(128)) == job
    assert pictured(job, Grid(256)).render.size == (384, 288)


def done(run: Run, rmse: list[float]) -> dict[str, Any]:
    """What a run leaves, as far as errors are read from it."""
    names = ("map_rmse", "map_rmse_wide", "force_mae")
    moments = {"map_moments": [1.0] * 7}
    rows = [{"name": f"{k}"} | moments | dict.fromkeys(names, v) for k, v in enumerate(rmse)]
    tree = {"name": run.name, "control": run.control, "settings": run.settings.as_dict(), "sequences": rows}
    return tree | {"source": run.source, "history": [{}], "columns": {"known": {}}}


def test_errors_are_of_runs_that_were_trained_as_the_preset_is(tmp_path: Path) -> None:
    runs = [run for run in preset_runs() if run.settings.size == PRESETS["cpu"].size]
    own = [shape(run.settings.arch) == shape(PRESETS["cpu"].arch) for run in runs]
    cpu, other = runs[own.index(True)], runs[own.index(False)]
    again = Run("again", replace(other.settings, seed=1))
    mse = replace(cpu.settings, objective=Objective(kind="mse"), seed=7)
    decayed = replace(cpu.settings, weight_decay=0.1, seed=9)
    elsewhere = replace(cpu.settings, seed=10)
    unlike = [
        Run("another-loss", mse),
        Run("longer", replace(cpu.settings, epochs=99, seed=8)),
        Run("other-decay", decayed),
        Run("on-recovered", elsewhere, source="recovered"),
    ]
    like = [
        done(cpu, [1.0, 2.0, 3.0, 4.0]),
        done(other, [1.5, 2.5, 3.0, 4.5]),
        done(again, [2.5, 2.5, 3.0, 4.5]),
    ]
    run_table.write(tmp_path / "presets", [*like, *(done(run, [9.0] * 4) for run in unlike)])
    found = errors(tmp_path)
    assert set(found) == {(shape(r.settings.arch), 128) for r in (cpu, other)}
    mine, beside = (found[shape(r.settings.arch), 128] for r in (cpu, other))
    assert (mine.error.mean, mine.seeds, mine.against) == (2.5, 1, None)
    assert (beside.error.mean, beside.seeds) == (3.0, 2)
    # Paired over the seed that both have: (0.5 + 0.5 + 0 + 0.5) / 10.
    assert beside.against is not None
    assert beside.against.mean == pytest.approx(0.15)


def test_runs_that_were_tested_on_other_sequences_are_not_averaged(tmp_path: Path) -> None:
    first = next(preset_runs())
    again = Run("again", replace(first.settings, seed=1))
    run_table.write(tmp_path / "presets", [done(first, [1.0, 2.0, 3.0]), done(again, [1.0, 2.0])])
    with pytest.raises(UserError, match="different sequences"):
        errors(tmp_path)


def test_runs_of_two_kinds_are_not_asked_for_at_once(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="one of them"):
        experiment(tmp_path, fine=True, large=True)


def test_tables_give_back_what_runs_left(tmp_path: Path) -> None:
    one, two = list(preset_runs())[:2]
    left = [done(two, [0.1, 1 / 3]), done(one, [0.2, 0.3])]
    del left[0]["sequences"][1]["map_rmse_wide"]
    run_table.write(tmp_path, left)
    found = run_table.read(tmp_path)
    assert [run["name"] for run in found] == sorted([one.name, two.name])
    for run, was in zip(found, sorted(left, key=lambda run: run["name"]), strict=True):
        assert run["settings"] == json.loads(json.dumps(was["settings"]))
    both = [run for run in found if run["name"] == two.name]
    assert run_table.column(both, "map_rmse") == pytest.approx([0.1, 1 / 3], rel=2**-14)
    assert np.isnan(run_table.column(both, "map_rmse_wide")).tolist() == [False, True]


@pytest.mark.slow
def test_a_run_is_answered_from_what_was_kept_only_if_nothing_that_made_it_changed(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = preset("tiny", size=32, epochs=1, folds=3, objective=Objective(kind="mse"))
    run = Run("run", replace(settings, arch=replace(settings.arch, levels=2, width=8)))
    trained: list[str] = []
    train = runs.train
    monkeypatch.setattr(runs, "train", lambda *args: trained.append(str(args[3])) or train(*args))

    def ask(run: Run = run, clips: list[Clip] = clips) -> dict[str, Any]:
        return runs.carry_out(run, clips, tmp_path, lambda line: None)

    first = ask()
    assert len(trained) == 1
    assert ask() == first
    assert len(trained) == 1
    ask(dataclasses.replace(run, settings=replace(run.settings, weight_decay=0.1)))
    assert len(trained) == 2
    ask(clips=[dataclasses.replace(clips[0], content_hash="other"), *clips[1:]])
    assert len(trained) == 3
    monkeypatch.setattr(kept, "code", lambda module: "other")
    ask()
    assert len(set(trained)) == 4


@pytest.mark.slow
def test_a_word_that_no_network_holds_needs_times_to_show(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nothing"):
        pareto(tmp_path / "new", tmp_path, only="nothing")
    assert not (tmp_path / "new").exists()


def test_controls_score_what_they_must(clips: list[Clip], model: Path) -> None:
    found = controls(load_predictor(model), clips[:3], "ideal", clips[3:])
    assert found["zero"]["map_r2_pooled"] <= 0
    assert found["identity"]["map_rmse"] == 0
    assert found["identity"]["map_r2_pooled"] == 1
    assert 0 < found["input"]["map_r2_pooled"] < 0.95


def test_the_mean_map_is_a_mean_that_knows_no_turn_and_its_skill_beyond_itself_is_none(
    clips: list[Clip], model: Path
) -> None:
    card = load_predictor(model).card
    base = mean_map(clips[:3], card, clips[3:])
    assert beyond_mean_map(base, base)["map"]["mean"] == 0
    truth = controls(load_predictor(model), clips[:3], "ideal", clips[3:])
    assert truth["mean map"]["map_r2_pooled"] < truth["input"]["map_r2_pooled"]
    # On a full mask the mean map holds the fitted frames' mean force, whichever way they are turned.
    full = [dataclasses.replace(c, mask=np.ones_like(c.mask)) for c in clips]
    said = mean_map(full[:1], card, full[3:]).clips[0].said_mn / full[0].young_kpa
    lengths = [np.linalg.norm(c.density, axis=1).sum((1, 2)) for c in full[3:]]
    assert said[0] == pytest.approx(np.concatenate(lengths).mean() * GRID.pitch_mm**2, rel=1e-5)


def test_every_bad_input_gets_one_line(model: Path, tmp_path: Path) -> None:
    rows = bad_inputs(model, tmp_path / "bad")
    assert len(rows) > 12
    assert [row for row in rows if not row["one line"]] == []
    assert not any(str(tmp_path) in row["said"] for row in rows)


def test_a_table() -> None:
    assert markdown([{"a": 1.23456, "b": None}, {"a": True, "b": "x"}]).splitlines()[2:] == [
        "| 1.235 | – |",
        "| yes | x |",
    ]
