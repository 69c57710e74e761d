"""Motion in three dimensions as a network's input: what a second eye's models read."""

from __future__ import annotations

import json
from dataclasses import replace as replace_
from pathlib import Path
from typing import get_args

import numpy as np
import phantom
import pytest
import torch
from typer.testing import CliRunner

from learn.checkpoint import read_model
from learn.cli import app
from learn.data import clips as reading
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid, Scales, channels
from learn.inference.export import export
from learn.inference.predict import load_model
from learn.settings import TrainingSettings, preset, replace
from learn.split import divide
from learn.training.batches import UNTOLD, FrameDataset, FrameItem, inputs
from learn.training.gpu_batches import DeviceDataset
from learn.training.train import train
from synth.job.types import MembraneState

run = CliRunner().invoke
SCALES = Scales(0.5, 0.02, 0.3, 12.5, 0.07)


def small(**changes: object) -> TrainingSettings:
    base = preset("stereo")
    return replace(
        base, size=32, epochs=4, arch=replace(base.arch, levels=2, stem=2, membrane=True), **changes
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eyes")
    for index in range(8):
        phantom.write(folder, index, anatomy_seed=index, stereo=True)
    return folder


@pytest.fixture(scope="module")
def told(data: Path) -> list[Clip]:
    return load_clips(data, Grid(32), ("motion-ideal", "motion"))


@pytest.fixture(scope="module")
def model(told: list[Clip], data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train(*divide(told, [data], seed=0), small(), out)
    return out


def test_motion_comes_onto_the_grid_in_millimetres_with_its_confidence(told: list[Clip]) -> None:
    clip = told[0]
    true, found = clip.displacement["motion-ideal"], clip.displacement["motion"]
    assert true.shape == (6, 3, 32, 32)
    inside = clip.mask > 0
    assert true[3, 2, inside].std() > 0.002
    assert 0.002 < (found - true)[:, :, inside].std() < 0.02, "0.02 mm of noise a pixel, over a cell's"
    sure = clip.sure("motion")
    assert sure[:, 0, inside].min() == pytest.approx(1 / (1 + 0.25), rel=1e-3)
    assert sure[:, 1, inside].max() == pytest.approx(0.5, rel=1e-3)
    assert (clip.sure("motion-ideal") == 1).all()
    assert clip.sure("motion-ideal").shape == sure.shape


def test_channels_of_two_eyes_are_those_of_one_and_two_more() -> None:
    moved, sure, mask = torch.randn(2, 3, 32, 32), torch.rand(2, 2, 32, 32), torch.ones(2, 1, 32, 32)
    two = channels(moved, mask, 1.0, SCALES, sure)
    assert torch.equal(two[:, :6], channels(moved[:, :2], mask, 1.0, SCALES, sure[:, :1]))
    assert torch.equal(two[:, 6:], torch.stack([moved[:, 2] / SCALES.displacement_mm, sure[:, 1]], dim=1))


def test_a_membrane_is_told_in_two_of_three_frames_and_turns_the_answer(
    told: list[Clip], model: Path
) -> None:
    frames = FrameDataset(told, replace(small(), frames=0))
    drawn = [item.told for k in range(9) for item in frames.order(np.random.default_rng(k), 1.0)]
    assert np.mean(drawn) == pytest.approx(1 - UNTOLD, abs=4 * (2 / 9 / len(drawn)) ** 0.5)
    codes, mask = torch.tensor([-1.0, 0.0, 1.0]), torch.ones(3, 1, 32, 32)
    x = channels(torch.randn(3, 3, 32, 32), mask, 1.0, SCALES, torch.rand(3, 2, 32, 32), codes)
    net = read_model(model)[0]
    assert torch.equal(x[:, -1], codes[:, None, None] * mask[:, 0])
    assert torch.equal(net.per_motion(x, torch.full((3, 1, 1, 1), 0.5))[:, -1], x[:, -1])
    predictor, moved = load_model(model), np.array(told[0].displacement["motion"])
    answers = [predictor.density(moved, told[0].mask, 1.0, membrane=one) for one in get_args(MembraneState)]
    assert np.array_equal(answers[1], predictor.density(moved, told[0].mask, 1.0))
    assert np.abs(answers[2] - answers[0]).max() > 0


def test_depth_stays_when_the_picture_turns(told: list[Clip]) -> None:
    frames = FrameDataset(told, small())
    still = frames.batch([FrameItem(0, 3, "motion")])
    for turn in range(8):
        turned = frames.batch([FrameItem(0, 3, "motion", turn)])
        for name in ("displacement", "confidence", "target"):
            sizes = [getattr(one, name)[:, -1].flatten().sort().values for one in (still, turned)]
            assert torch.equal(*sizes), (turn, name)
        # Both confidences are numbers, not a vector's components.
        assert torch.equal(
            turned.confidence.flatten(2).sort().values, still.confidence.flatten(2).sort().values
        )


def test_frames_held_by_a_device_are_those_read_one_by_one(told: list[Clip], tmp_path: Path) -> None:
    settings = small()
    for k, clip in enumerate(told[:2]):
        reading.pack(clip, tmp_path / str(k))  # what was packed is what was read
    some = [reading.unpack(tmp_path / "0"), reading.unpack(tmp_path / "1"), *told[2:]]
    some[3] = told[3] = replace_(told[3], membrane="intact")
    items = [
        FrameItem(c, t, s, c, t == 4) for c in range(8) for t in (1, 4) for s in ("motion", "motion-ideal")
    ]
    read, held = FrameDataset(told, settings), DeviceDataset(some, settings, torch.device("cpu"))
    for item in items:
        one, other = read.batch([item]), held.batch([item])
        for name in one._fields:
            assert torch.equal(getattr(one, name), getattr(other, name)), (item, name)
    assert inputs(read.batch(items), settings, SCALES).shape[1] == 9
    assert read.batch([FrameItem(3, 4, "motion", 0, known) for known in (True, False)]).membrane.tolist() == [
        1,
        0,
    ]


@pytest.mark.slow
def test_predict_eval_and_export(model: Path, data: Path, tmp_path: Path) -> None:
    said = run(app, ["predict", str(model), str(data), "-o", str(tmp_path / "f"), "--json"])
    assert said.exit_code == 0, said.output
    stored = np.load(tmp_path / "f/000000.npz")
    assert stored["force_mn"].shape == (6, 3)
    scored = run(app, ["eval", str(model), str(data), "--all", "--json"])
    assert scored.exit_code == 0, scored.output
    assert json.loads(scored.stdout)["input"] == "motion"
    assert run(app, ["eval", str(model), str(data), "--all", "--input", "recovered"]).exit_code != 0
    assert export(load_model(model), tmp_path / "net.onnx") < 1e-4
    about = json.loads((tmp_path / "net.onnx.json").read_text())
    assert "stereo" in about["preprocessing"][0]
