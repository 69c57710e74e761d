"""A proposal of a recording's tissue.png, to be edited: the tissue as it is found without one."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from bench.recording.footage import as_footage
from bench.recording.recording_folder import open_recording
from synth.errors import UserError
from synth.flow.recording.decode import RecordingFlowSettings
from synth.flow.recording.video_track import find_tissue
from synth.system.checked_file import write_picture

SHOWN = "tissue-on-rest-frame.png"
_OUTLINE = (60, 230, 90)


def propose_tissue(folder: Path) -> tuple[Path, Path, str]:
    """Writes tissue.png and, to look at, its outline on the rest frame; returns both paths and any doubt.

    UserError: an unreadable recording, one that has a tissue.png, or a rest frame without anything to track.
    """
    recording = open_recording(folder)
    if recording.tissue is not None:
        raise UserError(f"{recording.tissue}: exists; edit it, or remove it for a new proposal")
    footage = as_footage(recording, 1.0)
    proposal = find_tissue(footage, RecordingFlowSettings())
    if proposal is None:
        raise UserError(f"{folder}: the rest frame shows nothing that can be tracked")
    rest = next(picture.rgb for picture in footage.pictures() if picture.index >= footage.rest_frame)
    mask = cv2.resize(proposal[0].astype(np.uint8) * 255, rest.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    edges = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]
    preview = cv2.drawContours(np.ascontiguousarray(rest), edges, -1, _OUTLINE, 2)
    paths = folder / "tissue.png", folder / SHOWN
    for path, picture in zip(paths, (mask, preview), strict=True):
        write_picture(path, np.asarray(picture, np.uint8))
    return *paths, proposal[1].message if proposal[1].severity in ("warning", "error") else ""
