"""Pictures that show nothing get a word for it, and no 0.0 mN."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_model import write_model
from fake_recording import Bump, Maker, texture
from typer.testing import CliRunner

import learn.cli
from bench.recording import check, pixel_scale, writer
from bench.recording.folder import open_recording
from bench.scoring import evaluate_recording
from bench.scoring.evaluate_recording import Result, Settings
from bench.scoring.headline import headline

BLACK = np.zeros((96, 128, 3), np.uint8)


def spoilt(make: Maker, pictures: list[np.ndarray]) -> Path:
    folder = make(frames=len(pictures))
    for k, rgb in enumerate(pictures):
        cv2.imwrite(str(folder / "frames" / f"{k:04d}.png"), rgb)
    return folder


def run(folder: Path) -> Result:
    recording = open_recording(folder)
    found = pixel_scale.find_scale(recording.meta, folder)
    return evaluate_recording.evaluate_recording(
        recording, {"bump": Bump()}, "bump", found, Settings("dis", shrink=1, rate_hz=None), {}
    )


@pytest.mark.parametrize(
    ("picture", "said"),
    [
        (BLACK + 3, "the rest frame is black"),
        (BLACK + 128, "the rest frame is of one colour"),
        (texture(16, 16), "the rest frame is only 16 x 16 px large"),
        (texture(96, 128), "the picture never changes"),
    ],
)
def test_nothing_to_measure_is_said_and_no_number_given(make: Maker, picture: np.ndarray, said: str) -> None:
    folder = spoilt(make, [picture] * 4)
    result = run(folder)
    assert result.lost.all()
    assert np.isnan(result.methods["bump"].size_mn).all()
    assert headline(result).refused.startswith(f"Nothing can be measured: {said}")
    assert any(said in note for note in result.notes)
    findings = [f.said for f in check.check_recording(folder) if f.state == "bad"]
    assert ("never" in said) or any(said in line for line in findings)


def test_tissue_of_a_few_pixels_is_said(make: Maker) -> None:
    folder = make(frames=4)
    tissue = np.zeros((96, 128), np.uint8)
    tissue[:10, :10] = 255
    cv2.imwrite(str(folder / "tissue.png"), tissue)
    assert "only 100 px of it are tissue" in headline(run(folder)).refused


def test_a_frame_that_went_black_is_lost_alone(make: Maker) -> None:
    folder = make(frames=8)
    cv2.imwrite(str(folder / "frames" / "0004.png"), BLACK)
    result = run(folder)
    assert np.flatnonzero(result.lost).tolist() == [4]
    assert headline(result).refused == ""


@pytest.mark.slow
def test_learn_predict_says_so_too(tmp_path: Path) -> None:
    writer.write_video(tmp_path / "black.mp4", iter([BLACK] * 5), np.arange(5) / 10)
    model = write_model(tmp_path / "model")
    words = [
        "predict",
        str(model),
        str(tmp_path / "black.mp4"),
        "--scale",
        "0.2",
        "-o",
        str(tmp_path / "out"),
    ]
    done = CliRunner().invoke(learn.cli.app, [*words, "--flow", "dis", "--json"])
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["peak_force_mn"] == {"black": None}
    with np.load(tmp_path / "out" / "black.npz") as found:
        assert np.isnan(found["total_force_mn"]).all()
        assert "nothing can be measured: the rest frame is black" in found["notes"].tolist()
