"""`bench flow` of a pair without a truth, and flow files that give back what was written."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import texture
from typer.testing import CliRunner

import bench.cli
from bench.flow import files
from synth.errors import UserError


def ask(*words: str) -> dict[str, float]:
    done = CliRunner().invoke(bench.cli.app, ["flow", *words, "--flow", "dis", "--json"])
    assert done.exit_code == 0, done.output
    found: dict[str, float] = json.loads(done.stdout)
    return found


def test_motion_is_said_without_a_truth_and_the_flow_written(tmp_path: Path) -> None:
    rest = texture(96, 128)
    for name, by in (("rest", 0), ("moved", 3)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.roll(rest, by, axis=1))
    pair = [str(tmp_path / "rest.png"), str(tmp_path / "moved.png")]
    for suffix in (".flo", ".npz"):
        out = tmp_path / f"flow{suffix}"
        found = ask(*pair, "--out", str(out))
        assert found["mean_px"] == pytest.approx(3.0, abs=0.3)
        assert 0 < found["confidence"] <= 1
        assert "epe" not in found
        assert np.median(files.read_flow(out)[0][..., 0]) == pytest.approx(3.0, abs=0.1)
        # What was written is a truth that it agrees with.
        assert ask(*pair, str(out))["epe"] < 1e-3
    with np.load(tmp_path / "flow.npz") as file:
        assert file["confidence"].shape == (96, 128)


def test_what_is_not_known_stays_unknown(tmp_path: Path) -> None:
    flow = np.random.default_rng(0).normal(size=(5, 7, 2)).astype(np.float32)
    known = np.ones((5, 7), bool)
    known[2, 3] = False
    files.write_flow(tmp_path / "a.npz", flow, known)
    read, where = files.read_flow(tmp_path / "a.npz")
    assert (where == known).all()
    assert read[known] == pytest.approx(flow[known])
    np.savez(tmp_path / "b.npz", other=flow)
    with pytest.raises(UserError, match="no array named flow"):
        files.read_flow(tmp_path / "b.npz")
