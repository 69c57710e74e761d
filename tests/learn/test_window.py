"""A network that is told several frames: never later ones, and the same of a film as of a stream."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import fake_model
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from bench.methods.network import Model
from bench.methods.protocol import Scene
from learn.data.clips import Clip
from learn.data.grid import windowed
from learn.data.split import nested
from learn.evaluation.evaluate import evaluate
from learn.inference.apply import Motion, Step, apply
from learn.inference.export import examples, export
from learn.inference.force_reader import ForceReader
from learn.inference.predict import Predictor, load_predictor
from learn.network.d2fnet import Architecture
from learn.settings import Settings, override, preset
from learn.training.batches import Frames, inputs, measure_scales
from learn.training.gpu_batches import Resident
from learn.training.train import train
from synth.errors import UserError

SHAPE, SCALE = (40, 48), 0.8
TISSUE = np.ones(SHAPE, bool)
Film = NDArray[np.float32]


@pytest.fixture
def film() -> Film:
    """Seven frames of flow (7, H, W, 2) px, the first at rest."""
    flow = np.random.default_rng(0).normal(size=(7, *SHAPE, 2)).astype(np.float32)
    flow[0] = 0
    return flow


@pytest.fixture(params=[3, 5])
def model(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    return fake_model.write_model(tmp_path / "model", "arch.output=vector", f"arch.window={request.param}")


def on_grid(predictor: Predictor, film: Film) -> Film:
    view = predictor.view(TISSUE, SCALE)
    return np.stack([predictor.on_grid(view, flow)[0] for flow in film])


def test_frames_before_the_first_are_the_rest_frame() -> None:
    moved = np.arange(1, 5, dtype=np.float32).reshape(4, 1, 1, 1)
    assert windowed(moved, 3)[..., 0, 0].tolist() == [[1, 0, 0], [2, 1, 0], [3, 2, 1], [4, 3, 2]]
    assert windowed(moved[2:], 3, moved[:2])[..., 0, 0].tolist() == [[3, 2, 1], [4, 3, 2]]
    assert windowed(moved[3:], 5, moved[2:3])[..., 0, 0].tolist() == [[4, 3, 0, 0, 0]]
    assert windowed(moved, 1) is moved


def test_a_later_frame_changes_no_answer_and_an_earlier_one_does(model: Path, film: Film) -> None:
    predictor, mask = load_predictor(model), np.ones((32, 32), np.float32)
    moved, window = on_grid(predictor, film), load_predictor(model).card.settings.arch.window
    said = predictor.density(moved, mask, 1.0)
    for t in range(1, 7):
        other = moved.copy()
        other[t] *= -1
        changed = [
            not np.array_equal(a, b) for a, b in zip(said, predictor.density(other, mask, 1.0), strict=True)
        ]
        assert changed == [t <= k < t + window for k in range(7)], t


def test_a_stream_is_answered_as_the_film_is(model: Path, film: Film) -> None:
    predictor = load_predictor(model)
    mask = predictor.view(TISSUE, SCALE).mask
    whole = predictor.density(on_grid(predictor, film), mask, 2.0)
    assert np.ptp(whole.sum((1, 2, 3))) > 0
    reader, live = ForceReader(predictor, TISSUE, SCALE, 2.0), Model(model, quick=True)
    scene = Scene(TISSUE, SCALE, 2.0)
    buffer = np.empty_like(film[0])
    for t, flow in enumerate(film):
        buffer[:] = flow  # a camera may fill the same array again
        force, said = reader.read(buffer, None)
        np.testing.assert_allclose(said.density, whole[t], atol=1e-4)
        if t:  # `bench live` doesn't ask about the rest frame
            answer = live(buffer, np.ones(SHAPE, np.float32), scene, False)
            np.testing.assert_allclose(answer.force_mn, force, rtol=1e-3, atol=0.02)


def test_a_frame_that_was_lost_is_as_if_it_had_not_been(model: Path, film: Film) -> None:
    predictor = load_predictor(model)
    one, two = (ForceReader(predictor, TISSUE, SCALE, 2.0) for _ in range(2))
    for flow in film[:6]:
        one.read(flow, None)
        two.read(flow, None)
    two.read(100 * film[2], None)
    two.forget_last()
    assert np.array_equal(one.read(film[6], None)[0], two.read(film[6], None)[0])


def test_a_film_with_a_lost_frame_is_read_as_if_without_it(model: Path, film: Film) -> None:
    def told(frames: list[int]) -> Motion:
        steps = (Step(film[t] if t != 3 else 100 * film[3], None, t, t / 10, t != 3) for t in frames)
        return Motion("film", steps, TISSUE, SCALE, 2.0)

    predictor = load_predictor(model)
    lost, without = apply(predictor, told([*range(7)])), apply(predictor, told([0, 1, 2, 4, 5, 6]))
    assert np.isnan(lost["total_force_mn"][3])
    np.testing.assert_array_equal(np.delete(lost["density"], 3, axis=0), without["density"])


def test_a_network_of_one_frame_remembers_nothing(tmp_path: Path, film: Film) -> None:
    model = fake_model.write_model(tmp_path / "model", "arch.output=vector")
    assert "window" not in json.loads((model / "config.json").read_text())["settings"]["arch"]
    predictor = load_predictor(model)
    reader = ForceReader(predictor, TISSUE, SCALE, 2.0)
    for flow in film:
        fresh = ForceReader(predictor, TISSUE, SCALE, 2.0)
        assert np.array_equal(reader.read(flow, None)[0], fresh.read(flow, None)[0])


def small(*changes: str) -> Settings:
    return override(preset("tiny"), ["size=32", "arch.levels=2", "epochs=1", "arch.window=3", *changes])


def test_batches_hold_the_frames_that_the_reader_would_tell(clips: list[Clip]) -> None:
    settings = small("input=recovered", "arch.confidence=true")
    scales = measure_scales(clips, settings)
    told = windowed(np.asarray(clips[1].displacement["recovered"]), 3)
    frames = Frames(clips, settings)
    (batch,) = frames.sequential(1, "recovered") if clips[1].frames <= settings.batch else [None]
    assert batch is not None
    assert np.array_equal(batch.displacement.numpy(), told)
    assert inputs(batch, settings, scales).shape[1] == settings.arch.inputs == 10
    items = [(1, t, "recovered", turn) for t in range(clips[1].frames) for turn in range(8)]
    items.sort(key=lambda item: item[3])
    one = frames.batch(items)
    two = Resident(clips, settings, torch.device("cpu")).batch(items)
    for name, value in vars(one).items():
        assert torch.equal(value, vars(two)[name]), name


@pytest.mark.parametrize("extra", [[], ["arch.confidence=true", "arch.prior=residual", "arch.relative=true"]])
def test_exported(tmp_path: Path, extra: list[str]) -> None:
    model = fake_model.write_model(tmp_path / "model", "arch.output=vector", "arch.window=3", *extra)
    predictor = load_predictor(model)
    assert examples(predictor.card, 2)[0].shape == (2, 6, 32, 32)
    assert export(predictor, tmp_path / "net.pt", "torchscript") < 1e-4
    said = json.loads((tmp_path / "net.pt.json").read_text())["preprocessing"]
    assert any("holds 3 frames of 2 components" in line for line in said)
    assert export(predictor, tmp_path / "net.onnx", "onnx") < 1e-4


@pytest.mark.slow
def test_trained_and_scored(clips: list[Clip], tmp_path: Path) -> None:
    train(clips, nested(clips, 3, 0, seed=0), small(), tmp_path / "model")
    predictor = load_predictor(tmp_path / "model")
    assert predictor.card.settings.arch.window == 3
    found = evaluate(predictor, clips[:2], "ideal")
    # What follows a sequence's frames has no part in what is said of them.
    cut = dataclasses.replace(
        clips[0],
        displacement={"ideal": np.asarray(clips[0].displacement["ideal"])[:3]},
        density=np.asarray(clips[0].density)[:3],
        force=clips[0].force[:3],
        confidence=np.asarray(clips[0].confidence)[:3],
    )
    np.testing.assert_allclose(
        evaluate(predictor, [cut], "ideal").clips[0].said_mn, found.clips[0].said_mn[:3], rtol=1e-4, atol=1e-5
    )


def test_which_windows_there_are() -> None:
    with pytest.raises(UserError, match=r"arch\.window"):
        override(preset("tiny"), ["arch.window=2"])
    assert Architecture(window=5, depth=True, confidence=True).inputs == 8 + 12
