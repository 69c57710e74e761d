"""Stereo motion as a network's input."""

import itertools
import json
from dataclasses import replace as replace_
from pathlib import Path
from typing import get_args

import numpy as np
import phantom
import pytest
import torch
from command import run

from learn.checkpoint import read_model
from learn.cli import app
from learn.data import clips as reading
from learn.data.clips import Clip, load_clips
from learn.data.grid import Grid, Scales
from learn.inference.export import export
from learn.inference.predict import load_model
from learn.network.channels import channels
from learn.settings import TrainingSettings, preset, replace
from learn.split import divide
from learn.training.batches import MEMBRANE_HIDDEN, FrameDataset, FrameItem, inputs
from learn.training.train import train
from synth.job.types import MembraneState

SCALES = Scales(0.5, 0.02, 0.3, 12.5, 0.07)


def small() -> TrainingSettings:
    base = preset("stereo")
    return replace(base, size=32, epochs=4, arch=replace(base.arch, levels=2, stem=2, membrane=True))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stereo")
    for index in range(8):
        phantom.write(folder, index, anatomy_seed=index, stereo=True)
    return folder


@pytest.fixture(scope="module")
def stereo(data: Path) -> list[Clip]:
    return load_clips(data, Grid(32), ("motion-ideal", "motion"))


@pytest.fixture(scope="module")
def model(stereo: list[Clip], data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "model"
    train(*divide(stereo, [data], seed=0), small(), out)
    return out


def test_motion_on_the_grid_is_in_mm_and_has_its_confidence(stereo: list[Clip]) -> None:
    clip = stereo[0]
    true, recovered = clip.displacement["motion-ideal"], clip.displacement["motion"]
    assert true.shape == (6, 3, 32, 32)
    inside = clip.mask > 0
    assert true[3, 2, inside].std() > 0.002
    assert 0.002 < (recovered - true)[:, :, inside].std() < 0.02, "0.02 mm of noise a pixel, over a cell's"
    confidence = clip.confidence_of("motion")
    assert confidence[:, 0, inside].min() == pytest.approx(1 / (1 + 0.25), rel=1e-3)
    assert confidence[:, 1, inside].max() == pytest.approx(0.5, rel=1e-3)
    np.testing.assert_array_equal(clip.confidence_of("motion-ideal"), np.ones_like(confidence))


def test_stereo_has_the_monocular_channels_and_two_more() -> None:
    motion, weight, mask = torch.randn(2, 3, 32, 32), torch.rand(2, 2, 32, 32), torch.ones(2, 1, 32, 32)
    planes = channels(motion, mask, 1.0, SCALES, weight)
    assert torch.equal(planes[:, :6], channels(motion[:, :2], mask, 1.0, SCALES, weight[:, :1]))
    assert torch.equal(
        planes[:, 6:], torch.stack([motion[:, 2] / SCALES.displacement_mm, weight[:, 1]], dim=1)
    )


def test_the_membrane_is_known_in_two_of_three_frames_and_changes_the_estimate(
    stereo: list[Clip], model: Path
) -> None:
    frames = FrameDataset(stereo, replace(small(), frames=0))
    is_known = [item.membrane_known for k in range(9) for item in frames.order(np.random.default_rng(k))]
    assert np.mean(is_known) == pytest.approx(1 - MEMBRANE_HIDDEN, abs=4 * (2 / 9 / len(is_known)) ** 0.5)
    codes, mask = torch.tensor([-1.0, 0.0, 1.0]), torch.ones(3, 1, 32, 32)
    x = channels(torch.randn(3, 3, 32, 32), mask, 1.0, SCALES, torch.rand(3, 2, 32, 32), codes)
    net = read_model(model)[0]
    assert torch.equal(x[:, -1], codes[:, None, None] * mask[:, 0])
    assert torch.equal(net.per_motion(x, torch.full((3, 1, 1, 1), 0.5))[:, -1], x[:, -1])
    predictor, motion = load_model(model), np.array(stereo[0].displacement["motion"])
    answers = [
        predictor.density(motion, stereo[0].mask, 1.0, membrane=state) for state in get_args(MembraneState)
    ]
    assert np.array_equal(answers[1], predictor.density(motion, stereo[0].mask, 1.0))
    assert np.abs(answers[2] - answers[0]).max() > 0


def test_turning_leaves_depth_unchanged(stereo: list[Clip]) -> None:
    frames = FrameDataset(stereo, small())
    still = frames.batch([FrameItem(0, 3, "motion")])
    for turn in range(8):
        turned = frames.batch([FrameItem(0, 3, "motion", turn)])
        for name in ("displacement", "confidence", "target"):
            sizes = [getattr(batch, name)[:, -1].flatten().sort().values for batch in (still, turned)]
            assert torch.equal(*sizes), (turn, name)
        # Both confidences are numbers, not a vector's components.
        sizes = [batch.confidence.flatten(2).sort().values for batch in (still, turned)]
        assert torch.equal(*sizes), turn


def test_batches_of_packed_clips_and_of_stored_frames_are_equal(stereo: list[Clip], tmp_path: Path) -> None:
    settings = small()
    for k, clip in enumerate(stereo[:2]):
        reading.pack(clip, tmp_path / str(k))  # packed clips are equal to read ones
    packed = [reading.unpack(tmp_path / "0"), reading.unpack(tmp_path / "1"), *stereo[2:]]
    packed[3] = stereo[3] = replace_(stereo[3], membrane="intact")
    combinations = itertools.product(range(8), (1, 4), ("motion", "motion-ideal"))
    items = [FrameItem(c, t, source, c, t == 4) for c, t, source in combinations]
    read, stored = FrameDataset(stereo, settings), FrameDataset(packed, settings)
    stored._stores = True  # as on a GPU
    for item in 2 * items:
        read_batch, stored_batch = read.batch([item]), stored.batch([item])
        for name in read_batch._fields:
            assert torch.equal(getattr(read_batch, name), getattr(stored_batch, name)), (item, name)
    assert inputs(read.batch(items), settings, SCALES).shape[1] == 9
    membrane_items = [FrameItem(3, 4, "motion", 0, known) for known in (True, False)]
    assert read.batch(membrane_items).membrane.tolist() == [1, 0]


@pytest.mark.slow
def test_predict_eval_and_export(model: Path, data: Path, tmp_path: Path) -> None:
    run(app, "predict", model, data, "-o", tmp_path / "f")
    with np.load(tmp_path / "f/000000.npz") as prediction:
        assert prediction["force_mn"].shape == (6, 3)
    assert json.loads(run(app, "eval", model, data, "--all", "--json").stdout)["input"] == "motion"
    run(app, "eval", model, data, "--all", "--input", "recovered", code=2)
    assert export(model, tmp_path / "net.onnx") < 1e-4
