"""Pipelines, learning curves and the gap: errors of known estimates, held-out data, ridge, noise, cache."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from evidence import gap, result_cache, training
from evidence.curves import experiment, models
from evidence.curves.experiment import GRID, SAME, Estimator
from learn.data.clips import Clip
from learn.settings import preset
from learn.split import Split
from synth import formats
from synth.errors import UserError

N, T = 16, 6


def make_clip(
    name: object, displacement: NDArray[Any], force: NDArray[Any], mask: NDArray[Any] | None = None
) -> Clip:
    """`displacement`: (T, 2, N, N) mm, ideal and recovered; `force`: (T, 3) mN; full confidence, E 2 kPa."""
    frames, _, n, _ = displacement.shape
    displacement = displacement.astype(np.float32)
    return Clip(
        name=str(name),
        content_hash=str(name),
        group=str(name),
        young_kpa=2.0,
        mask=np.ones((n, n), np.float32) if mask is None else mask,
        displacement={"ideal": displacement, "recovered": displacement},
        confidence=np.ones((frames, n, n), np.float32),
        density=np.zeros((frames, 3, n, n), np.float32),
        force=force,
    )


def clip(rng: np.random.Generator, name: int = 0) -> Clip:
    """Clip with a force across the line of sight, E times the sum of displacement, and an incomplete mask."""
    mask = np.ones((N, N), np.float32)
    mask[:3, :5] = 0
    displacement = rng.standard_normal((T, 2, N, N)).astype(np.float32) * mask
    force = np.zeros((T, 3))
    force[:, :2] = 2.0 * displacement.sum(axis=(2, 3))
    return make_clip(name, displacement, force, mask)


def test_errors_of_known_estimates() -> None:
    force = np.tile([3.0, 0.0, 4.0], (2, 1))
    nothing = models.errors([np.zeros((2, 3))], [force])
    assert [nothing[part][0] for part in ("errors", "across", "along")] == pytest.approx([1, 0.6, 0.8])
    # Sequences have equal weights, whatever their force.
    sequences = models.errors([force * 0, force * 0.5], [force, 100 * force])
    assert sequences["errors"] == pytest.approx([1, 0.995])


def arrow(clip: Clip) -> NDArray[np.float64]:
    """Position of the only moved cell from the centre, and its displacement, (4,)."""
    displacement = np.asarray(clip.displacement["recovered"][0])
    row, col = np.argwhere(np.abs(displacement).sum(axis=0) > 0)[0]
    return np.array([col - (N - 1) / 2, row - (N - 1) / 2, *displacement[:, row, col]])


def test_orientations_transform_places_and_vectors_alike() -> None:
    original = clip(np.random.default_rng(0))
    displacement = np.zeros((T, 2, N, N), np.float32)
    displacement[:, :, 2, 11] = (3.5, -5.5)  # outwards: x right, y down
    force = np.tile([3.5, -5.5, 9.0], (T, 1))
    turns = models.rotate_clip(replace(original, displacement={"recovered": displacement}, force=force))
    for turn in turns:
        x, y, dx, dy = arrow(turn)
        assert (dx, dy) == (x, y)
        assert turn.force[0] == pytest.approx([x, y, 9.0])
    assert len({tuple(arrow(turn)) for turn in turns}) == 8


def test_cached_results_depend_on_inputs_and_versions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    computations: list[int] = []

    def count(*parts: object) -> int:
        key = result_cache.key(*parts, versions=("MESH",))
        result_cache.result(tmp_path, "x", key, lambda: computations.append(1) or len(computations))
        return len(computations)

    assert [count("a", ["b"]), count("a", ["b"]), count("a", ["c"]), count("a", ["b"])] == [1, 1, 2, 2]
    monkeypatch.setattr(formats, "SCORING", formats.SCORING + 1)
    assert count("a", ["b"]) == 2
    monkeypatch.setattr(formats, "MESH", formats.MESH + 1)
    assert count("a", ["b"]) == 3


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    """Clips whose displacement is the force, all over the grid."""
    rng, examples = np.random.default_rng(1), []
    for k in range(12):
        force = rng.normal(size=(6, 3))
        motion = np.broadcast_to(force[:, :, None, None], (6, 3, GRID.size, GRID.size)).astype(np.float32)
        clip_2d = make_clip(k, motion[:, :2], 2.0 * force)
        fields = {"recovered": motion[:, :2], "motion": motion}
        confidence = np.ones((6, 2, GRID.size, GRID.size), np.float32)
        density = motion / GRID.extent_mm**2
        examples.append(replace(clip_2d, displacement=fields, motion_confidence=confidence, density=density))
    return examples


def measure(estimator: Estimator, clips: list[Clip], work: Path) -> dict[str, Any]:
    """Errors on the first four clips after fitting on the last six."""
    tests = {SAME: (clips[:4], [k % 2 == 0 for k in range(4)])}
    (row,) = experiment.measure_estimator(estimator, clips[4:], 2, tests, 10, 3600.0, work)
    return row


def test_ridge_estimates_force_in_stereo_and_its_lateral_part_monocular(
    clips: list[Clip], tmp_path: Path
) -> None:
    stereo = measure(Estimator("ridge", 2, 6), clips, tmp_path)
    monocular = measure(Estimator("ridge", 1, 6), clips, tmp_path)
    assert stereo["whole"][0] < 0.02
    assert stereo["gain"] == pytest.approx(1, abs=0.02)
    assert monocular["across"][0] < 0.02
    assert monocular["along"][0] > 0.3
    assert stereo["cpu_h"] == pytest.approx(6, abs=0.1)


def test_tested_sequences_are_held_out(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: dict[str, list[str]] = {}

    def fake_fit(estimator: Estimator, fit: list[Clip], select: list[Clip], steps: int, work: Path) -> object:
        used.update(fit=[c.content_hash for c in fit], select=[c.content_hash for c in select])
        return lambda clip: used.setdefault("test", []).append(clip.content_hash) or clip.force

    monkeypatch.setattr(experiment, "fit_estimator", fake_fit)
    assert measure(Estimator("ridge", 2, 6), clips, tmp_path)["whole"][0] == 0
    assert used == {"fit": [*map(str, range(6, 12))], "select": ["4", "5"], "test": ["0", "1", "2", "3"]}


@pytest.mark.trial
def test_a_training_of_a_study_is_stored_and_reused(
    clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split = Split(tuple(range(8)), (8, 9), (10, 11))
    settings = preset("tiny", input="recovered", epochs=1)

    def predict() -> NDArray[Any]:
        predictor = training.fit("x", clips, split, settings, tmp_path)
        return models.read_force(predictor, clips[11], "recovered")

    force = predict()
    assert force.shape == (6, 3)
    (folder,) = tmp_path.iterdir()
    stored_ns = (folder / "config.json").stat().st_mtime_ns
    np.testing.assert_array_equal(predict(), force)
    assert (folder / "config.json").stat().st_mtime_ns == stored_ns
    monkeypatch.setattr(formats, "TRAINING", formats.TRAINING + 1)
    predict()
    assert len([*tmp_path.iterdir()]) == 2


def test_share_closed_of_known_errors() -> None:
    rng = np.random.default_rng(0)
    base = rng.uniform(0.9, 1.1, 30)
    closure = gap.compute_share(8 * base, 4 * base)
    assert closure["share"] == pytest.approx(4 / 8, rel=1e-9)
    assert closure["interval"] == pytest.approx([0.5, 0.5], abs=1e-6)  # proportional pairs: no uncertainty
    none = gap.compute_share(-0.3 * rng.normal(size=20), np.ones(20))
    assert none["share"] is None
    assert none["undefined"]


def test_the_gap_of_known_errors() -> None:
    """Twice the error on recovered flow, of which training on it takes three quarters of the excess away."""
    rng = np.random.default_rng(0)
    force = rng.uniform(1, 100, 12)
    tests = [f"{place}, {flow}" for place in gap.PLACES for flow in gap.FLOWS]

    def run(*by_flow: float) -> gap.Errors:
        factors = dict(zip(gap.FLOWS, by_flow, strict=True))
        return {test: (factors[test.split(", ")[1]] * force).tolist() for test in tests}

    errors = {"I": [run(0.1, 0.2)], "R": [run(0.11, 0.125)], "N": [run(0.1, 0.15)], "S": [run(1.0, 1.0)]}
    summary = gap.summary(errors, dict.fromkeys(gap.PLACES, force.tolist()), run(0.3, 0.4))
    assert set(summary["places"]) == set(gap.PLACES)
    for place in summary["places"].values():
        assert place["opened"] == pytest.approx(2)
        shares = {kind: share["share"] for kind, share in place["closed"].items()}
        assert shares == pytest.approx({"R": 0.75, "N": 0.5, "S": -8})
        assert place["noise_less_real"][0] == pytest.approx(0.025)
    assert summary["errors"]["no force"]["own, ideal"][0] == pytest.approx(1)
    assert summary["errors"]["physics"]["own, recovered"][0] == pytest.approx(0.4)
    assert summary["errors_mn"]["I"]["own, recovered"][0] == pytest.approx(0.2 * force.mean())


@pytest.mark.trial
def test_a_training_of_the_gap_keeps_the_errors_of_its_epochs(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-1:1:16j, -1:1:16j]
    bump = np.exp(-4 * (x**2 + y**2)) * np.stack([x, y])
    pressed_clips = []
    for k in range(12):
        size = rng.uniform(0.5, 2, (T, 1, 1, 1))
        clip = make_clip(k, size * bump, np.zeros((T, 3)))
        density = np.zeros(clip.density.shape, np.float32)
        density[:, 2, 6:10, 6:10] = size[:, 0]
        force = 2.0 * density.sum(axis=(2, 3)).astype(np.float64)
        pressed_clips.append(replace(clip, density=density, force=force))
    settings = preset("tiny", size=16, input="recovered", epochs=3)
    split = Split(tuple(range(8)), (8, 9), (10, 11))
    tests = {f"own, {flow}": (pressed_clips[10:], flow) for flow in gap.FLOWS}
    errors = gap.errors("R", pressed_clips, split, settings, tests, tmp_path)
    assert [row[0] for row in errors["curve"]] == [2]
    assert all(len(values) == 2 and np.isfinite(values).all() for values in errors["errors"].values())
    write_times = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.safetensors")}
    assert gap.errors("R", pressed_clips, split, settings, tests, tmp_path) == errors
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.safetensors")} == write_times


def test_ridge_on_recovered_flow_closes_the_gap_that_lost_motion_opens() -> None:
    """Recovered flow misses half of the motion: ridge on ideal flow finds half of the force, on recovered
    flow all of it, as with the noise model's gain; with other sequences' forces it learns little."""
    rng = np.random.default_rng(0)
    y, x = np.mgrid[-1:1:16j, -1:1:16j]
    bump = np.exp(-4 * (x**2 + y**2))
    clips = []
    for k in range(24):
        force = 10 * rng.normal(size=(T, 3)) * (1, 1, 0)
        displacement = np.einsum("ti,yx->tiyx", force[:, :2], bump)
        clip = make_clip(k, displacement, force)
        clips.append(replace(clip, displacement={"ideal": displacement, "recovered": 0.5 * displacement}))
    tests = {f"own, {flow}": (clips[16:], flow) for flow in gap.FLOWS}
    sizes = [float(np.linalg.norm(clip.force, axis=1).mean()) for clip in clips[16:]]
    errors = {kind: gap.ridge_errors(kind, clips, range(16), tests) for kind in gap.KINDS}

    def share(kind: str, flow: str) -> float:
        return float(np.mean(np.array(errors[kind][f"own, {flow}"]) / sizes))

    assert share("I", "ideal") < 1e-3
    assert share("I", "recovered") == pytest.approx(0.5, abs=1e-3)
    assert share("R", "recovered") < 1e-3
    assert share("N", "recovered") < 1e-3
    assert share("S", "recovered") > 0.5


def test_fitted_noise_is_that_added() -> None:
    rng = np.random.default_rng(1)
    mask = np.zeros((48, 48), np.float32)
    mask[6:-6, 6:-6] = 1
    ideal = [np.cumsum(rng.normal(size=(6, 2, 1, 1)), axis=0).astype(np.float32) * mask for _ in range(8)]
    true = gap.Noise(0.9, 0.12, 2.0)
    displacements = [{"ideal": i, "recovered": true.add(i, mask, rng)} for i in ideal]
    clips = [
        replace(make_clip(k, displacement["ideal"], np.zeros((6, 3)), mask), displacement=displacement)
        for k, displacement in enumerate(displacements)
    ]
    noise = gap.fit_noise(clips)
    assert noise.gain == pytest.approx(0.9, abs=0.02)
    assert noise.sigma_mm == pytest.approx(0.12, rel=0.1)
    assert noise.reach_cells == pytest.approx(2.0, rel=0.1)
    assert not true.add(ideal[0], mask, rng)[:, :, 0, 0].any()


def test_the_parts_share_no_anatomy() -> None:
    def make_clips(name: str, count: int) -> list[Any]:
        return [SimpleNamespace(group=f"{name}{k // 2}", content_hash=f"{name}{k}") for k in range(count)]

    ours, theirs = make_clips("a", 60), make_clips("b", 8)
    split, test_part = gap.parts(ours, theirs)
    assert split.test == tuple(range(60, 68))
    parts = [set(split.fit), set(split.select), set(test_part)]
    assert set.union(*parts) == set(range(60))
    anatomies = [{i // 2 for i in part} for part in parts]
    assert sum(map(len, anatomies)) == len(set.union(*anatomies))
    with pytest.raises(UserError):
        gap.parts(ours, make_clips("a", 4))
