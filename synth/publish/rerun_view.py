"""A sequence as a recording for the viewer rerun: frames, depth, flows, traction, force. Extra `view`."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from synth.checks import optics, stereo
from synth.dataset.attributes import name_gestures
from synth.dataset.store import Sequence
from synth.errors import UserError
from synth.publish import picture
from synth.render.camera.camera import between

_JPEG_QUALITY = 90


def save_recording(sequence: Sequence, path: Path) -> None:
    """Writes a sequence as a rerun recording. UserError: no rerun installed, or the file can't be written."""
    try:
        import rerun
    except ImportError:
        raise UserError("viewing needs the extra `view`: pip install '.[view]' in the clone") from None
    try:
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            part = Path(scratch) / "sequence.rrd"
            stream = rerun.RecordingStream("sulcus", recording_id=f"{sequence.index:06d}")
            stream.save(str(part))
            _log(rerun, stream, sequence)
            stream.disconnect()
            part.replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def _log(rerun: Any, stream: Any, sequence: Sequence) -> None:
    def image(name: str, pixels: picture.Rgb) -> None:
        stream.log(name, rerun.Image(pixels).compress(jpeg_quality=_JPEG_QUALITY))

    try:
        attrs, left = sequence.attrs, optics.camera_of(sequence)
        longest, strongest = attrs["summary"]["peak_flow_px"], attrs["summary"].get("peak_traction_kpa")
        young = "unknown" if attrs["young_kpa"] is None else f"{attrs['young_kpa']:.3g} kPa"
        bright = "" if strongest is None else f"\n\ntraction: brightest is {strongest:.3g} kPa\n"
        about = (
            f"# Sequence {sequence.index}\n\n{name_gestures(attrs)}, "
            f"E = {young}, {attrs['scale_mm_per_px']:.3g} mm/px\n\nflow: hue is direction; full colour is "
            f"{longest:.3g} px{bright}"
        )
    except (KeyError, TypeError) as error:
        raise UserError(f"{sequence.path}: has no attribute {error}, which the viewer needs") from error
    time, tissue = sequence["time"][:], sequence["tissue"][:]
    grey = picture.in_grey(sequence["rgb"][0])
    stream.log("/", rerun.ViewCoordinates.RDF, static=True)
    stream.log("camera", rerun.Pinhole(image_from_camera=left.K, resolution=left.size), static=True)
    if "right" in sequence.attrs:
        right = stereo.right_of(sequence)
        turn, shift = between(left, right)  # from the left camera; the viewer wants the way back
        pose = rerun.Transform3D(translation=-turn.T @ shift, mat3x3=turn.T)
        stream.log("right", pose, static=True)
        stream.log("right", rerun.Pinhole(image_from_camera=right.K, resolution=right.size), static=True)
    stream.log("force", rerun.SeriesLines(names=["x mN", "y mN", "z mN", "length mN"]), static=True)
    stream.log("about", rerun.TextDocument(about, media_type="text/markdown"), static=True)
    for t in range(sequence.frames):
        stream.set_time("frame", sequence=t)
        stream.set_time("time", duration=float(time[t]))
        image("camera/frame", sequence["rgb"][t])
        if "rgb_right" in sequence:
            image("right/frame", sequence["rgb_right"][t])
        if "depth" in sequence:
            # rerun shows it as a surface in space, by the pinhole above; the unit of length is mm.
            stream.log("camera/depth", rerun.DepthImage(sequence["depth"][t], meter=1.0))
        for name in {"flow", "flow_recovered"} & set(sequence.fields):
            colours = picture.flow_colours(sequence[name][t], longest)
            image(name, picture.overlay(grey, colours, 0.65 * tissue))
        if strongest is not None:
            load, force = np.linalg.norm(sequence["traction"][t], axis=-1), sequence["force"][t]
            image("traction", picture.overlay(grey, picture.heat(load, strongest), 0.8 * tissue))
            stream.log("force", rerun.Scalars([*force, float(np.linalg.norm(force))]))
