"""Masks of a recording: by frame, one for all, the tracked region, tissue that is found."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_recording import Bump, Maker

from bench.methods.method_interface import ForceEstimate, FrameMotion, MethodContext
from bench.recording.propose_tissue import propose_tissue
from bench.recording.recording_folder import open_recording
from bench.tracking.contact_free import ContactFreeSearch
from bench.tracking.tracking import picture_masks, track_recording
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.video.read_video import read_mask
from tests.synth.flow.recording.test_camera_motion import OPENING
from tests.synth.flow.recording.test_find_tissue import RIM, SETTINGS, video
from tests.synth.flow.recording.test_foreground import ROD, X, Y, load

_SIZE = (96, 128)


def _write(path: Path, left: int) -> None:
    path.parent.mkdir(exist_ok=True)
    mask = np.zeros(_SIZE, np.uint8)
    mask[:, :left] = 255
    assert cv2.imwrite(str(path), mask)


def test_mask_png_is_used_for_frames_without_a_mask(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=4)
    _write(folder / "mask.png", 10)
    _write(folder / "masks" / "000002.png", 30)
    recording = open_recording(folder)
    widths = [int(mask[0].sum()) for k in range(4) if (mask := recording.masks.read(k, _SIZE)) is not None]
    assert widths == [10, 10, 30, 10]


@pytest.mark.parametrize("kind", ["0 and 1", "alpha", "white", "soft", "16 bits"])
def test_masks_of_all_encodings_are_read(tmp_path: Path, kind: str) -> None:
    tool = np.zeros(_SIZE, np.uint8)
    tool[20:60, 30:90] = 1
    alpha = np.dstack([np.full((*_SIZE, 3), 255, np.uint8), 255 * tool])
    encodings = {"0 and 1": tool, "alpha": alpha, "white": 255 * tool, "16 bits": tool.astype(np.uint16)}
    encodings["soft"] = cv2.GaussianBlur(200 * tool, (0, 0), 1)
    assert cv2.imwrite(str(tmp_path / "m.png"), encodings[kind])
    assert np.sum(read_mask(tmp_path / "m.png", _SIZE) != tool) < 8


def test_only_the_region_is_tissue(tmp_path: Path) -> None:
    recording = replace(open_recording(Maker(tmp_path)(frames=2)), region=(20, 10, 40, 30))
    tissue = recording.tissue_mask(_SIZE)
    assert tissue.sum() == 40 * 30
    assert tissue[10:40, 20:60].all()


def test_given_mask_is_masked_and_pictured(tmp_path: Path) -> None:
    folder = Maker(tmp_path)(frames=4)
    _write(folder / "mask.png", 32)
    tracked = track_recording(open_recording(folder), {"bump": Bump()}, 0.2, RecordingFlowSettings())
    assert tracked.summary.shares["masked"] == pytest.approx(0.25, abs=0.05)
    assert tracked.trusted == [True] * 4
    picture = picture_masks(tracked)
    assert np.abs(picture.astype(int) - tracked.rest)[:, 40:].mean() < 1
    assert np.abs(picture.astype(int) - tracked.rest)[:, :30].mean() > 20


def test_methods_get_the_tissue_that_is_found(make: Maker) -> None:
    folder, contexts = make(frames=12, size=OPENING.shape), list[MethodContext]()
    files = sorted((folder / "frames").iterdir())
    for path, source_picture in zip(files, video(OPENING, RIM, 4, 0).pictures(), strict=True):
        assert cv2.imwrite(str(path), source_picture.rgb[..., ::-1])

    def method(frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        contexts.append(scene)
        return ForceEstimate(np.zeros(3))

    tracked = track_recording(open_recording(folder), {"own": method}, 0.2, SETTINGS)
    tissue = contexts[-1].tissue
    assert (tissue & OPENING).sum() / (tissue | OPENING).sum() > 0.9
    assert ("missing", "tissue") in [(finding.severity, finding.cause) for finding in tracked.findings]
    assert picture_masks(tracked) is not None  # shows its outline


def test_a_tissue_is_proposed_and_never_written_over(make: Maker) -> None:
    folder = make(frames=12, size=OPENING.shape)
    files = sorted((folder / "frames").iterdir())
    for path, picture in zip(files, video(OPENING, RIM, 4, 0).pictures(), strict=True):
        assert cv2.imwrite(str(path), picture.rgb[..., ::-1])
    mask, overlay, doubt = propose_tissue(folder)
    tissue = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) > 0
    assert (tissue & OPENING).sum() / (tissue | OPENING).sum() > 0.9
    assert overlay.is_file()
    assert doubt == ""
    with pytest.raises(UserError, match="exists"):
        propose_tissue(folder)


@pytest.mark.parametrize("visible_frames", [range(6, 14), range(9, 14), range(20), range(0)])
def test_no_contact_is_where_an_instrument_is_away_and_motion_is_smooth(visible_frames: range) -> None:
    """It presses in frames 6 to 13 of a breath; in three of these cases its mask shows less, or more."""
    search = ContactFreeSearch(np.ones(ROD.shape, bool), 0.2)
    for k in range(20):
        breath = np.float32(np.sin(k)) * np.dstack([1 + X / 80, X * Y / 4000])
        flow, confidence = breath + load(2.0 * (k in range(6, 14))), np.ones(ROD.shape, np.float32)
        search.add(FrameMotion(flow, confidence, tool=ROD & (k in visible_frames)), k / 4)
    assert list(search.find()) == ([(0.0, 1.25), (3.5, 4.75)] if visible_frames == range(6, 14) else [])
