"""Tissue that a recording does not state: found, given to the methods, and shown."""

import cv2
import numpy as np
from fake_recording import Maker

from bench.methods.protocol import ForceEstimate, FrameMotion, MethodContext
from bench.recording.folder import open_recording
from bench.tracking.tracking import picture_masks, track_recording
from tests.synth.recording_flow.test_camera_motion import OPENING
from tests.synth.recording_flow.test_find_tissue import RIM, SETTINGS, video


def test_methods_get_the_tissue_that_is_found(make: Maker) -> None:
    folder, contexts = make(frames=12, size=OPENING.shape), list[MethodContext]()
    files = sorted((folder / "frames").iterdir())
    for path, one in zip(files, video(OPENING, RIM, 4).pictures(), strict=True):
        assert cv2.imwrite(str(path), one.rgb[..., ::-1])

    def method(frame: FrameMotion, scene: MethodContext, picture: bool) -> ForceEstimate:
        contexts.append(scene)
        return ForceEstimate(np.zeros(3))

    found = track_recording(open_recording(folder), {"own": method}, 0.2, SETTINGS)
    tissue = contexts[-1].tissue
    assert (tissue & OPENING).sum() / (tissue | OPENING).sum() > 0.9
    assert ("missing", "tissue") in [(one.severity, one.cause) for one in found.findings]
    assert picture_masks(found) is not None  # shows its outline
