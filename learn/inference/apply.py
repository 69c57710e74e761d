"""A trained model on files: sequence stores, datasets, videos, and arrays of flow from anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learn.data.clips import FIELDS
from learn.inference import video_flow
from learn.inference.predict import Predictor, View, total_force
from learn.inference.stiffness import stiffness
from learn.inference.video_flow import Step
from synth.dataset.store import Dataset, Sequence, open_sequence
from synth.errors import UserError


@dataclass(frozen=True)
class Motion:
    """Flow of one film, still in pixels, wherever it came from."""

    name: str
    steps: Callable[[], Iterator[Step]]
    """Flow (H, W, 2) px from the rest frame, on its pixels, and confidence if there is one, frame by
    frame."""
    tissue: NDArray[np.bool_]
    scale_mm_per_px: float
    young_kpa: float | None
    force_mn: NDArray[np.float64] | None = None
    """(T,) size of the true force, where it is known."""


@dataclass(frozen=True)
class Filmed:
    """What a video doesn't say of itself."""

    scale_mm_per_px: float | None = None
    tissue: Path | None = None
    """A picture, white where there is tissue; everywhere if not given."""
    backend: str = "tvl1"
    """Flow estimator, as in a job's flow.backend."""


def motions(path: Path, source: str, filmed: Filmed | None = None) -> Iterator[Motion]:
    """What `path` holds: a dataset folder, one NNNNNN.zarr store, an .npz of arrays, or a video.

    An .npz holds `flow` (T, H, W, 2) px, `tissue` (H, W), `scale_mm_per_px`, and if known `young_kpa`,
    `confidence` (T, H, W) and `force_mn` (T,). A video's first frame is its rest frame. Raises UserError for
    anything else, and for a video without a scale.
    """
    if path.suffix.lower() in video_flow.SUFFIXES:
        yield _video(path, filmed or Filmed())
    elif path.suffix == ".npz":
        yield _arrays(path)
    elif path.name.endswith((".zarr", ".zarr.part")):
        yield _stored(open_sequence(path), source)
    else:
        for sequence in Dataset(path):
            yield _stored(sequence, source)


def _stored(sequence: Sequence, source: str) -> Motion:
    if source not in FIELDS:
        raise UserError(f"unknown input {source!r}: {', '.join(FIELDS)}")
    if FIELDS[source] not in sequence:
        raise UserError(f"{sequence.path}: holds no {source} flow")
    flow = sequence[FIELDS[source]]
    sure = source == "recovered" and "flow_confidence" in sequence
    confidence = sequence["flow_confidence"] if sure else None
    return Motion(
        name=sequence.path.stem,
        steps=lambda: (
            (flow[t], None if confidence is None else confidence[t]) for t in range(sequence.frames)
        ),
        tissue=sequence["tissue"][:].astype(bool),
        scale_mm_per_px=float(sequence.attrs["scale_mm_per_px"]),
        young_kpa=float(sequence.attrs["young_kpa"]),
        force_mn=np.linalg.norm(sequence["force"][:], axis=1),
    )


def _video(path: Path, filmed: Filmed) -> Motion:
    if filmed.scale_mm_per_px is None:
        raise UserError(f"{path}: a video doesn't say how large it shows things; give --scale in mm a pixel")
    where = video_flow.tissue(path, filmed.tissue)
    return Motion(
        name=path.stem,
        steps=lambda: video_flow.steps(path, where, filmed.backend),
        tissue=where,
        scale_mm_per_px=filmed.scale_mm_per_px,
        young_kpa=None,
    )


def _arrays(path: Path) -> Motion:
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: cannot be read as .npz ({error})") from None
    missing = {"flow", "tissue", "scale_mm_per_px"} - found.keys()
    if missing:
        raise UserError(f"{path}: lacks {', '.join(sorted(missing))}")
    flow, tissue = found["flow"].astype(np.float32), found["tissue"].astype(bool)
    if flow.ndim != 4 or flow.shape[1:] != (*tissue.shape, 2):
        h, w = tissue.shape
        raise UserError(f"{path}: flow is {flow.shape}, expected (T, {h}, {w}, 2) like the tissue")
    confidence = found.get("confidence")
    if confidence is not None and confidence.shape != flow.shape[:3]:
        raise UserError(f"{path}: confidence is {confidence.shape}, expected {flow.shape[:3]}")
    young, force = found.get("young_kpa"), found.get("force_mn")
    if force is not None and force.shape != (len(flow),):
        raise UserError(f"{path}: force_mn is {force.shape}, expected ({len(flow)},)")
    return Motion(
        name=path.stem,
        steps=lambda: (
            (f, None if confidence is None else confidence[t].astype(np.float32)) for t, f in enumerate(flow)
        ),
        tissue=tissue,
        scale_mm_per_px=float(found["scale_mm_per_px"]),
        young_kpa=None if young is None else float(young),
        force_mn=None if force is None else force.astype(np.float64),
    )


def apply(predictor: Predictor, motion: Motion, young_kpa: float | None = None) -> dict[str, Any]:
    """Force of every frame of a film, ready for np.savez.

    `young_kpa` overrides the film's own. Returns `density` (T, C, N, N) mN/mm², `total_force_mn` (T,),
    `force_mn` (T, 3) for a model that gives direction, `head_mn` (T, C) for one with a total-force head,
    `mask` (N, N), `pitch_mm`, `centre_px` (x, y),
    `young_kpa`, `young_known`.
    """
    young = young_kpa if young_kpa is not None else motion.young_kpa
    view = View(motion.tissue, motion.scale_mm_per_px, predictor.grid)
    maps = [
        predictor(flow, motion.tissue, motion.scale_mm_per_px, young, confidence)
        for flow, confidence in motion.steps()
    ]
    density = np.stack([m.density for m in maps])
    kind = predictor.card.settings.target
    out: dict[str, Any] = {
        "density": density,
        "total_force_mn": total_force(density, kind, predictor.grid),
        "mask": view.mask,
        "pitch_mm": predictor.grid.pitch_mm,
        "centre_px": np.array(view.resample.centre_px),
        "young_kpa": maps[0].young_kpa,
        "young_known": maps[0].young_known,
    }
    if density.shape[1] == 3:
        out["force_mn"] = density.astype(np.float64).sum((2, 3)) * predictor.grid.pitch_mm**2
    heads = [m.head_mn for m in maps if m.head_mn is not None]
    if heads:
        out["head_mn"] = np.stack(heads)
    return out


def calibrate(predictor: Predictor, press: Motion) -> float:
    """Young's modulus [kPa] from a film of one press whose force is known. Raises UserError if it isn't."""
    if press.force_mn is None:
        raise UserError(f"{press.name}: holds no force to calibrate on (force_mn in an .npz)")
    view = View(press.tissue, press.scale_mm_per_px, predictor.grid)
    moved, sure = [], []
    for flow, confidence in press.steps():
        moved.append(view.resample.mean(flow.transpose(2, 0, 1) * press.scale_mm_per_px, press.tissue))
        if confidence is not None:
            sure.append(view.resample.mean(confidence, press.tissue))
    given = np.stack(sure) if sure else None
    return stiffness(predictor, np.stack(moved), view.mask, press.force_mn, given)
