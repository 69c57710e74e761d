"""Segmentation of instruments, highlights and foreground on pictures that it was not trained on."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from warped_cortex import Recipe, pairs

from synth.errors import UserError
from synth.flow import correction, onnx_network, segmentation
from synth.flow.segmentation import segment, with_highlights
from synth.flow.stereo import depth_correction
from weights.networks import CorrectionNet, SegmentationNet, write_onnx

Picture = NDArray[np.uint8]
ON_VESSEL = pytest.mark.xfail(strict=True, reason="it is taken for an instrument, and those are given")


def test_bundled_weights_are_small_and_those_of_their_card() -> None:
    onnx = pytest.importorskip("onnx")
    for file in (segmentation.WEIGHTS, correction.WEIGHTS, depth_correction.WEIGHTS):
        card = json.loads(file.with_suffix(".json").read_text())
        assert file.stat().st_size <= 1_500_000
        tensors = [
            tensor
            for tensor in onnx.load(file).graph.initializer
            if tensor.data_type == onnx.TensorProto.FLOAT16
        ]
        parameters = [
            tensor
            for tensor in tensors
            if tensor.dims and not re.search("running|^mean|^deviation", tensor.name)
        ]
        assert sum(int(np.prod(tensor.dims)) for tensor in parameters) == card["parameters"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of PyTorch's exporter
@pytest.mark.parametrize("net", [SegmentationNet(), CorrectionNet()], ids=["segmentation", "correction"])
def test_onnx_files_give_what_pytorch_gives_at_any_size(net: torch.nn.Module, tmp_path: Path) -> None:
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.randn(parameter.shape).half() * parameter[0].numel() ** -0.5)
    channels = 6 if isinstance(net, SegmentationNet) else correction.CHANNELS
    write_onnx(net, tmp_path / "net.onnx", channels)
    for size in ((64, 96), (128, 64)):
        planes = np.random.default_rng(1).normal(size=(channels, *size)).astype(np.float32)
        with torch.no_grad():
            expected = net.eval()(torch.from_numpy(planes)[None])[0].numpy()
        output = onnx_network.run(tmp_path / "net.onnx", planes)
        np.testing.assert_allclose(output, expected, atol=1e-4 * np.abs(expected).max())
    (tmp_path / "bad.onnx").write_bytes(b"no network")
    with pytest.raises(UserError):
        onnx_network.run(tmp_path / "bad.onnx", planes)


def tissue(height: int, width: int) -> Picture:
    """Pink tissue with a mottle and a dark vessel."""
    rng = np.random.default_rng(4)
    mottle = cv2.GaussianBlur(rng.normal(0, 1, (height, width)), (0, 0), 3)
    picture = np.array([200.0, 140, 120]) + 60 * mottle[..., None] * [1, 0.9, 0.7]
    cv2.line(picture, (0, height // 3), (width, height // 2), (120, 40, 50), height // 60, cv2.LINE_AA)
    sensed = cv2.GaussianBlur(picture, (0, 0), 0.7) + rng.normal(0, 1.5, picture.shape)
    return np.clip(sensed, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(240, 320), (190, 333), (480, 640)])
@pytest.mark.parametrize("grey", [60, 130, 200])
def test_a_rod_is_found_whole_and_bare_tissue_is_not_masked(size: tuple[int, int], grey: int) -> None:
    height, width = size
    rest = tissue(height, width)
    rod = np.zeros(size, np.uint8)
    cv2.line(rod, (width, height // 8), (width // 2, height // 2), 255, width // 16, cv2.LINE_AA)
    coverage = cv2.GaussianBlur(rod / 255, (0, 0), width / 500)[..., None]
    frame = np.clip(rest * (1 - coverage) + coverage * grey, 0, 255).astype(np.uint8)
    instrument, true_rod = segment(rest, frame).instrument > 0.5, coverage[..., 0] > 0.5
    assert instrument.shape == size
    assert np.count_nonzero(instrument & true_rod) > 0.5 * np.count_nonzero(instrument | true_rod)
    assert segment(rest, rest).hidden.mean() < 0.01


@pytest.mark.parametrize("centre", [(30, 100), (80, 40), (90, 120), pytest.param((50, 70), marks=ON_VESSEL)])
def test_highlights_join_given_instruments(centre: tuple[int, int]) -> None:
    rest = tissue(120, 160)
    squared_distance = np.square(np.indices((120, 160)) - np.reshape(centre, (2, 1, 1))).sum(0)
    wet_picture = np.clip(rest + 250 * np.exp(-squared_distance / (2 * 4.0**2))[..., None], 0, 255).astype(
        np.uint8
    )
    tool = np.stack([rest[..., 0] < 0, np.indices((120, 160))[1] < 20])
    masks = with_highlights(np.stack([rest, wet_picture]), tool)
    assert masks[1][centre]
    assert masks[1, :, :20].all()
    assert masks[1][~tool[1] & (squared_distance > 20**2)].mean() < 0.01


def test_a_forceps_is_found_on_warped_cortex() -> None:
    (pair,) = pairs(Recipe(highlights=0.0), 1, 2)
    hidden, tool = segment(pair.rest, pair.now).hidden, ~pair.now_usable
    assert hidden[tool].mean() > 0.8
    assert hidden[~tool].mean() < 0.1
