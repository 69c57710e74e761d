"""Flow on rendered tissue against warped photographs, and the gallery: their parts, without a renderer."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import pytest

from evidence.flow import look
from evidence.render import gallery
from synth.job.schema import Family
from synth.render import instrument


def picture(size: int = 96) -> np.ndarray:
    noise = np.random.default_rng(1).uniform(0, 255, (size, size, 3))
    return np.clip(128 + 6 * (cv2.GaussianBlur(noise, (0, 0), 3) - 128), 0, 255).astype(np.uint8)


def test_a_warped_picture_has_moved_by_the_flow() -> None:
    flow = np.zeros((96, 96, 2), np.float32)
    flow[..., 0], flow[..., 1] = 3, -2
    pair = look._warped(picture(), flow, 0.0, np.random.default_rng(0))
    off = pair.now[10:-14, 14:-10].astype(float) - pair.rest[12:-12, 11:-13]
    assert np.abs(off).mean() < 3, "noise of 1.5 grey levels on either"
    assert np.abs(pair.now.astype(float) - pair.rest).mean() > 6
    assert np.ptp(pair.rest.mean(axis=2)) > 60


def test_as_large_a_share_of_it_is_under_highlights() -> None:
    flow = np.zeros((96, 96, 2), np.float32)
    pair = look._warped(picture(), flow, 0.1, np.random.default_rng(0))
    assert 0.08 < pair.glare.mean() < 0.25
    assert not (pair.now_usable & pair.glare).any()


def test_the_window_lies_on_tissue_where_most_moves() -> None:
    tissue = np.zeros((120, 160), bool)
    tissue[10:110, 20:140] = True
    flow = np.zeros((120, 160, 2), np.float32)
    flow[30:50, 100:130, 0] = 5
    rows, columns = look._window(tissue, flow, 64)
    assert tissue[rows, columns].all()
    assert tissue[rows, columns].shape == (64, 64)
    assert np.linalg.norm(flow[rows, columns], axis=-1).sum() == pytest.approx(5 * 20 * 30)
    assert tissue[look._somewhere(tissue, 64, np.random.default_rng(3))].all()


def test_what_is_alike_has_a_ratio_of_one_and_what_is_not_is_said() -> None:
    same = [[0.1, 0.3, 0.02], [0.2, 0.5, 0.04], [0.15, 0.4, 0.03]]
    worse = [[1.5 * value for value in row] for row in same]
    row = look._ratio("a", "b", {"a": same, "b": same})
    assert row["mean_px"] == [1.0, 1.0, 1.0]
    assert row["lost_within_20_percent"]
    kept = [[*row[:2], 0.0001] for row in same]
    assert look._ratio("a", "b", {"a": kept, "b": kept})["lost"] is None
    assert look._ratio("a", "b", {"a": same, "b": kept})["lost_within_20_percent"] is False
    row = look._ratio("a", "b", {"a": worse, "b": same})
    assert row["p95_px"] == [1.5, 1.5, 1.5]
    assert not row["p95_px_within_20_percent"]


def test_the_gallery_has_every_family_instrument_light_and_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    def tile(settings: object, kind: str, size: tuple[int, int], seed: int, caption: str) -> np.ndarray:
        said.append(caption)
        return np.full((size[1] + 15, size[0], 3), 90, np.uint8)

    monkeypatch.setattr(gallery, "_tile", tile)
    found = gallery.gallery(width=64, out=tmp_path)
    assert found["tiles"] == len(said) == len(set(said)) == 5 * 5 + 4 * 4 + 4
    for name in (*get_args(Family), *get_args(instrument.Kind), *gallery._LIGHTS, *gallery._CAMERAS):
        assert any(name in caption for caption in said), name
    page = (tmp_path / "gallery.md").read_text()
    for file in found["bytes"]:
        assert f"({file})" in page
        assert cv2.imread(str(tmp_path / file)) is not None


def test_every_instrument_has_a_hand_that_takes_it() -> None:
    for kind, gesture in gallery._GESTURES.items():
        seed = gallery._seed_of(kind, gesture)
        assert instrument.choose([gesture], np.random.default_rng([seed, 2])) == (kind,)
