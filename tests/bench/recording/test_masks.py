"""Masks of a recording: by frame, one for all, from another folder, and the part that is looked at."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import Bump, Maker

from bench.recording.check import check_recording
from bench.recording.folder import open_recording
from bench.tracking.tracking import picture_masks, track_recording
from learn.inference.mask_files import read_choice
from learn.inference.video_flow import Settings
from synth.errors import UserError

_SIZE = (96, 128)


def _write(path: Path, left: int) -> None:
    path.parent.mkdir(exist_ok=True)
    mask = np.zeros(_SIZE, np.uint8)
    mask[:, :left] = 255
    assert cv2.imwrite(str(path), mask)


def test_one_mask_serves_all_frames_that_have_none(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=4)
    _write(folder / "mask.png", 10)
    _write(folder / "masks" / "000002.png", 30)
    opened = open_recording(folder)
    widths = [int(found[0].sum()) for k in range(4) if (found := opened.tool(k, _SIZE)) is not None]
    assert widths == [10, 10, 30, 10]
    assert opened.has_masks


def test_masks_of_another_folder_take_the_place_of_the_recordings_own(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=4)
    _write(folder / "mask.png", 10)
    _write(tmp_path / "drawn" / "mask.png", 50)
    kind, files = read_choice(str(tmp_path / "drawn"))
    assert kind == "auto"
    assert files is not None
    found = open_recording(folder).with_masks(files).tool(3, _SIZE)
    assert found is not None
    assert found[0].sum() == 50
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"mask\.png"):
        read_choice(str(tmp_path / "empty"))
    assert read_choice("glare") == ("glare", None)


def test_only_the_region_is_tissue(tmp_path: Path) -> None:
    opened = replace(open_recording(Maker(tmp_path)(frames=2)), region=(20, 10, 40, 30))
    tissue = opened.tissue_mask(_SIZE)
    assert tissue.sum() == 40 * 30
    assert tissue[10:40, 20:60].all()


def test_given_mask_is_masked_and_pictured(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=4)
    _write(folder / "mask.png", 32)
    found = track_recording(open_recording(folder), {"bump": Bump()}, 0.2, Settings())
    assert found.account.shares["masked"] == pytest.approx(0.25, abs=0.05)
    assert found.trusted == [True] * 4
    picture = picture_masks(found)
    assert picture is not None
    assert found.rest is not None
    assert np.abs(picture.astype(int) - found.rest)[:, 40:].mean() < 1
    assert np.abs(picture.astype(int) - found.rest)[:, :30].mean() > 20


def test_masks_none_masks_nothing_and_an_unknown_word_is_said(tmp_path: Path) -> None:
    opened = open_recording(Maker(tmp_path)(frames=3))
    found = track_recording(opened, {"bump": Bump()}, 0.2, Settings(masks="none"))
    assert found.account.shares["masked"] == 0
    assert picture_masks(found) is None
    with pytest.raises(UserError, match="auto, glare, tool"):
        track_recording(opened, {"bump": Bump()}, 0.2, Settings(masks="some"))


def test_check_says_what_is_masked_and_lost(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=12)
    (said,) = [one for one in check_recording(folder) if one.what == "following"]
    assert said.state == "ok"
    assert "0 of 11 frames" in said.said
    for name in sorted((folder / "frames").glob("*.png"))[4:]:
        assert cv2.imwrite(str(name), np.zeros((*_SIZE, 3), np.uint8))
    (said,) = [one for one in check_recording(folder) if one.what == "following"]
    assert said.state == "odd"
    assert "8 of 11 frames" in said.said
