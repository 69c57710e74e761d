import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from learn import checkpoint
from learn.data.clips import Clip
from learn.inference.predict import load_model
from learn.settings import TrainingSettings, as_changes, preset, replace
from learn.split import Split, keep_unseen
from learn.training.batches import Batch, FrameDataset, FrameItem, add_surface_motion, measure_scales
from learn.training.train import select_score, train
from synth.dataset.store import Dataset
from synth.errors import UserError
from synth.system.config_file import override


def small(**changes: object) -> TrainingSettings:
    base = preset("tiny", size=32, epochs=4, loss="antighost")
    return replace(base, arch=replace(base.arch, levels=2, dropout=0.1), **changes)


SPLIT = Split((2, 5, 7), (0, 1), (3, 4, 6))


@pytest.fixture(scope="module")
def model(clips: list[Clip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train(clips, SPLIT, small(input="mixed"), out)
    return out


@pytest.mark.slow
def test_killed_and_resumed_equals_uninterrupted(clips: list[Clip], model: Path, tmp_path: Path) -> None:
    def kill(numbers: dict[str, float]) -> None:
        if numbers["epoch"] == 2:
            raise KeyboardInterrupt

    out = tmp_path / "model"
    with pytest.raises(KeyboardInterrupt):
        train(clips, SPLIT, small(input="mixed"), out, log=kill)
    card = train(clips, SPLIT, small(input="mixed"), out)
    uninterrupted, resumed = (checkpoint.read_tensors(folder / "last.pt")["model"] for folder in (model, out))
    for name, value in resumed.items():
        assert torch.equal(value, uninterrupted[name]), name
    assert (out / "history.jsonl").read_text() == (model / "history.jsonl").read_text()
    assert card == checkpoint.read_card(model)


@pytest.mark.slow
def test_training_learns(clips: list[Clip], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The network overfits six sequences; without learning the loss stays at 0.9."""
    settings = small(epochs=8, batch=4, learning_rate=5e-3)
    settings = replace(settings, arch=replace(settings.arch, dropout=0.0))
    draw = FrameDataset.order
    monkeypatch.setattr(FrameDataset, "order", lambda *args: [item._replace(turn=0) for item in draw(*args)])
    train(clips, Split((0, 1, 3, 4, 5, 6), (2,), ()), settings, tmp_path / "m")
    losses = [json.loads(line)["loss"] for line in (tmp_path / "m/history.jsonl").read_text().splitlines()]
    assert losses[-1] < 0.6 < 0.8 < losses[0]


def test_sequences_of_training_brains_are_not_scored(clips: list[Clip], model: Path) -> None:
    card = checkpoint.read_card(model)
    assert [c.name for c in keep_unseen(clips, card)] == [clips[i].name for i in SPLIT.test]
    clip_copy = dataclasses.replace(clips[SPLIT.fit[0]], content_hash="x")
    assert keep_unseen([clip_copy], card) == []


def test_prediction_from_a_picture_equals_that_on_the_grid(
    model: Path, dataset: Path, clips: list[Clip]
) -> None:
    predictor = load_model(model)
    sequence = Dataset(dataset)[4]
    inputs = sequence["flow"][3], sequence["tissue"][:], sequence.attrs["scale_mm_per_px"]
    map_ = predictor(*inputs, sequence.attrs["young_kpa"])
    on_grid = predictor.density(clips[4].displacement["ideal"][3:4], clips[4].mask, clips[4].young_kpa)[0]
    np.testing.assert_allclose(map_.density, on_grid, rtol=1e-4, atol=1e-7)
    assert map_.total_force_mn == pytest.approx(float(np.linalg.norm(map_.force_mn)))
    guess = predictor(*inputs)
    assert guess.young_kpa == predictor.card.typical_young_kpa
    expected = map_.total_force_mn * guess.young_kpa / map_.young_kpa
    assert guess.total_force_mn == pytest.approx(expected, rel=1e-4)


def test_force_does_not_depend_on_the_resolution(model: Path) -> None:
    predictor = load_model(model)

    def force(size: int, scale: float) -> float:
        node = (np.arange(size) - (size - 1) / 2) * scale
        x, y = np.meshgrid(node, node)
        tissue = x**2 + y**2 < 11**2
        flow = np.stack([np.exp(-(x**2 + y**2) / 30), 0 * x], axis=-1) * 0.5 / scale
        return predictor((flow * tissue[..., None]).astype(np.float32), tissue, scale, 1.0).total_force_mn

    assert force(240, 0.15) == pytest.approx(force(120, 0.3), rel=0.05)


def test_other_runs_and_leaking_splits_are_refused(clips: list[Clip], model: Path, tmp_path: Path) -> None:
    before = (model / "weights.safetensors").read_bytes()
    with pytest.raises(UserError, match="settings"):
        train(clips, SPLIT, small(input="mixed", learning_rate=0.1), model)
    with pytest.raises(UserError):
        train(clips[:-1], Split((2, 5), (0, 1), (3, 4, 6)), small(input="mixed"), model)
    assert (model / "weights.safetensors").read_bytes() == before
    with pytest.raises(UserError):  # a leaking split: clips 0 and 1 share an anatomy
        train(clips, Split((0, 2), (3,), (1,)), small(), tmp_path / "m")


def test_surface_motion_is_added_to_half_of_the_frames_without_force(clips: list[Clip]) -> None:
    settings = small(surface_motion_mm=0.5)
    frames = FrameDataset(clips, settings)
    items = [FrameItem(c, t, "ideal") for c in range(len(clips)) for t in range(clips[c].frames)]
    still = frames.batch(items)
    augmented = add_surface_motion(still, settings, torch.Generator().manual_seed(0))
    added = (augmented.displacement - still.displacement).abs()
    assert (added * (1 - still.mask)).max() == 0
    touched = added.amax((1, 2, 3)) > 0
    assert 0.2 < touched.float().mean() < 0.8
    size = float((added[touched] ** 2).sum() / (still.mask.expand_as(added)[touched]).sum()) ** 0.5
    assert 0.05 < size < 0.5  # a third of 0.5 mm across the view
    for name in ("mask", "confidence", "target"):
        assert torch.equal(getattr(augmented, name), getattr(still, name))
    repeated = add_surface_motion(still, settings, torch.Generator().manual_seed(0))
    assert torch.equal(repeated.displacement, augmented.displacement)


GAINS = (0.8, 8, 1.0, 1.5), (0.8, 7, 1.0, 1.0), (2.0, 8, 0.67, 0.67)


@pytest.mark.parametrize(("share", "anatomies", "low", "high"), GAINS)
def test_the_force_gain_corrects_an_underestimate(
    clips: list[Clip], monkeypatch: pytest.MonkeyPatch, share: float, anatomies: int, low: float, high: float
) -> None:
    settings = small()
    true, predicted = [], []

    def forward(_: object, batch: Batch, *__: object) -> torch.Tensor:
        """The truth with errors that vary by frame and by side, and a large force outside the tissue."""
        frames = torch.linspace(0.6, 1.4, len(batch.target))[:, None, None, None]
        side = torch.linspace(1.5, 0.5, settings.size)
        density = share * frames * side * batch.target
        true.extend((batch.target * batch.mask).sum((2, 3)).flatten().tolist())
        predicted.extend((density * batch.mask).sum((2, 3)).flatten().tolist())
        return density + 9 * (1 - batch.mask)

    monkeypatch.setattr("learn.training.train.forward", forward)
    select = [dataclasses.replace(clips[i % len(clips)], group=str(i % anatomies)) for i in range(10)]
    selection = FrameDataset(select, settings)
    scores = select_score(torch.nn.Identity(), selection, measure_scales(clips, settings))
    vectors = [
        np.reshape(values, (len(select), -1, settings.arch.components)) for values in (true, predicted)
    ]
    sequences = [(t, p) for t, p in zip(*vectors, strict=True) if t.any()]

    def error(gain: float) -> float:
        errors = [(gain * p - t, t) for t, p in sequences]
        return float(
            np.mean([np.linalg.norm(e, axis=1).sum() / np.linalg.norm(t, axis=1).sum() for e, t in errors])
        )

    gains = np.linspace(0.3, 3, 2701)
    best_gain = gains[np.argmin([error(gain) for gain in gains])]
    assert scores["select_gain"] == pytest.approx(np.clip(best_gain, low, high), rel=0.02)
    assert low == high or low < best_gain < high, "else the limits are tested twice"


@pytest.mark.parametrize(("change", "key"), [("bacth=3", "'batch'"), ("arch.depth=true", "arch.depth")])
def test_invalid_settings_are_refused(change: str, key: str) -> None:
    with pytest.raises(UserError, match=key):
        override(preset("live"), [change])


def test_settings_may_stand_anywhere_and_need_a_value() -> None:
    words = ["--epochs", "3", "data", "--seed=1", "loss=mse", "seed=2"]
    assert as_changes(words) == ({"epochs": "3", "seed": "2", "loss": "mse"}, ["data"])
    for incomplete in (["--compile", "--epochs", "3"], ["data", "--epochs"]):
        with pytest.raises(UserError):
            as_changes(incomplete)
