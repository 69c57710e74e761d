"""Export of a sealed sequence as a recording folder, to be scored like a real recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.recording import recording_writer
from synth.arguments import checked
from synth.arrays import Floats
from synth.checks import optics, stereo_checks
from synth.dataset.dataset_folder import read_relaxation
from synth.dataset.store import Sequence
from synth.errors import UserError
from synth.system import checked_file

_PAIR = "stereo.yaml"


@checked
def export_recording(sequence: Sequence, folder: str | Path, instrument: int | None = None) -> Path:
    """Writes one recording: frames, times, force in camera axes, tool masks, tissue, meta.yaml.

    A stereo sequence adds the right camera and the calibration. Ground truth that a real recording lacks is
    not written: no true flow, no traction, no glare mask.

    `instrument`: number, from 1, of the one that the sensor is on; None: all. Raises UserError if the folder
    exists, or there is no such instrument.
    """
    force = force_of(sequence, instrument)
    time = np.asarray(sequence["time"][:], np.float64)
    meta_keys: dict[str, object] = {
        "scale_mm_per_px": float(sequence.attrs["scale_mm_per_px"]),
        "scale_uncertainty": 0.0,
        "young_kpa": float(sequence.attrs["young_kpa"]),
        "rest_frame": 0,
        "tissue": "brain" if (sequence.attrs.get("scenario") or {}).get("pulse") else "ex-vivo",
        "specimen": f"anatomy {sequence.attrs.get('anatomy_id', sequence.index)}",
        "sensor": {"axes": "camera", "acts_on": "tissue", "low_pass_hz": None},
    }
    if relaxation := read_relaxation(sequence.path):
        meta_keys["relaxation"] = [list(term) for term in relaxation]
    with checked_file.folder_of(Path(folder)) as part:
        (part / "masks").mkdir()
        _write_pictures(sequence, "rgb", part / "frames")
        for t in range(sequence.frames):
            tool = np.asarray(sequence["tool"][t], bool)
            if tool.any():
                checked_file.write_picture(part / "masks" / f"{t:06d}.png", tool.astype(np.uint8) * 255)
        tissue = np.asarray(sequence["tissue"][:], bool)
        checked_file.write_picture(part / "tissue.png", tissue.astype(np.uint8) * 255)
        recording_writer.write_force(part, time, force / 1000)
        recording_writer.write_frames(part, time)
        if "rgb_right" in sequence:
            _write_pictures(sequence, "rgb_right", part / "right")
            recording_writer.write_pair(
                part / _PAIR, optics.camera_of(sequence), stereo_checks.right_of(sequence)
            )
            meta_keys["stereo"] = {"calibration": _PAIR}
        recording_writer.write_meta(part, meta_keys)
    return Path(folder)


def force_of(sequence: Sequence, instrument: int | None) -> Floats:
    """Force (T, 3) mN, camera axes, of one instrument (from 1) or of all. UserError if there is none."""
    if instrument is None:
        return np.asarray(sequence["force"][:], np.float64)
    instruments = (sequence.attrs.get("mechanics") or {}).get("instruments", [])
    if instrument not in range(1, len(instruments) + 1):
        extent = f"has instruments 1 to {len(instruments)}" if instruments else "has no instrument"
        raise UserError(f"instrument {instrument}: sequence {sequence.index} {extent}")
    return np.asarray(instruments[instrument - 1]["force_mn"], np.float64)


def _write_pictures(sequence: Sequence, field: str, folder: Path) -> None:
    """Writes a camera's pictures into a new folder."""
    folder.mkdir()
    for t in range(sequence.frames):
        checked_file.write_picture(folder / f"{t:06d}.png", np.asarray(sequence[field][t], np.uint8))
