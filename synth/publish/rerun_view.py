"""A sequence on one timeline in the viewer rerun: surface, frame, flows, traction and force. Extra `view`."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.checks import optics
from synth.dataset.attributes import name_gestures
from synth.dataset.store import Sequence
from synth.errors import UserError
from synth.publish import picture

Floats = NDArray[np.float64]

_APPLICATION = "sulcus"
# Columns of the mesh that stands for the surface: what a viewer turns smoothly.
_MESH_COLUMNS = 200
_JPEG_QUALITY = 90


def save_recording(sequences: Iterable[Sequence], path: Path) -> None:
    """Writes sequences as a rerun recording file, one recording each.

    Raises:
        UserError: rerun is not installed, the file cannot be written.
    """
    rerun = _rerun()
    parts: list[Path] = []
    try:
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            for sequence in sequences:
                part = Path(scratch) / f"{sequence.index:06d}.rrd"
                stream = rerun.RecordingStream(_APPLICATION, recording_id=f"{sequence.index:06d}")
                stream.save(str(part))
                _log(rerun, stream, sequence)
                stream.disconnect()
                parts.append(part)
            if len(parts) > 1:
                joined = Path(scratch) / "all.rrd"
                words = [sys.executable, "-m", "rerun", "rrd", "merge", "-o", str(joined)]
                subprocess.run([*words, *(str(part) for part in parts)], check=True, capture_output=True)
                parts = [joined]
            parts[0].replace(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror})") from error


def show_sequences(sequences: Iterable[Sequence], *, web: bool) -> None:
    """Opens sequences in the viewer and returns when it is closed; it listens on this machine only.

    Args:
        sequences: what to show.
        web: in a browser, for a machine without a window system.

    Raises:
        UserError: rerun is not installed or cannot start.
    """
    _rerun()
    print("rerun sends its makers anonymous usage counts until `rerun analytics disable`", file=sys.stderr)
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "sequences.rrd"
        save_recording(sequences, path)
        # A group of its own: the viewer starts a process in its turn, which must not stay when this one ends.
        viewer = subprocess.Popen(command(path, web=web), start_new_session=True)
        try:
            code = viewer.wait()
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(viewer.pid, signal.SIGTERM)
            viewer.wait()
    if code:
        hint = "" if web else "; without a window system use --web, or --save and open the file elsewhere"
        raise UserError(f"the viewer ended with code {code}{hint}")


def command(path: Path, *, web: bool) -> list[str]:
    """The viewer's command line for a recording: bound to localhost."""
    words = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--port", "auto"]
    return [*words, *(("--serve-web",) if web else ()), str(path)]


def surface(sequence: Sequence, t: int, step: int) -> tuple[Floats, NDArray[np.int64]]:
    """The tissue in frame `t` as seen: (V, 3) mm in camera axes, and the triangles (F, 3) whose corners are.

    Every `step`-th rest pixel is a vertex, with its number in all frames; a vertex that is hidden in a frame
    lies at its place of rest and has no triangle.
    """
    view = optics.camera_of(sequence)
    rest = np.stack(np.meshgrid(*(np.arange(0, n, step) for n in sequence.size), indexing="ij"), axis=-1)
    rows, columns = rest.reshape(-1, 2).T
    width, height = view.size
    flow, depth = sequence["flow"][t][rows, columns], sequence["depth"][t]
    pixels = np.stack([columns, rows], axis=1).astype(np.float64) + flow
    near = np.clip(pixels.round().astype(int), 0, [width - 1, height - 1])
    seen = sequence["tissue"][:][rows, columns] & sequence["visible"][t][rows, columns]
    seen &= depth[near[:, 1], near[:, 0]] > 0
    points = (
        optics.rays(view, pixels)
        * np.where(seen, depth[near[:, 1], near[:, 0]], sequence["depth"][0][rows, columns])[:, None]
    )
    number = np.arange(len(rows)).reshape(rest.shape[:2])
    a, b, c, d = (
        part.ravel() for part in (number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    return points, faces[seen[faces].all(axis=1)]


def _log(rerun: Any, stream: Any, sequence: Sequence) -> None:
    attrs, (height, width) = sequence.attrs, sequence.size
    needed = ("K", "distortion", "rotation", "translation", "scale_mm_per_px", "young_kpa")
    lacking = [name for name in needed if sequence.attrs.get(name) is None]
    peaks = ("peak_flow_px", "peak_traction_kpa")
    lacking += [name for name in peaks if not isinstance(sequence.attrs.get("summary", {}).get(name), float)]
    if lacking:
        raise UserError(f"{sequence.path}: says nothing of {', '.join(lacking)}, which a view needs")
    view, frames = optics.camera_of(sequence), range(sequence.frames)
    force, time = sequence["force"][:], sequence["time"][:]
    flows = [name for name in ("flow", "flow_recovered") if name in sequence]
    longest = max(float(attrs["summary"]["peak_flow_px"]), 1e-6)
    strongest = max(float(attrs["summary"]["peak_traction_kpa"]), 1e-9)
    tissue, first, step = sequence["tissue"][:], sequence["rgb"][0], max(1, width // _MESH_COLUMNS)
    grey = np.repeat(first.mean(axis=2, keepdims=True), 3, axis=2).astype(np.uint8)
    stream.log("/", rerun.ViewCoordinates.RDF, static=True)
    stream.log("camera", rerun.Pinhole(image_from_camera=view.K, resolution=[width, height]), static=True)
    if "right" in attrs:
        other = optics.camera_of(sequence, attrs["right"])
        aside = other.rotation @ (other.centre - view.centre)
        stream.log("right", rerun.Transform3D(translation=aside), static=True)
        stream.log("right", rerun.Pinhole(image_from_camera=other.K, resolution=[width, height]), static=True)
    stream.log("force", rerun.SeriesLines(names=["x mN", "y mN", "z mN", "length mN"]), static=True)
    stream.log("about", rerun.TextDocument(_about(sequence), media_type="text/markdown"), static=True)
    for t in frames:
        stream.set_time("frame", sequence=t)
        stream.set_time("time", duration=float(time[t]))
        rgb = sequence["rgb"][t]
        stream.log("camera/frame", rerun.Image(rgb).compress(jpeg_quality=_JPEG_QUALITY))
        if "rgb_right" in sequence:
            shown = rerun.Image(sequence["rgb_right"][t]).compress(jpeg_quality=_JPEG_QUALITY)
            stream.log("right/frame", shown)
        for name in flows:
            colours = picture.flow_colours(sequence[name][t], longest)
            shown = picture.overlay(grey, colours, 0.65 * tissue.astype(np.float32))
            stream.log(name, rerun.Image(shown).compress(jpeg_quality=_JPEG_QUALITY))
        load = np.linalg.norm(sequence["traction"][t], axis=-1)
        shown = picture.overlay(grey, picture.heat(load, strongest), 0.8 * tissue.astype(np.float32))
        stream.log("traction", rerun.Image(shown).compress(jpeg_quality=_JPEG_QUALITY))
        stream.log("force", rerun.Scalars([*force[t], float(np.linalg.norm(force[t]))]))
        if "depth" in sequence:
            points, faces = surface(sequence, t, step)
            colours = first[::step, ::step].reshape(-1, 3)
            stream.log(
                "tissue", rerun.Mesh3D(vertex_positions=points, triangle_indices=faces, vertex_colors=colours)
            )


def _about(sequence: Sequence) -> str:
    attrs = sequence.attrs
    gestures = name_gestures(attrs.get("scenario") or {})
    return (
        f"# Sequence {sequence.index}\n\n{gestures}, E = {attrs['young_kpa']:.3g} kPa, "
        f"{attrs['scale_mm_per_px']:.3g} mm/px\n\nflow: hue is direction; full colour is "
        f"{attrs['summary']['peak_flow_px']:.3g} px\n\ntraction: brightest is "
        f"{attrs['summary']['peak_traction_kpa']:.3g} kPa\n"
    )


def _rerun() -> Any:
    try:
        import rerun
    except ImportError:
        raise UserError("viewing needs the extra `view`: pip install '.[view]' in the clone") from None
    return rerun
