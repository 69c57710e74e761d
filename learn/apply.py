"""A trained model on files: sequence stores, datasets, and arrays of flow from anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learn.predict import Predictor, View, total_force
from synth.errors import UserError
from synth.store import Dataset, Sequence, open_sequence

_FLOW = {"ideal": "flow", "recovered": "flow_tvl1"}
_VIDEO = {".mp4", ".avi", ".mov", ".mkv", ".webm"}


@dataclass(frozen=True)
class Motion:
    """Flow of one film, still in pixels, wherever it came from."""

    name: str
    frames: int
    flow: Callable[[int], NDArray[np.float32]]
    """Frame t → (H, W, 2) px from the rest frame, on its pixels."""
    confidence: Callable[[int], NDArray[np.float32]] | None
    tissue: NDArray[np.bool_]
    scale_mm_per_px: float
    young_kpa: float | None


def motions(path: Path, source: str) -> Iterator[Motion]:
    """What `path` holds: a dataset folder, one NNNNNN.zarr store, or an .npz of arrays.

    An .npz holds `flow` (T, H, W, 2) px, `tissue` (H, W), `scale_mm_per_px`, and if known `young_kpa` and
    `confidence` (T, H, W). Raises UserError for anything else; for a video it says who reads those.
    """
    if path.suffix.lower() in _VIDEO:
        raise UserError(f"{path}: a video has no flow yet; `bench score` recovers it and then predicts")
    if path.suffix == ".npz":
        yield _arrays(path)
    elif path.name.endswith((".zarr", ".zarr.part")):
        yield _stored(open_sequence(path), source)
    else:
        for sequence in Dataset(path):
            yield _stored(sequence, source)


def _stored(sequence: Sequence, source: str) -> Motion:
    if source not in _FLOW:
        raise UserError(f"unknown input {source!r}: ideal or recovered")
    if _FLOW[source] not in sequence:
        raise UserError(f"{sequence.path}: holds no {source} flow")
    flow = sequence[_FLOW[source]]
    sure = source == "recovered" and "flow_confidence" in sequence
    confidence = sequence["flow_confidence"] if sure else None
    return Motion(
        name=sequence.path.stem,
        frames=sequence.frames,
        flow=lambda t: flow[t],
        confidence=None if confidence is None else lambda t: confidence[t],
        tissue=sequence["tissue"][:].astype(bool),
        scale_mm_per_px=float(sequence.attrs["scale_mm_per_px"]),
        young_kpa=float(sequence.attrs["young_kpa"]),
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
        raise UserError(f"{path}: flow is {flow.shape}, expected (T, {tissue.shape}, 2) like the tissue")
    confidence = found.get("confidence")
    if confidence is not None and confidence.shape != flow.shape[:3]:
        raise UserError(f"{path}: confidence is {confidence.shape}, expected {flow.shape[:3]}")
    young = found.get("young_kpa")
    return Motion(
        name=path.stem,
        frames=len(flow),
        flow=lambda t: flow[t],
        confidence=None if confidence is None else lambda t: confidence[t].astype(np.float32),
        tissue=tissue,
        scale_mm_per_px=float(found["scale_mm_per_px"]),
        young_kpa=None if young is None else float(young),
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
        predictor(
            motion.flow(t),
            motion.tissue,
            motion.scale_mm_per_px,
            young,
            None if motion.confidence is None else motion.confidence(t),
        )
        for t in range(motion.frames)
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
    if maps[0].head_mn is not None:
        out["head_mn"] = np.stack([m.head_mn for m in maps])
    return out
