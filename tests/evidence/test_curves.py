"""Learning curves: readers find a force that is put in, ask what is held out, and say what it took."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import phantom
import pytest

from evidence.curves import experiment, page, readers
from evidence.curves.readers import MODELS, NETWORKS, Reader, World
from learn.data.clips import Clip, load_clips
from synth.errors import UserError


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> list[Clip]:
    """Displacement is the force itself, spread over the grid; what is recovered is half of it."""
    root = tmp_path_factory.mktemp("curves")
    phantom.write(root / "data", 0, anatomy_seed=0, two_eyes=True)
    (base,) = load_clips(root / "data", readers.GRID, ("ideal", "motion-ideal"))
    rng = np.random.default_rng(1)
    made = []
    for k in range(12):
        force = rng.normal(size=(base.frames, 3))
        moved = (force[:, :, None, None] * base.mask).astype(np.float32)
        area = float(base.mask.sum()) * readers.GRID.pitch_mm**2
        made.append(
            replace(
                base,
                content_hash=str(k),
                group=str(k),
                displacement={
                    "ideal": 2 * moved[:, :2],
                    "recovered": moved[:, :2],
                    "motion-ideal": 2 * moved,
                    "motion": moved,
                },
                motion_confidence=np.ones((base.frames, 2, *base.mask.shape), np.float32),
                density=moved / np.float32(area),
                force=base.young_kpa * force,
            )
        )
    return made


@pytest.fixture
def world(clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    monkeypatch.setattr(readers, "_load", lambda root, work: clips)
    monkeypatch.setattr(readers, "_bare", lambda root: [k % 2 == 0 for k in range(12)])
    monkeypatch.setattr(World, "generation_cpu_s", lambda self: 3600.0)
    return World(tmp_path / "data", (), 4, 2, 10, tmp_path / "work")


def test_ridge_of_two_eyes_finds_the_force_and_of_one_its_part(world: World) -> None:
    two = world.rows(Reader("ridge", "recovered", 2, 6, 0))[0]
    one = world.rows(Reader("ridge", "recovered", 1, 6, 0))[0]
    assert two["whole"] < 0.02
    assert two["gain"] == pytest.approx(1, abs=0.02)
    assert one["across"] < 0.02
    assert one["along"] > 0.3
    assert two["cpu_h"] == pytest.approx(6, abs=0.1)


def test_what_is_fitted_on_true_motion_is_asked_with_recovered(world: World) -> None:
    """Recovered motion is half of the true one: the answer is half of the force."""
    found = world.rows(Reader("ridge", "ideal", 2, 6, 0))[0]
    assert found["gain"] == pytest.approx(0.5, abs=0.02)
    assert found["slope"] == pytest.approx(2, abs=0.08)
    assert found["whole"] == pytest.approx(0.5, abs=0.02)
    assert world.rows(Reader("ridge", "exact", 2, 6, 0))[0]["whole"] < 0.02


def test_no_sequence_that_is_asked_was_fitted(
    world: World, clips: list[Clip], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, list[str]] = {}

    def fitted(self: World, one: Reader, fit: list[Clip], choose: list[Clip], key: str) -> object:
        seen.update(fit=[c.content_hash for c in fit], choose=[c.content_hash for c in choose])
        return lambda clip: seen.setdefault("asked", []).append(clip.content_hash) or clip.force, None

    monkeypatch.setattr(World, "_fitted", fitted)
    row = world.rows(Reader("ridge", "recovered", 2, 6, 0))[0]
    assert row["whole"] == 0
    assert seen == {
        "fit": ["6", "7", "8", "9", "10", "11"],
        "choose": ["4", "5"],
        "asked": ["0", "1", "2", "3"],
    }


def test_bare_ones_are_those_without_a_membrane(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def fitted(self: World, one: Reader, fit: list[Clip], choose: list[Clip], key: str) -> object:
        return lambda clip: clip.force * (1.0 if int(clip.content_hash) % 2 == 0 else 0.0), None

    monkeypatch.setattr(World, "_fitted", fitted)
    row = world.rows(Reader("ridge", "recovered", 2, 6, 0))[0]
    assert (row["bare"], row["whole"]) == (0, 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("model", [name for name in MODELS if name != "ridge"])
def test_every_reader_answers_and_a_kept_row_is_not_computed_again(
    world: World, model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readers, "_MOST", 4)
    one = Reader(model, "recovered", 1, 4, 0)
    (row,) = world.rows(one)
    assert row["force_size"] >= 0
    assert (row["whole"] is None) == (model == "boosting")
    assert (row["map_r2"] is None) == (model not in NETWORKS)
    monkeypatch.setattr(World, "_fitted", None)
    assert world.rows(one) == [row]


def test_noise_is_drawn_where_flow_was_recovered(clips: list[Clip]) -> None:
    """The recovered flow of these clips is half of the true one, without error: a gain is all there is."""
    made = readers.noisy(clips[:4], 3, 0)
    for before, after in zip(clips, made, strict=False):
        assert np.allclose(after.displacement["recovered"], before.displacement["recovered"], atol=1e-5)


def test_which_points_are_computed() -> None:
    wanted = list(
        experiment._wanted([100, 30], ["ridge", "d2fnet-s"], ["noise", "recovered", "mixed"], [1, 2], 2)
    )
    assert [one.size for one in wanted] == sorted(one.size for one in wanted)
    assert {(one.model, one.input, one.eyes) for one in wanted} == {
        ("ridge", "recovered", 1),
        ("ridge", "recovered", 2),
        ("d2fnet-s", "noise", 1),
        ("d2fnet-s", "recovered", 1),
        ("d2fnet-s", "recovered", 2),
        ("d2fnet-s", "mixed", 1),
        ("d2fnet-s", "mixed", 2),
    }
    assert {one.seed for one in wanted if one.model == "ridge"} == {0}
    with pytest.raises(UserError, match="--models: lasso; there are half-space, ridge"):
        list(experiment._wanted([30], ["lasso"], ["ideal"], [1], 1))


def test_every_row_is_on_the_page() -> None:
    names = ("whole", "across", "along", "force_size", "bare")
    ends = {"": 0.3, "_low": 0.2, "_high": 0.4}
    said = experiment.with_intervals({name + end: ends[end] for name in names for end in ends})
    assert said == {name: [0.3, 0.2, 0.4] for name in names}
    assert experiment.with_intervals({"whole": None, "whole_low": None, "gain": 1}) == {
        "whole": None,
        "gain": 1,
    }
    rows = [
        {"model": "ridge", "input": "recovered", "eyes": eye, "size": size, "seed": 0, "asked": asked}
        | {"map_r2": None, "ghosts": None, "gain": 1.0, "slope": 1.0, "cpu_h": 0.1, "fit_cpu_s": 1.0}
        | said
        for asked in ("same world", "mission-unseen")
        for eye in (1, 2)
        for size in (30, 100)
    ]
    shown = page.drawn({"rows": rows, "generation_cpu_s": 4.0, "asked": {"same world": 3}})
    assert len(shown.charts) == 4
    assert len(shown.sections[0].rows) == len(rows)


def test_rows_of_another_run_are_shown_with_ones_own_if_they_asked_the_same(tmp_path: Path) -> None:
    def row(model: str, whole: float) -> dict[str, object]:
        return asdict(Reader(model, "recovered", 1, 30, 0)) | {"asked": "same world", "whole": whole}

    other = {
        "command": "bench one",
        "asked": {"same world": 4},
        "rows": [row("ridge", 0.5), row("k-NN", 0.6)],
    }
    rows = experiment.joined([row("ridge", 0.4)], [other], {"same world": 4})
    assert {str(one["model"]): one["whole"] for one in rows} == {"ridge": 0.4, "k-NN": 0.6}
    with pytest.raises(UserError, match="--add: 'bench one' asked"):
        experiment.joined([], [other], {"same world": 5})
    (tmp_path / "curves.json").write_text("[]")
    with pytest.raises(UserError, match="is no curves"):
        experiment._read(tmp_path / "curves.json")
