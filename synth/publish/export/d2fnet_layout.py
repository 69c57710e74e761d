"""Export for the training code of the published method (D2FNet)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synth.dataset.store import Dataset, Sequence
from synth.errors import UserError

# The published loader drops nodes right of this pixel, and assumes that all files have the same nodes.
_LARGEST_X = 1400.0
_NODES = 20_000


def write_npz(dataset: Dataset, target: Path) -> None:
    """Writes `run_NNNNNN/brain_surface_NNNNNN_auto_projected_NNNNNN_2d.npz` for each sequence.

    Arrays as in github.com/D3MIA/D2FNet, d2fnet/dataset.py: `disp2d` (T, N, 2) mm, `force_mag` (T, N) N,
    `projected_pixels` (T, N, 2) px, with the same N in every file. Unlike there, displacement is in the plane
    of the picture, and `force_mag` is their "intensity" (peak = total force) from the true traction, as
    stated in the export's README.txt. Added are `times` (T,) s, `visible` (T, N), `depth` (T, N) mm if it is
    stored, and `..._meta.json` with the sequence's attributes.
    """
    count = min(_NODES, *(int(sequence["tissue"][:].sum()) for sequence in dataset))
    if not count:
        raise UserError(f"{dataset.root}: a sequence shows no tissue")
    for sequence in dataset:
        name = f"{sequence.index:06d}"
        (target / f"run_{name}").mkdir()
        path = target / f"run_{name}" / f"brain_surface_{name}_auto_projected_{name}_2d.npz"
        np.savez_compressed(path, times=sequence["time"][:], **_arrays(sequence, count))
        path.with_name(path.stem + "_meta.json").write_text(json.dumps(sequence.attrs, indent=1), "utf-8")
    (target / "README.txt").write_text(_NOTE, "utf-8")


def _arrays(sequence: Sequence, count: int) -> dict[str, Any]:
    """Arrays over time of `count` points of the tissue, by name."""
    tissue = np.argwhere(sequence["tissue"][:])
    rows, columns = tissue[np.linspace(0, len(tissue) - 1, count).round().astype(int)].T
    scale = float(sequence.attrs["scale_mm_per_px"])
    shrink = min(1.0, _LARGEST_X / sequence.size[1])
    force = np.linalg.norm(sequence["force"][:], axis=1)
    frames = range(sequence.frames)
    flow = np.stack([sequence["flow"][t][rows, columns] for t in frames])
    places = np.stack([columns, rows], axis=-1) + flow
    sizes = (np.linalg.norm(sequence["traction"][t], axis=-1) for t in frames)
    shares = [size[rows, columns] / (size.max() or 1) * force[t] / 1000 for t, size in enumerate(sizes)]
    arrays = {
        "disp2d": (scale * flow).astype(np.float32),
        "force_mag": np.stack(shares).astype(np.float32),
        "projected_pixels": (shrink * places).astype(np.float32),
        "visible": np.stack([sequence["visible"][t][rows, columns] for t in frames]),
    }
    if "depth" in sequence:
        x, y = places.astype(np.float32).transpose(2, 0, 1)[..., None].copy()  # (T, N, 1) each
        depth = [cv2.remap(sequence["depth"][t], x[t], y[t], cv2.INTER_NEAREST)[:, 0] for t in frames]
        arrays["depth"] = np.stack(depth)
    return arrays


_NOTE = """\
Layout of github.com/D3MIA/D2FNet: disp2d (T, N, 2) mm, force_mag (T, N) N, projected_pixels (T, N, 2) px.
disp2d is the motion in the plane of the picture times the scale, not world x and y.
force_mag is the "intensity" map, its peak scaled to the total force; the true traction is in the Zarr stores.
"""
